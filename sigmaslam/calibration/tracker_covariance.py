"""From the covariance of a calibration's parameters to that of the errors that the tracker considers."""

import numpy as np

from sigmaslam.calibration.board_bundle import INTRINSICS, Rig
from sigmaslam.estimation.calibration_errors import ERRORS, measured_errors
from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.geometry.calibration_covariance import ERROR_NAMES, CalibrationCovariance
from sigmaslam.geometry.camera import RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse, transform_points

# Where the errors are compared: columns, rows and inverse depths of a grid, from infinity to so many baselines.
_GRID = (24, 16, 6)
_NEAREST = 10.0
# Steps of the derivatives: of intrinsics in pixels, of coefficients, metres and radians.
_STEP_PIXELS, _STEP = 1e-2, 1e-5


def tracker_covariance(rig: Rig, covariance: np.ndarray) -> tuple[CalibrationCovariance, float]:
    """Covariance of what is wrong with a stereo calibration, as the tracker knows it.

    Each parameter, moved by its sigma, moves what a rectified pair measures of points; the errors of the tracker that
    come nearest to this, in least squares over the image and over depths, are what the parameter is worth there. The
    disparity offset is one of them in the fit, but not in the result, as the tracker estimates it.

    Args:
        covariance: (P, P) of `rig.names`.

    Returns:
        The covariance, and the share of the variance of (u, v, disparity) that the tracker's errors describe.
    """
    rectifier = StereoRectifier(_pair(rig))
    view = rectifier.rectified
    uvd = compared_places(view)

    def measured(step: np.ndarray) -> np.ndarray:
        """(M, 3) what the calibrated pair measures where the true one differs by a step."""
        return measured_places(uvd, _pair(rig.moved(step)), rectifier)

    sizes = np.where([name.partition(".")[2] in INTRINSICS for name in rig.names], _STEP_PIXELS, _STEP)
    columns = [
        ((measured(step) - measured(-step)) / (2.0 * size)).ravel()
        for step, size in zip(np.diag(sizes), sizes.tolist(), strict=True)
    ]
    by_parameter = np.stack(columns, axis=-1)
    usable = np.all(np.isfinite(by_parameter), axis=1)
    by_error, by_parameter = measured_errors(view, uvd).reshape(-1, len(ERRORS))[usable], by_parameter[usable]
    to_errors = np.linalg.lstsq(by_error, by_parameter, rcond=None)[0]
    missed = by_parameter - by_error @ to_errors
    variance, missing = (float(np.einsum("ij,jk,ik->", each, covariance, each)) for each in (by_parameter, missed))
    root = to_errors @ matrix_root(covariance)
    errors = root @ root.T
    rows = [ERRORS.index(name) for name in ERROR_NAMES]
    units = np.array([1.0 if name in ("focal", "baseline") else view.fx for name in ERROR_NAMES])
    matrix = errors[np.ix_(rows, rows)] / np.outer(units, units)
    return CalibrationCovariance(ERROR_NAMES, 0.5 * (matrix + matrix.T)), 1.0 - missing / variance


def _pair(rig: Rig) -> StereoCamera:
    left, right = rig.eyes
    return StereoCamera(left, right, rig.T_left_right)


def compared_places(view: RectifiedStereo) -> np.ndarray:
    """(M, 3) places and disparities that both eyes of a rectified pair see."""
    u = np.linspace(0.0, view.width - 1.0, _GRID[0])
    v = np.linspace(0.0, view.height - 1.0, _GRID[1])
    disparity = np.linspace(view.fx / _NEAREST / (_GRID[2] * 100), view.fx / _NEAREST, _GRID[2])
    uvd = np.stack(np.meshgrid(u, v, disparity, indexing="ij"), axis=-1).reshape(-1, 3)
    # Points that the right eye does not see say nothing.
    return np.asarray(uvd[uvd[:, 0] - uvd[:, 2] >= 0.0])


def measured_places(uvd: np.ndarray, true: StereoCamera, rectifier: StereoRectifier) -> np.ndarray:
    """(M, 3) what a calibrated pair measures of points that would be at (u, v, disparity) (M, 3) if it were right."""
    view, calibrated, T_right_left = rectifier.rectified, rectifier.camera, se3_inverse(true.T_left_right)
    points = view.triangulate(uvd) @ rectifier.R_rectified_left
    in_right = transform_points(T_right_left, points)
    rays_left = calibrated.left.unproject(true.left.project(points)) @ rectifier.R_rectified_left.T
    rays_right = calibrated.right.unproject(true.right.project(in_right)) @ rectifier.R_rectified_right.T
    seen, seen_right = view.project(rays_left), view.project(rays_right)
    return np.column_stack([seen[:, :2], seen[:, 0] - seen_right[:, 0]])


def nearest_errors(calibrated: StereoCamera, true: StereoCamera) -> np.ndarray:
    """(15,) errors of the tracker that come nearest to what a calibration has wrong, fitted as a covariance is."""
    rectifier = StereoRectifier(calibrated)
    uvd = compared_places(rectifier.rectified)
    wrong = (measured_places(uvd, true, rectifier) - uvd).ravel()
    usable = np.isfinite(wrong)
    by_error = measured_errors(rectifier.rectified, uvd).reshape(-1, len(ERRORS))[usable]
    return np.asarray(np.linalg.lstsq(by_error, wrong[usable], rcond=None)[0])
