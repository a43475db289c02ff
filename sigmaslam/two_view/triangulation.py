"""Points from two calibrated views: parallel stereo, midpoint, linear least squares, optimal; with covariance (9.3)."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rigid_motion, skew
from sigmaslam.geometry.uncertainty import propagate

# Gauss-Newton from the linear solution; it converges quadratically where a point has any parallax.
_STEPS = 8
# A pair is parallel where nothing departs by more than this from one, relative to the focal length and the baseline.
_PARALLEL = 1e-6


@dataclass(frozen=True, slots=True)
class TwoViews:
    """Two pinhole cameras.

    Attributes:
        K0, K1: (3, 3) intrinsics.
        T_1_0: (4, 4) takes points of camera 0 into camera 1.
    """

    K0: np.ndarray
    K1: np.ndarray
    T_1_0: np.ndarray

    @property
    def fundamental(self) -> np.ndarray:
        """F (3, 3) with p1^T F p0 = 0 for homogeneous pixels (9.31)."""
        E = skew(self.T_1_0[:3, 3]) @ self.T_1_0[:3, :3]
        return np.asarray(np.linalg.inv(self.K1).T @ E @ np.linalg.inv(self.K0))

    def project(self, points: np.ndarray) -> np.ndarray:
        """(..., 4) pixels (u0, v0, u1, v1) of points (..., 3) in camera 0."""
        in_first = points @ self.K0.T
        in_second = (points @ self.T_1_0[:3, :3].T + self.T_1_0[:3, 3]) @ self.K1.T
        return np.concatenate([each[..., :2] / each[..., 2:] for each in (in_first, in_second)], axis=-1)


def triangulate_parallel(views: TwoViews, pixels: np.ndarray) -> np.ndarray:
    """Points (..., 3) of a rectified pair by (9.34): mean of the rows, difference of the columns.

    Args:
        views: one K, the same orientation, camera 1 along the x axis.
        pixels: (..., 4) (u0, v0, u1, v1).
    Raises:
        ValueError: the views are not parallel, or a disparity is not positive.
    """
    K, baseline = views.K0, -float(views.T_1_0[0, 3])
    ideal = rigid_motion(np.eye(3), [-baseline, 0.0, 0.0])
    off = np.abs(views.T_1_0 - ideal).max() / abs(baseline) + np.abs(views.K1 - K).max() / K[0, 0]
    if off > _PARALLEL or baseline <= 0.0:
        raise ValueError("the views are not a rectified pair: rectify them first, or use another method")
    u0, v0, u1, v1 = np.moveaxis(pixels, -1, 0)
    camera = RectifiedStereo(K[0, 0], K[1, 1], K[0, 2], K[1, 2], baseline, 0, 0)
    return camera.triangulate(np.stack([u0, 0.5 * (v0 + v1), u0 - u1], axis=-1))


def triangulate_midpoint(views: TwoViews, pixels: np.ndarray) -> np.ndarray:
    """Points (..., 3) in the middle of the shortest line between the rays of pixels (..., 4), (u0, v0, u1, v1)."""
    rays0, rays1 = _rays(views, pixels)
    R, t = views.T_1_0[:3, :3], views.T_1_0[:3, 3]
    # In camera 0: ray 0 starts at zero, ray 1 at the other centre.
    centre, direction = -t @ R, rays1 @ R
    aa, bb = (rays0 * rays0).sum(axis=-1), (direction * direction).sum(axis=-1)
    ab, a, b = (rays0 * direction).sum(axis=-1), rays0 @ centre, direction @ centre
    determinant = aa * bb - ab * ab
    with np.errstate(divide="ignore", invalid="ignore"):
        along0, along1 = (bb * a - ab * b) / determinant, (ab * a - aa * b) / determinant
    return np.asarray(0.5 * (along0[..., None] * rays0 + centre + along1[..., None] * direction))


def triangulate_linear(views: TwoViews, pixels: np.ndarray) -> np.ndarray:
    """Points (..., 3) of (u0, v0, u1, v1) (..., 4) by least squares of homogeneous equations (OpenCV's)."""
    rays0, rays1 = _rays(views, pixels)
    shape = rays0.shape
    flat0, flat1 = (np.ascontiguousarray(rays.reshape(-1, 3)[:, :2].T) for rays in (rays0, rays1))
    if not flat0.size:
        return np.zeros(shape)
    homogeneous = cv2.triangulatePoints(np.eye(4)[:3], views.T_1_0[:3], flat0, flat1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((homogeneous[:3] / homogeneous[3]).T.reshape(shape))


def triangulate_optimal(views: TwoViews, pixels: np.ndarray, covariance: np.ndarray | None = None) -> np.ndarray:
    """Points (..., 3) that minimise the reprojection error in units of its noise: the maximum likelihood (9.3).

    Gauss-Newton over direction and inverse depth in camera 0, which also holds for far points. With equal noise of all
    coordinates it is what Hartley and Sturm (1997) find.

    Args:
        pixels: (..., 4) (u0, v0, u1, v1).
        covariance: (..., 4, 4) of them; None: equal and independent.
    Returns:
        NaN for points that are not in front of camera 0.
    """
    start = triangulate_linear(views, pixels)
    weight = np.eye(4) if covariance is None else np.linalg.inv(covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        state = np.stack([start[..., 0], start[..., 1], np.ones(start.shape[:-1])], axis=-1) / start[..., 2:]
    state = np.where(np.isfinite(state), state, 0.0)
    for _ in range(_STEPS):
        expected, J = _project_inverse_depth(views, state)
        weighted = np.swapaxes(J, -1, -2) @ weight
        normal = weighted @ J
        normal += 1e-12 * np.trace(normal, axis1=-2, axis2=-1)[..., None, None] * np.eye(3)  # of a pair that diverges
        step = np.linalg.solve(normal, weighted @ (pixels - expected)[..., None])[..., 0]
        state = state + np.where(np.isfinite(step), step, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.concatenate([state[..., :2], np.ones_like(state[..., :1])], axis=-1) / state[..., 2:]
    return np.where(state[..., 2:] > 0.0, points, np.nan)


METHODS: dict[str, Callable[[TwoViews, np.ndarray], np.ndarray]] = {
    "parallel": triangulate_parallel,
    "midpoint": triangulate_midpoint,
    "linear": triangulate_linear,
    "optimal": triangulate_optimal,
}
"""By name."""


def triangulate(
    views: TwoViews, pixels: np.ndarray, covariance: np.ndarray, method: str = "optimal"
) -> tuple[np.ndarray, np.ndarray]:
    """Points in camera 0 with their covariance, to first order (9.35).

    Args:
        pixels: (..., 4) (u0, v0, u1, v1).
        covariance: (..., 4, 4) of them.
        method: of `METHODS`.
    Returns:
        (..., 3) metres and (..., 3, 3).
    Raises:
        ValueError: there is no such method.
    """
    if method not in METHODS:
        raise ValueError(f"there is no method {method!r}: choose of {', '.join(METHODS)}")
    covariance = np.broadcast_to(covariance, (*pixels.shape, 4))
    if method == "optimal":
        return propagate(lambda moved: triangulate_optimal(views, moved, covariance), pixels, covariance)
    return propagate(lambda moved: METHODS[method](views, moved), pixels, covariance)


def _rays(views: TwoViews, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays (..., 3) of unit depth through pixels (..., 4), each in its camera."""
    pairs = ((views.K0, pixels[..., :2]), (views.K1, pixels[..., 2:]))
    first, second = (
        np.concatenate([each, np.ones_like(each[..., :1])], axis=-1) @ np.linalg.inv(K).T for K, each in pairs
    )
    return first, second


def _project_inverse_depth(views: TwoViews, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 4) of points (x / z, y / z, 1 / z) in camera 0, and their derivatives (..., 4, 3)."""
    ray = np.concatenate([state[..., :2], np.ones_like(state[..., :1])], axis=-1)
    R, t = views.T_1_0[:3, :3], views.T_1_0[:3, 3]
    first = ray @ views.K0.T
    second = (ray @ R.T + state[..., 2:] * t) @ views.K1.T
    by_first = views.K0[:2, :2] @ np.eye(3)[:2]
    by_second = views.K1 @ np.column_stack([R[:, :2], t])
    place = second[..., :2] / second[..., 2:]
    slope = (by_second[:2] - place[..., None] * by_second[2]) / second[..., 2:, None]
    J = np.concatenate([np.broadcast_to(by_first, slope.shape), slope], axis=-2)
    return np.concatenate([first[..., :2], place], axis=-1), J
