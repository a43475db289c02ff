"""Kalibr's camchain.yaml, which TUM-VI and 4Seasons have, too."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from sigmaslam.calibration_files.lens_models import read_lens, reject_unsupported
from sigmaslam.errors import CalibrationError
from sigmaslam.files import atomic_write_text
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
        T_right_left = T_right_imu @ _inverse(left, "T_cam_imu", T_left_imu)
    else:
        raise right.error(
            "T_cn_cnm1 is missing: the cameras were calibrated one by one; give both topics to kalibr_calibrate_cameras"
        )
    models = [_camera_model(camera) for camera in (left, right)]
    try:
        return StereoCamera(models[0], models[1], _inverse(right, "T_cn_cnm1", T_right_left))
    except CalibrationError as error:
        raise content.error(f"T_cn_cnm1 of cam1: {error}") from None


def write_kalibr(
    path: Path, eyes: Sequence[CameraModel], T_left_right: np.ndarray, sensor: InertialSensor, more: dict[str, Any]
) -> None:
    """Writes camchain-imucam.yaml of one camera or two; Kalibr itself knows radtan of four coefficients alone.

    Args:
        path: of the file.
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
            "camera_model": "pinhole",
            "intrinsics": [eye.fx, eye.fy, eye.cx, eye.cy],
            "distortion_model": eye.distortion_model,
            "distortion_coeffs": list(eye.distortion),
            "resolution": [eye.width, eye.height],
        }
    atomic_write_text(path, yaml.safe_dump(content | more, sort_keys=False, default_flow_style=None, width=120))


def _inverse(section: CalibrationYaml, key: str, T: np.ndarray) -> np.ndarray:
    try:
        return np.asarray(np.linalg.inv(T))
    except np.linalg.LinAlgError:
        raise section.error(f"{key} has no inverse: {T.tolist()}") from None


def _camera_model(camera: CalibrationYaml) -> CameraModel:
    where = f"{camera.path}: {camera.prefix}"
    projection = camera.text("camera_model")
    reject_unsupported(projection, f"{where}camera_model")
    if projection != "pinhole":
        raise camera.error(f"camera_model is {projection!r}; only pinhole is supported")
    width, height = camera.numbers("resolution", (2,)).tolist()
    fx, fy, cx, cy = camera.numbers("intrinsics", (4,)).tolist()
    coefficients = camera.numbers("distortion_coeffs", (None,), []).tolist()
    model, distortion = read_lens(camera.text("distortion_model"), coefficients, f"{where}distortion_model")
    try:
        return CameraModel(int(width), int(height), fx, fy, cx, cy, 0.0, model, distortion)
    except CalibrationError as error:
        raise camera.error(str(error)) from None
