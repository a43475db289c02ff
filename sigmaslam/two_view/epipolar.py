"""Relative orientation of two calibrated views from matches: the 5-point method, then least squares by covariance."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from sigmaslam.estimation.clustered_errors import clustering
from sigmaslam.geometry.se3 import skew

MIN_MATCHES, MIN_PROBABILITY = 8, 0.5
"""Five fix the pose; three more must say so, too. What is more likely wrong than right has no vote."""
THRESHOLD = 1.0
"""The sampling consensus accepts this epipolar distance, pixels: within a pixel keypoints are found."""
# Of five matches: 0.999 sure of a right one where 0.43 of the probable matches are right.
_SAMPLES = 500
# Gauss-Newton stops after so many steps; the loss slows it down from quadratic to linear convergence.
_ITERATIONS = 12
# Or when no component of a step is larger than this, radians: a hundredth of a pixel.
_CONVERGED = 1e-5
# About this many matches choose among the poses of an essential matrix, and test for a plane.
_SUBSET = 100
# A homography may be that of a plane if this share of the matches follow it within this distance, pixels. If the
# translation is smaller, relative to the distance of the plane, the homography is that of a rotation.
_PLANE_SHARE, _PLANE_THRESHOLD, _MIN_PARALLAX = 0.8, 2.0, 1e-3
# The scale of the robust loss, standard deviations of the epipolar distance: beyond it a match counts for a quarter.
_ROBUST = 2.0
# Of an inlier, likewise: 0.997 of the right matches are within it.
_INLIER = 3.0
SIGMA0 = 0.1
"""Keypoints in image 0 have this standard deviation, pixels."""


@dataclass(frozen=True, slots=True)
class EpipolarPose:
    """Where camera 0 is seen from camera 1, up to scale.

    Attributes:
        R: (3, 3) rotation, takes directions of camera 0 to camera 1.
        direction: (3,) unit vector, translation of the points of camera 0 in camera 1.
        inliers: (M,) bool, probable matches within three standard deviations of their epipolar lines whose rays meet
            in front of both cameras, or are parallel within their errors.
    """

    R: np.ndarray
    direction: np.ndarray
    inliers: np.ndarray


def estimate_epipolar_pose(
    K: np.ndarray, points0: np.ndarray, points1: np.ndarray, probability: np.ndarray, covariance: np.ndarray
) -> EpipolarPose | None:
    """Pose that the matches agree on, each weighted by its probability and covariance.

    The 5-point method in a sampling consensus over the probable matches gives the first pose (9.5.1). Iterated least
    squares of the epipolar distance over its standard deviation, with Geman and McClure's loss, refine it.

    Args:
        K: (3, 3) intrinsics of both images.
        points0, points1: (M, 2) pixels.
        probability: (M,) of the matches.
        covariance: (M, 2, 2) of points1, pixels squared.
    Returns:
        The pose; None with fewer than 8 probable matches, or if the 5-point method fails.
    """
    probable = np.flatnonzero(probability >= MIN_PROBABILITY)
    if len(probable) < MIN_MATCHES:
        return None
    points0, points1 = points0.astype(np.float64), points1.astype(np.float64)
    essential, mask = cv2.findEssentialMat(
        points0[probable],
        points1[probable],
        K,
        method=cv2.USAC_FAST,
        prob=0.999,
        threshold=THRESHOLD,
        maxIters=_SAMPLES,
    )
    # OpenCV returns None on failure, although its type hints exclude None.
    if np.shape(essential) != (3, 3):
        return None
    K_inverse = np.linalg.inv(K)
    rays0, rays1 = (np.c_[points, np.ones(len(points))] @ K_inverse.T for points in (points0, points1))
    agreeing = probable[mask.ravel() > 0]
    # The covariances are in the units of the rays.
    J = K_inverse[:2, :2]
    rays = MatchedRays(rays0, rays1, SIGMA0**2 * J @ J.T, J @ covariance.astype(np.float64) @ J.T)
    subset = agreeing[:: max(1, len(agreeing) // _SUBSET)]
    starts = [pose_of_essential(essential, rays0[subset], rays1[subset])]
    least = _PLANE_SHARE * len(subset)
    starts += poses_of_plane(K, points0[subset], points1[subset], cv2.USAC_FAST, _SAMPLES, least)
    best: EpipolarPose | None = None
    for start in starts:
        R, direction = _refine_pose(rays, probability, *start)
        near = (np.abs(rays.whitened(essential_matrix(R, direction))[0]) < _INLIER) & (probability >= MIN_PROBABILITY)
        for way in (direction, -direction):
            inliers = near & rays.in_front(R, way)
            if best is None or inliers.sum() > best.inliers.sum():
                best = EpipolarPose(R, way, inliers)
    return best


@dataclass(frozen=True, slots=True)
class MatchedRays:
    """Rays (M, 3) of the matches with third component 1, and the covariance of the other two: (2, 2) and (M, 2, 2).

    Homogeneous pixels will do as well, with the fundamental matrix.
    """

    rays0: np.ndarray
    rays1: np.ndarray
    spread0: np.ndarray
    spread1: np.ndarray

    def whitened(self, E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Epipolar residual over its standard deviation to first order (Sampson), and that deviation, both (M,)."""
        by1, by0 = self.rays0 @ E.T, self.rays1 @ E
        a, b, c, d = by1[:, 0], by1[:, 1], by0[:, 0], by0[:, 1]
        (uu0, uv0), (_, vv0) = self.spread0
        uu1, uv1, vv1 = self.spread1[:, 0, 0], self.spread1[:, 0, 1], self.spread1[:, 1, 1]
        variance = a * a * uu1 + 2.0 * a * b * uv1 + b * b * vv1 + c * c * uu0 + 2.0 * c * d * uv0 + d * d * vv0
        sigma = np.sqrt(np.maximum(variance, 1e-24))
        return (self.rays1 * by1).sum(axis=1) / sigma, sigma

    def chosen(self, rows: np.ndarray) -> Self:
        """Some of the matches."""
        return replace(self, rays0=self.rays0[rows], rays1=self.rays1[rows], spread1=self.spread1[rows])

    def in_front(self, R: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """(M,) bool, whether the rays meet in front of both cameras, or are parallel within their errors."""
        in_front, parallax = _depths_positive(self.rays0, self.rays1, R, direction)
        variance = np.trace(self.spread1, axis1=1, axis2=2) + np.trace(self.spread0)
        return np.asarray(in_front | (parallax < _INLIER**2 * variance))


def pose_of_essential(essential: np.ndarray, rays0: np.ndarray, rays1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The one of the four poses of an essential matrix that puts most points in front of both cameras."""
    Ra, Rb, direction = cv2.decomposeEssentialMat(essential)
    return most_in_front([(Ra, direction.ravel()), (Rb, direction.ravel())], rays0, rays1)


def most_in_front(
    poses: Sequence[tuple[np.ndarray, np.ndarray]], rays0: np.ndarray, rays1: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The pose, of those with these directions or the opposite ones, with most points in front of both cameras."""
    signed = [(R, sign * direction) for R, direction in poses for sign in (1.0, -1.0)]
    return max(signed, key=lambda pose: int(_depths_positive(rays0, rays1, *pose)[0].sum()))


def poses_of_plane(
    K: np.ndarray, points0: np.ndarray, points1: np.ndarray, method: int, samples: int, least: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotations and directions that a plane allows, if one homography explains so many of the matches; else none.

    Two poses explain the matches of a plane, and the 5-point method gives either. A homography may be that of a turn.
    Each direction stands for the opposite one as well, of the same epipolar lines.
    """
    if len(points0) < MIN_MATCHES:
        return []
    H, near = cv2.findHomography(points0, points1, method, _PLANE_THRESHOLD, maxIters=samples)
    if np.shape(H) != (3, 3) or near.sum() < least:
        return []
    _, rotations, translations, _ = cv2.decomposeHomographyMat(H, K)
    lengths = [float(np.linalg.norm(translation)) for translation in translations]
    return [
        (np.asarray(R), translation.ravel() / length)
        for R, translation, length in zip(rotations, translations, lengths, strict=True)
        if length > _MIN_PARALLAX
    ][::2]


def _refine_pose(
    rays: MatchedRays, probability: np.ndarray, R: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Newton over the five degrees of freedom, with a robust loss."""
    for _ in range(_ITERATIONS):
        residual, J, tangent = _slopes(rays, R, direction)
        weighted = J * (probability * robust_weight(residual))[:, None]
        normal = weighted.T @ J
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), weighted.T @ residual)
        R = cv2.Rodrigues(step[:3])[0] @ R
        direction = direction + tangent @ step[3:]
        direction = direction / np.linalg.norm(direction)
        if np.abs(step).max() < _CONVERGED:
            break
    return R, direction


def _slopes(rays: MatchedRays, R: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whitened residuals (M,), derivatives (M, 5) by rotation and direction, and the tangent (3, 2) of the latter."""
    residual, sigma = rays.whitened(essential_matrix(R, direction))
    turned = rays.rays0 @ R.T
    inner = (rays.rays1 * turned).sum(axis=1)
    by_rotation = (turned @ direction)[:, None] * rays.rays1 - inner[:, None] * direction
    tangent = np.linalg.svd(direction[None])[2][1:].T
    by_direction = _cross(turned, rays.rays1) @ tangent
    return residual, np.concatenate([by_rotation, by_direction], axis=1) / sigma[:, None], tangent


def essential_matrix(R: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """E (3, 3) with ray1^T E ray0 = 0 (9.32)."""
    return np.asarray(skew(direction) @ R)


def robust_weight(residual: np.ndarray) -> np.ndarray:
    """Weights of Geman and McClure's loss, from residuals in standard deviations."""
    return np.asarray(1.0 / (1.0 + (residual / _ROBUST) ** 2) ** 2)


def soft_weight(squared: np.ndarray) -> np.ndarray:
    """Weights of least squares up to three standard deviations, from squared residuals; one half there, 0 beyond."""
    return np.asarray(1.0 / (1.0 + np.exp(np.minimum(0.5 * (squared - _INLIER**2), 50.0))))


def log_gain(squared: np.ndarray) -> np.ndarray:
    """What a match that is right adds to the log-likelihood; its slope has the weights of `soft_weight`."""
    return np.log1p(np.exp(np.minimum(0.5 * (_INLIER**2 - squared), 50.0)))


def neighbours_factor(pixels: np.ndarray, scores: np.ndarray, information: np.ndarray) -> float:
    """Factor, 1 or more, by which variances are too small because errors of neighbouring matches are alike.

    Args:
        pixels: (M, 2) of the matches in image 0.
        scores: (M, n) derivatives times whitened residuals, zero for outliers.
        information: (n, n) of the inliers.
    """
    corner = pixels.min(axis=0)
    width, height = np.ceil(pixels.max(axis=0) - corner + 1.0).astype(int).tolist()
    return max(1.0, clustering(pixels - corner, (width, height), scores, information))


def _depths_positive(
    rays0: np.ndarray, rays1: np.ndarray, R: np.ndarray, direction: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Whether rays meet in front of both cameras, and (sine of their angle times their lengths) squared, both (M,)."""
    turned = rays0 @ R.T
    # The depth z0 follows from rays1 x (z0 R rays0 + t) = 0, and z1 likewise.
    normal = _cross(rays1, turned)
    in_front = (_cross(rays1, direction) * normal).sum(axis=1) < 0
    in_front &= (_cross(turned, direction) * normal).sum(axis=1) < 0
    return in_front, (normal * normal).sum(axis=1)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (M, 3) of (M, 3) and (M, 3) or (3,); np.cross takes five times as long for few rows."""
    (a0, a1, a2), (b0, b1, b2) = a.T, b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)
