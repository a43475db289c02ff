"""KITTI's calibration files: calib.txt and calib_cam_to_cam.txt."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text, shorten
from sigmaslam.calibration_files.camera_infos import right_position
from sigmaslam.calibration_files.lens_models import (
    ImageSize,
    UnknownImageSizeError,
    camera_model,
    intrinsics_of,
    naming,
    need_image_size,
)
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.checked_yaml import CalibrationYaml
from sigmaslam.geometry.se3 import is_rigid, rigid_motion

GREY_PAIR = (0, 1)


def read_kitti_calibration(path: Path, image_size: ImageSize | None, cameras: tuple[int, int]) -> StereoCamera:
    """Read KITTI's calib.txt ('P0: ' and 12 numbers, or bare lines of 12) or calib_cam_to_cam.txt.

    With calib_cam_to_cam.txt the image size decides: P_rect for rectified images (S_rect), else K, D, R, T of
    the original ones (S). The cameras of a colour pair keep their measured offset in y and z (a few mm),
    which `StereoRectifier` then removes.

    Raises:
        CalibrationError: a matrix is missing or incomplete, or the image size fits neither S_rect nor S.
    """
    content = _read_entries(path, cameras)
    left, right = cameras
    if f"P{left}" in content.entries or f"P_rect_{left:02d}" not in content.entries:
        return _from_projections(content, (f"P{left}", f"P{right}"), image_size)
    sizes = {
        name: tuple(int(n) for n in _matrix(content, f"{name}_{left:02d}", (2,)))
        for name in ("S_rect", "S")
        if f"{name}_{left:02d}" in content.entries
    }
    known = ", ".join(f"{name}_{left:02d} {size[0]}x{size[1]}" for name, size in sizes.items())
    if image_size is None:
        raise UnknownImageSizeError(f"{path}: is for {known or 'images of a size it does not name'}; give --size")
    if not sizes or sizes.get("S_rect") == image_size:
        return _from_projections(content, (f"P_rect_{left:02d}", f"P_rect_{right:02d}"), image_size)
    if sizes.get("S") == image_size:
        return _from_originals(content, cameras, image_size)
    raise CalibrationError(
        f"{path}: images are {image_size[0]}x{image_size[1]}, the calibration is for {known}; "
        "use the calibration that belongs to these images"
    )


def read_rigid(path: Path, rotation: str, translation: str) -> np.ndarray:
    """(4, 4) transform of two keys, as in calib_imu_to_velo.txt, calib_velo_to_cam.txt and calib_cam_to_cam.txt.

    Raises:
        CalibrationError: a matrix is missing or incomplete, or the first is no rotation.
    """
    content = _read_entries(path, GREY_PAIR)
    T = rigid_motion(_matrix(content, rotation, (3, 3)), _matrix(content, translation, (3,)))
    if not is_rigid(T):
        raise CalibrationError(f"{path}: key '{rotation}' is no rotation; correct the numbers")
    return T


def read_rectification(path: Path, camera: int) -> np.ndarray:
    """(4, 4) takes points of camera 0 into a rectified camera, by calib_cam_to_cam.txt.

    Raises:
        CalibrationError: a matrix is missing or incomplete.
    """
    content = _read_entries(path, GREY_PAIR)
    P = _matrix(content, f"P_rect_{camera:02d}", (3, 4))
    return rigid_motion(_matrix(content, "R_rect_00", (3, 3)), np.linalg.solve(P[:, :3], P[:, 3]))


def _read_entries(path: Path, cameras: tuple[int, int]) -> CalibrationYaml:
    text = read_text(path, CALIBRATION_BYTES, "the calibration", CalibrationError)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if any(":" in line for line in lines):
        return CalibrationYaml(path, _without_doubles(path, lines))
    if len(lines) in (2, 4):
        numbers = cameras if len(lines) == 2 else range(4)
        return CalibrationYaml(path, {f"P{camera}": line.split() for camera, line in zip(numbers, lines, strict=True)})
    raise CalibrationError(
        f"{path}: expected lines 'P{cameras[0]}: ' and 'P{cameras[1]}: ' with 12 numbers each, or two bare "
        f"lines of 12 numbers (left, right); found {len(lines)} lines without a key"
    )


def _without_doubles(path: Path, lines: list[str]) -> dict[str, list[str]]:
    """Words by key of lines `key: words`; others are left out."""
    entries: dict[str, list[str]] = {}
    for line in lines:
        key, colon, value = line.partition(":")
        if colon and key.strip() in entries:
            raise CalibrationError(f"{path}: key '{shorten(key.strip())}' stands twice: remove the wrong line")
        if colon:
            entries[key.strip()] = value.split()
    return entries


def _matrix(content: CalibrationYaml, key: str, shape: tuple[int, ...]) -> np.ndarray:
    return content.numbers(key, (math.prod(shape),)).reshape(shape)


def _model(
    path: Path, key: str, K: np.ndarray, image_size: ImageSize, distortion: tuple[float, ...] = ()
) -> CameraModel:
    if not np.allclose([K[1, 0], *K[2]], [0, 0, 0, 1]):
        raise CalibrationError(f"{path}: key '{key}' must begin with an upper triangular K with K[2, 2] = 1, got\n{K}")
    # All are distorted, also those whose coefficients are zero.
    camera = camera_model(f"{path}: {key}", image_size, intrinsics_of(K))
    return replace(camera, distortion_model="radtan", distortion=distortion) if distortion else camera


def _from_projections(content: CalibrationYaml, keys: tuple[str, str], image_size: ImageSize | None) -> StereoCamera:
    """From P = K [I | t], where t is the position of camera 0 in this camera's frame."""
    image_size = need_image_size(str(content.path), image_size)
    left, right = (_matrix(content, key, (3, 4)) for key in keys)
    models = [_model(content.path, key, P[:, :3], image_size) for key, P in zip(keys, (left, right), strict=True)]
    with naming(f"{content.path}: keys '{keys[0]}' and '{keys[1]}'"):
        return StereoCamera(models[0], models[1], rigid_motion(np.eye(3), right_position(left, right)))


def _from_originals(content: CalibrationYaml, cameras: tuple[int, int], image_size: ImageSize) -> StereoCamera:
    """From K, D and the pose R, T of camera 0 in each camera's frame."""
    models, poses = [], []
    for camera in cameras:
        distortion = tuple(_matrix(content, f"D_{camera:02d}", (5,)).tolist())
        K = _matrix(content, key := f"K_{camera:02d}", (3, 3))
        models.append(_model(content.path, key, K, image_size, distortion))
        R, t = _matrix(content, f"R_{camera:02d}", (3, 3)), _matrix(content, f"T_{camera:02d}", (3,))
        poses.append(rigid_motion(R, t))  # T_camera_camera0
    with naming(f"{content.path}: R and T of cameras {cameras[0]} and {cameras[1]}"):
        return StereoCamera(models[0], models[1], poses[0] @ np.linalg.inv(poses[1]))
