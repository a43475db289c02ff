"""Kalibr's camchain.yaml, which TUM-VI and 4Seasons have, too."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.calibration_files.calibration_writer import write_yaml
from sigmaslam.calibration_files.lens_models import naming, read_pinhole, stereo_camera
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.se3 import se3_inverse


def is_kalibr(content: CalibrationYaml) -> bool:
    """Whether a YAML file is a camchain of two cameras or more."""
    return isinstance(content.entries.get("cam0"), dict) and isinstance(content.entries.get("cam1"), dict)


def read_kalibr(content: CalibrationYaml) -> StereoCamera:
    """Stereo camera of cam0 (left) and cam1 (right).

    T_cn_cnm1 of cam1 takes points of cam0 into cam1; without it T_cam_imu of both is used.

    Raises:
        CalibrationError: names file, key and what was expected.
    """
    left, right = (content.section(name) for name in ("cam0", "cam1"))
    if "T_cn_cnm1" in right.entries:
        T_right_left = right.numbers("T_cn_cnm1", (4, 4))
    elif "T_cam_imu" in left.entries and "T_cam_imu" in right.entries:
        T_left_imu, T_right_imu = (camera.numbers("T_cam_imu", (4, 4)) for camera in (left, right))
        with naming(left.error("T_cam_imu")):
            T_right_left = T_right_imu @ np.linalg.inv(T_left_imu)
    else:
        raise right.error(
            "T_cn_cnm1 is missing: the cameras were calibrated one by one; give both topics to kalibr_calibrate_cameras"
        )
    eyes = [read_pinhole(camera, "distortion_coeffs") for camera in (left, right)]
    return stereo_camera(f"{content.path}: T_cn_cnm1 of cam1", eyes, T_right_left)


def pinhole_entries(eye: CameraModel, lens: str, coefficients: Sequence[float]) -> dict[str, Any]:
    """Of one camera: intrinsics, lens and size."""
    return {
        "camera_model": "pinhole",
        "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
        "distortion_model": lens,
        "distortion_coeffs": list(coefficients),
        "resolution": [eye.width, eye.height],
    }


def write_kalibr(
    path: Path, eyes: Sequence[CameraModel], T_left_right: np.ndarray, sensor: InertialSensor, more: dict[str, Any]
) -> None:
    """Writes camchain-imucam.yaml of one camera or two; Kalibr itself knows radtan of four coefficients alone.

    Args:
        eyes: left first.
        T_left_right: (4, 4), not used for one camera.
        sensor: with T_left_imu and time shift.
        more: further entries, which readers leave alone.

    Raises:
        InputError: the folder cannot be written.
    """
    T_right_left, content = se3_inverse(T_left_right), dict[str, Any]()
    for k, eye in enumerate(eyes):
        T_eye_left = T_right_left if k else np.eye(4)
        content[f"cam{k}"] = {
            "T_cam_imu": (T_eye_left @ sensor.T_left_imu).tolist(),
            **({"T_cn_cnm1": T_right_left.tolist()} if k else {}),
            "timeshift_cam_imu": sensor.time_shift,
            **pinhole_entries(eye, eye.distortion_model, eye.distortion),
        }
    write_yaml(path, content | more)
