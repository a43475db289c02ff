"""Absolute orientation: the motion between two frames from points that are known in both (9.2.3.3)."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.geometry.se3 import skew

# Beyond this condition number something is free: of points on a line, the rotation about it.
_MAX_CONDITION = 1e12


@dataclass(frozen=True, slots=True)
class AbsoluteOrientation:
    """target = scale R source + translation.

    Attributes:
        R: (3, 3) rotation.
        translation: (3,).
        scale: 1 for a rigid motion.
        covariance: (6, 6), or (7, 7) with a scale: of translation, rotation vector (exp(r) R) and the logarithm of the
            scale, about the centroid of the target points. Without a sigma the residuals give its size, NaN where there
            are no more points than needed. Infinite where the points leave something free.
    """

    R: np.ndarray
    translation: np.ndarray
    scale: float
    covariance: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the source frame in the target frame."""
        return np.asarray(self.scale * points @ self.R.T + self.translation)


def absolute_orientation(
    source: np.ndarray,
    target: np.ndarray,
    weight: np.ndarray | None = None,
    with_scale: bool = False,
    sigma: float | None = None,
) -> AbsoluteOrientation:
    """Rigid motion or similarity that minimises the weighted sum of |scale R source + translation - target|^2.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. Of points on
    a line or in one place, one of the many best rotations is given.

    Args:
        source, target: (N, 3) control points in either frame.
        weight: (N,) inverse variances, relative; None: equal.
        with_scale: a similarity.
        sigma: standard deviation of each coordinate of a target point of weight 1, in place of the residuals'.
    Raises:
        ValueError: shapes differ, a weight is negative, or all are zero.
    """
    source, target = np.asarray(source, float), np.asarray(target, float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"points must both be (N, 3); got {source.shape} and {target.shape}")
    weight = np.ones(len(source)) if weight is None else np.asarray(weight, float)
    if weight.shape != (len(source),) or (weight < 0.0).any() or not weight.any():
        raise ValueError(f"weights must be ({len(source)},), none negative and not all zero; got {weight}")
    share = weight / weight.sum()
    source_mean, target_mean = share @ source, share @ target
    from_mean, to_mean = source - source_mean, target - target_mean
    u, values, vt = np.linalg.svd((share[:, None] * to_mean).T @ from_mean)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    R = (u * sign) @ vt
    scale = float((values * sign).sum() / (share @ (from_mean**2).sum(axis=1))) if with_scale else 1.0
    moved = scale * from_mean @ R.T
    by_rotation = -skew(moved)
    J = np.concatenate([np.tile(np.eye(3), (len(source), 1, 1)), by_rotation, moved[..., None]], axis=2)
    J = J[:, :, : 7 if with_scale else 6]
    information = np.einsum("n,nai,naj->ij", weight, J, J)
    freedom = 3 * int((weight > 0.0).sum()) - J.shape[2]
    if sigma is None:
        squared = float(weight @ ((to_mean - moved) ** 2).sum(axis=1))
        sigma = np.sqrt(squared / freedom) if freedom > 0 else np.nan
    regular = np.linalg.cond(information) < _MAX_CONDITION
    covariance = sigma**2 * np.linalg.inv(information) if regular else np.full(information.shape, np.inf)
    return AbsoluteOrientation(R, target_mean - scale * R @ source_mean, scale, covariance)
