"""Faults of calibrations: what is given is not what took the images."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import cv2
import numpy as np

from sigmaslam.calibration.tracker_covariance import nearest_errors
from sigmaslam.estimation.calibration_errors import ERRORS
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT, Fault, delay_right


def move_centre(columns: float, camera: StereoCamera) -> StereoCamera:
    """The right principal point is given too far to the right, pixels."""
    return replace(camera, right=replace(camera.right, cx=camera.right.cx + columns))


def lower_centre(rows: float, camera: StereoCamera) -> StereoCamera:
    """The right principal point is given too low, pixels."""
    return replace(camera, right=replace(camera.right, cy=camera.right.cy + rows))


def turn_right(degrees: tuple[float, float, float], camera: StereoCamera) -> StereoCamera:
    """The right camera is given turned about its x, y and z axes."""
    T_left_right = camera.T_left_right.copy()
    T_left_right[:3, :3] = T_left_right[:3, :3] @ cv2.Rodrigues(np.radians(degrees))[0]
    return replace(camera, T_left_right=T_left_right)


def zoom_right(share: float, camera: StereoCamera) -> StereoCamera:
    """The right focal length is given too long."""
    right = camera.right
    return replace(camera, right=replace(right, fx=right.fx * (1 + share), fy=right.fy * (1 + share)))


def zoom_left(share: float, camera: StereoCamera) -> StereoCamera:
    """The left focal length is given too long."""
    left = camera.left
    return replace(camera, left=replace(left, fx=left.fx * (1 + share), fy=left.fy * (1 + share)))


def mix(seed: int, camera: StereoCamera) -> StereoCamera:
    """Some of all that may be wrong with the right eye at once: each with a chance of two fifths, normal."""
    rng = np.random.default_rng(seed)
    chosen, sizes = rng.random(6) < 0.4, rng.normal(size=6) * [4.0, 3.0, 0.4, 0.5, 0.4, 0.01]
    columns, rows, *degrees, share = np.where(chosen, sizes, 0.0).tolist()
    turned = turn_right((degrees[0], degrees[1], degrees[2]), camera)
    return zoom_right(share, lower_centre(rows, move_centre(columns, turned)))


def stretch_baseline(share: float, camera: StereoCamera) -> StereoCamera:
    """The baseline is given too long."""
    T_left_right = camera.T_left_right.copy()
    T_left_right[:3, 3] *= 1.0 + share
    return replace(camera, T_left_right=T_left_right)


def bend_right(k1: float, camera: StereoCamera) -> StereoCamera:
    """The right lens is given with so much more radial distortion."""
    return replace(camera, right=_bent(camera.right, k1))


def bend_both(k1: float, camera: StereoCamera) -> StereoCamera:
    """Both lenses are."""
    return replace(camera, left=_bent(camera.left, k1), right=_bent(camera.right, k1))


def _bent(eye: CameraModel, k1: float) -> CameraModel:
    first, *others = eye.distortion or (0.0,) * 4
    return replace(eye, distortion_model="radtan", distortion=(first + k1, *others))


def _sizes(name: str, words: str, change: Any, sizes: dict[str, Any]) -> dict[str, Fault]:
    """A fault of some sizes."""
    return {
        f"{name}_{size}": Fault(words.format(size), FAULTS[NO_FAULT].spoil, miscalibrate=partial(change, value))
        for size, value in sizes.items()
    }


CALIBRATION_FAULTS: dict[str, Fault] = {
    NO_FAULT: FAULTS[NO_FAULT],
    **_sizes(
        "centre", "cx of the right eye {} px too large", move_centre, {"1": 1.0, "2": 2.0, "4": 4.0, "-10": -10.0}
    ),
    **_sizes("rows", "cy of the right eye {} px too large", lower_centre, {"1": 1.0, "4": 4.0, "15": 15.0}),
    **_sizes(
        "yaw",
        "right eye turned by {}° about the vertical",
        turn_right,
        {f"{size:g}": (0.0, size, 0.0) for size in (0.05, 0.1, 0.3, 1.0)},
    ),
    **_sizes(
        "pitch",
        "right eye turned by {}° up or down",
        turn_right,
        {f"{size:g}": (size, 0.0, 0.0) for size in (0.03, 0.06, 0.12, 0.5)},
    ),
    **_sizes(
        "roll",
        "right eye turned by {}° about its axis",
        turn_right,
        {f"{size:g}": (0.0, 0.0, size) for size in (0.1, 0.5, 2.0)},
    ),
    **_sizes(
        "zoom",
        "focal length of the right eye {} % too long",
        zoom_right,
        {"0.2": 0.002, "0.5": 0.005, "1": 0.01, "2": 0.02},
    ),
    **_sizes("left_zoom", "focal length of the left eye {} % too long", zoom_left, {"2": 0.02}),
    **_sizes("mixture", "drawn mixture {} of cx, cy, pitch, yaw, roll, zoom", mix, {f"{k}": k for k in range(1, 9)}),
    **_sizes("baseline", "baseline {} % too long", stretch_baseline, {"0.5": 0.005, "1": 0.01, "2": 0.02}),
    **_sizes("k1", "k1 of the right lens {} too large", bend_right, {"0.005": 0.005, "0.01": 0.01, "0.02": 0.02}),
    **_sizes("both_k1", "k1 of both lenses {} too large", bend_both, {"0.01": 0.01, "0.02": 0.02, "0.05": 0.05}),
    **{
        f"delay_{time}": Fault(f"right images {time} ms late, by optical flow", partial(delay_right, time))
        for time in (2, 5, 10)
    },
}
"""By name, in the order of the page; the first has no fault."""

# Smaller errors are not told, pixels at unit normalised coordinates; shares are of some 50 px of disparity.
_TOLD, _SHARE = 0.05, 0.001


def injected_errors(camera: StereoCamera, name: str) -> dict[str, float]:
    """The tracker's errors that come nearest to a fault of the table, by their names; empty for others."""
    if name not in CALIBRATION_FAULTS:
        return {}
    errors = nearest_errors(CALIBRATION_FAULTS[name].miscalibrate(camera), camera).tolist()
    return {
        error: value
        for error, value in zip(ERRORS, errors, strict=True)
        if abs(value) > (_SHARE if error in ("focal", "baseline") else _TOLD)
    }
