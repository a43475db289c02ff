"""EuRoC's sensor.yaml of two cameras."""

from pathlib import Path

import numpy as np

from sigmaslam.calibration_files.lens_models import read_lens, reject_unsupported
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml


def read_sensors(left: Path, right: Path) -> StereoCamera:
    """Stereo camera from two sensor.yaml; T_BS maps sensor points into the body frame.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    (left_model, T_body_left), (right_model, T_body_right) = (_read_sensor(path) for path in (left, right))
    try:
        return StereoCamera(left_model, right_model, np.linalg.inv(T_body_left) @ T_body_right)
    except (CalibrationError, np.linalg.LinAlgError) as error:
        raise CalibrationError(f"T_BS of {left} and {right}: {error}") from None


def _read_sensor(path: Path) -> tuple[CameraModel, np.ndarray]:
    content = CalibrationYaml.read(path)
    reject_unsupported(content.text("camera_model", "pinhole"), f"{path}: camera_model")
    if content.text("camera_model", "pinhole") != "pinhole":
        raise content.error(f"camera_model is {content.text('camera_model')!r}; only pinhole is supported")
    name = content.text("distortion_model", "none")
    width, height = content.numbers("resolution", (2,)).tolist()
    fx, fy, cx, cy = content.numbers("intrinsics", (4,)).tolist()
    coefficients = [] if name == "none" else content.numbers("distortion_coefficients", (None,)).tolist()
    model, distortion = read_lens(name, coefficients, f"{path}: distortion_model")
    try:
        camera = CameraModel(int(width), int(height), fx, fy, cx, cy, 0.0, model, distortion)
    except CalibrationError as error:
        raise content.error(str(error)) from None
    if isinstance(content.entries.get("T_BS"), dict):
        return camera, content.section("T_BS").numbers("data", (16,)).reshape(4, 4)
    return camera, content.numbers("T_BS", (4, 4))
