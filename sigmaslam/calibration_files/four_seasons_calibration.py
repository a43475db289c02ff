"""Calibration of 4Seasons' undistorted images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text
from sigmaslam.calibration_files.lens_models import camera_model, stereo_camera
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel, StereoCamera

UNDISTORTED = ("undistorted_calib_0.txt", "undistorted_calib_1.txt", "undistorted_calib_stereo.txt")


def read_four_seasons(paths: Sequence[Path]) -> StereoCamera:
    """Stereo camera of `UNDISTORTED`.

    The eyes' files have 'Pinhole fx fy cx cy' and zeros, and the image size in the second line; the stereo file has
    the 4x4 matrix that takes points of the left camera into the right one.

    Raises:
        CalibrationError: names the file and what was expected.
    """
    models = [_camera_model(path) for path in paths[:2]]
    rows = [_numbers(paths[2], line) for line in _lines(paths[2])]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise CalibrationError(f"{paths[2]}: must be 4 lines of 4 numbers")
    return stereo_camera(str(paths[2]), models, np.array(rows))


def _camera_model(path: Path) -> CameraModel:
    lines = _lines(path)
    words = lines[0].split() if lines else []
    if len(lines) < 2 or not words or words[0] != "Pinhole":
        raise CalibrationError(f"{path}: must begin with a line 'Pinhole fx fy cx cy' and a line with width and height")
    values, size = _numbers(path, " ".join(words[1:])), _numbers(path, lines[1])
    if len(values) < 4 or any(values[4:]) or len(size) != 2:
        raise CalibrationError(
            f"{path}: must have fx fy cx cy, then zeros as the images are undistorted, and width and height in line 2, "
            f"got {lines[:2]}"
        )
    return camera_model(str(path), size, values[:4])


def _lines(path: Path) -> list[str]:
    text = read_text(path, CALIBRATION_BYTES, "the calibration", CalibrationError)
    return [line for line in text.splitlines() if line.strip()]


def _numbers(path: Path, text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()]
    except ValueError as error:
        raise CalibrationError(f"{path}: {error}") from None
