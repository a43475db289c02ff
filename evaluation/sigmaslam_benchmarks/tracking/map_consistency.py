"""Errors of map points in sigmas, and means with their own errors."""

from collections.abc import Sequence

import numpy as np

from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.camera import RectifiedStereo

EDGE = 0.02
"""Where inverse depth bends by more than this share of itself within a pixel, a point's true depth is in doubt."""


def mean_with_error(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean of independent values and its standard error; values that are NaN do not count.

    The error of a single value is NaN.
    """
    valid = np.asarray(values, dtype=np.float64)
    valid = valid[~np.isnan(valid)]
    if len(valid) < 2:
        return (float(valid[0]) if len(valid) else float("nan")), float("nan")
    return float(valid.mean()), float(valid.std(ddof=1) / np.sqrt(len(valid)))


def ratio_with_error(values: Sequence[float], others: Sequence[float]) -> tuple[float, float]:
    """Geometric mean of values / others, paired, and its standard error, first order."""
    mean, error = mean_with_error(np.log(np.asarray(values) / np.asarray(others)))
    ratio = float(np.exp(mean))
    return ratio, ratio * error


def point_nees(points: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Normalised errors squared of points (M, 3) with covariances (M, 3, 3), per degree of freedom, (M,)."""
    return np.asarray(squared_mahalanobis(points - truth, covariances) / 3.0)


def depth_edges(depths: np.ndarray) -> np.ndarray:
    """Which points are at an edge of depth, where the true one hangs on fractions of a pixel; (M,) bool.

    Inverse depth is affine in the pixel on a plane, however slanted; an edge bends it.

    Args:
        depths: (M, 3, 3) z at the point and one pixel around it; inf where there is nothing.
    """
    inverse = 1.0 / depths
    centre = inverse[:, 1, 1]
    opposite = inverse + inverse[:, ::-1, ::-1]
    bend = np.abs(opposite - 2.0 * centre[:, None, None]).max(axis=(1, 2))
    return np.asarray(~np.isfinite(depths).all(axis=(1, 2)) | (bend > EDGE * centre))


def points_of_depth(pixels: np.ndarray, depths: np.ndarray, camera: RectifiedStereo, poses: np.ndarray) -> np.ndarray:
    """World points (M, 3) at pixels (M, 2) and depths (M,) of left cameras with poses T_world_camera (M, 4, 4)."""
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    points = np.column_stack([x * depths, y * depths, depths])
    return np.asarray((poses[:, :3, :3] @ points[..., None])[..., 0] + poses[:, :3, 3])
