"""Relative pose of two calibrated views from judged matches: the 5-point method, then least squares by covariance."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.rotation import skew

_LEAST_MATCHES = 8
_LEAST_PROBABILITY = 0.5
# Of the sampling stage, pixels and iterations: few matches are wrong by then.
_THRESHOLD = 1.0
_SAMPLES = 500
_ITERATIONS = 12
_CONVERGED = 1e-5  # radians
# So many matches say which side of the cameras the scene is on.
_ASKED = 100
# Scale of the robust loss and bound of an inlier, in standard deviations of the epipolar distance.
_ROBUST = 2.0
_INLIER = 3.0
# What a place in image 0 is uncertain by, pixels.
_SIGMA0 = 0.1


@dataclass(frozen=True, slots=True)
class EpipolarPose:
    """Where camera 0 is seen from camera 1, up to scale.

    Attributes:
        R: (3, 3) rotation, takes directions of camera 0 to camera 1.
        direction: (3,) unit vector, translation of the points of camera 0 in camera 1.
        inliers: (M,) bool, matches within three standard deviations of their epipolar lines and in front of both.
    """

    R: np.ndarray
    direction: np.ndarray
    inliers: np.ndarray


def estimate_epipolar_pose(
    K: np.ndarray, points0: np.ndarray, points1: np.ndarray, probability: np.ndarray, covariance: np.ndarray
) -> EpipolarPose | None:
    """Pose that the matches agree on, each by its probability and covariance.

    The 5-point method in a sampling consensus over the probable matches begins (9.5.1); iterated least squares of the
    epipolar distance over its standard deviation, with Geman and McClure's loss, follow.

    Args:
        K: (3, 3) intrinsics of both images.
        points0, points1: (M, 2) pixels.
        probability: (M,) of the matches.
        covariance: (M, 2, 2) of points1, pixels squared.
    Returns:
        None with fewer than 8 probable matches, or where no pose is found.
    """
    probable = np.flatnonzero(probability >= _LEAST_PROBABILITY)
    if len(probable) < _LEAST_MATCHES:
        return None
    points0, points1 = points0.astype(np.float64), points1.astype(np.float64)
    cv2.setRNGSeed(0)
    essential, mask = cv2.findEssentialMat(
        points0[probable],
        points1[probable],
        K,
        method=cv2.USAC_FAST,
        prob=0.999,
        threshold=_THRESHOLD,
        maxIters=_SAMPLES,
    )
    # OpenCV gives None where it finds nothing, against its own type hints.
    if np.shape(essential) != (3, 3):
        return None
    K_inverse = np.linalg.inv(K)
    rays0, rays1 = (np.c_[points, np.ones(len(points))] @ K_inverse.T for points in (points0, points1))
    some = probable[mask.ravel() > 0][:_ASKED]
    R, direction = _most_in_front(essential, rays0[some], rays1[some])
    # Covariances in the units of the rays.
    J = K_inverse[:2, :2]
    views = _Views(rays0, rays1, _SIGMA0**2 * J @ J.T, J @ covariance.astype(np.float64) @ J.T)
    R, direction = _polish(views, probability, R, direction)
    residual = views.whitened(R, direction)[0]
    inliers = (np.abs(residual) < _INLIER) & (probability >= _LEAST_PROBABILITY) & _in_front(rays0, rays1, R, direction)
    return EpipolarPose(R, direction, inliers)


@dataclass(frozen=True, slots=True)
class _Views:
    """Rays (M, 3) of the matches with third component 1, and the covariance of the other two: (2, 2) and (M, 2, 2)."""

    rays0: np.ndarray
    rays1: np.ndarray
    spread0: np.ndarray
    spread1: np.ndarray

    def whitened(self, R: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Epipolar residual over its standard deviation to first order (Sampson), and that, both (M,)."""
        E = skew(direction) @ R
        by1, by0 = self.rays0 @ E.T, self.rays1 @ E
        a, b, c, d = by1[:, 0], by1[:, 1], by0[:, 0], by0[:, 1]
        (uu0, uv0), (_, vv0) = self.spread0
        uu1, uv1, vv1 = self.spread1[:, 0, 0], self.spread1[:, 0, 1], self.spread1[:, 1, 1]
        variance = a * a * uu1 + 2.0 * a * b * uv1 + b * b * vv1 + c * c * uu0 + 2.0 * c * d * uv0 + d * d * vv0
        sigma = np.sqrt(np.maximum(variance, 1e-24))
        return (self.rays1 * by1).sum(axis=1) / sigma, sigma


def _most_in_front(essential: np.ndarray, rays0: np.ndarray, rays1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the four poses of an essential matrix the one that puts most points in front of both cameras."""
    Ra, Rb, direction = cv2.decomposeEssentialMat(essential)
    poses = [(R, sign * direction.ravel()) for R in (Ra, Rb) for sign in (1.0, -1.0)]
    return max(poses, key=lambda pose: int(_in_front(rays0, rays1, *pose).sum()))


def _polish(
    views: _Views, probability: np.ndarray, R: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton over the five degrees of freedom, with iterated weights."""
    for _ in range(_ITERATIONS):
        residual, sigma = views.whitened(R, direction)
        turned = views.rays0 @ R.T
        inner = (views.rays1 * turned).sum(axis=1)
        by_rotation = (turned @ direction)[:, None] * views.rays1 - inner[:, None] * direction
        tangent = np.linalg.svd(direction[None])[2][1:].T
        by_direction = _cross(turned, views.rays1) @ tangent
        J = np.concatenate([by_rotation, by_direction], axis=1) / sigma[:, None]
        weighted = J * (probability / (1.0 + (residual / _ROBUST) ** 2) ** 2)[:, None]
        normal = weighted.T @ J
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), weighted.T @ residual)
        R = cv2.Rodrigues(step[:3])[0] @ R
        direction = direction + tangent @ step[3:]
        direction = direction / np.linalg.norm(direction)
        if np.abs(step).max() < _CONVERGED:
            break
    return R, direction


def _in_front(rays0: np.ndarray, rays1: np.ndarray, R: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Whether the rays meet before both cameras, or nearly in parallel."""
    turned = rays0 @ R.T
    # Depth z0 from rays1 x (z0 R rays0 + t) = 0, and likewise z1.
    normal = _cross(rays1, turned)
    square = np.maximum((normal * normal).sum(axis=1), 1e-12)
    depth0 = -(_cross(rays1, direction) * normal).sum(axis=1) / square
    depth1 = -(_cross(turned, direction) * normal).sum(axis=1) / square
    return np.asarray((depth0 > 0) & (depth1 > 0))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (M, 3) of (M, 3) and (M, 3) or (3,): numpy's own takes five times as long for few."""
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)
