"""EuRoC's sensor.yaml of two cameras."""

from pathlib import Path

import numpy as np

from sigmaslam.calibration_files.lens_models import naming, read_pinhole
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml


def read_sensors(left: Path, right: Path) -> StereoCamera:
    """Stereo camera from two sensor.yaml; T_BS maps sensor points into the body frame.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    contents = [CalibrationYaml.read(path) for path in (left, right)]
    eyes = []
    for content in contents:
        content.entries = {"camera_model": "pinhole", "distortion_model": "none", **content.entries}
        eyes.append(read_pinhole(content, "distortion_coefficients"))
    T_body_left, T_body_right = (content.transform("T_BS") for content in contents)
    with naming(f"T_BS of {left} and {right}"):
        return StereoCamera(eyes[0], eyes[1], np.linalg.inv(T_body_left) @ T_body_right)
