"""Relative pose without a prediction (9.5.1): 5-point method with scale from stereo, checked against P3P."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, skew
from sigmaslam.two_view.epipolar import estimate_epipolar_pose

# Of P3P, pixels: the second tells what moves slowly from what stands still.
_THRESHOLDS = (2.0, 0.5)
# By how much matches may be better than they claim, as a factor of variances.
_LEAST_SCALE = 1.0 / 16.0
_LEAST_POINTS = 8
# Of the refinement: steps, and scale of the robust loss in standard deviations, from the first to the last.
_STEPS, _FIRST_SCALE, _NARROWING, _LAST_SCALE = 10, 8.0, 0.75, 2.0
_WORST_CONDITION = 1e14
# Depth from less disparity than this says nothing about scale.
_LEAST_DISPARITY = 1.0


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Pose between two views of a scene.

    Attributes:
        T_key_camera: (4, 4).
        inliers: (M,) bool, points that agree with it.
        covariance: (6, 6) of x in T_key_camera exp(x), x = (translation, rotation), from the inliers' noise.
        scale: 1 or less; how much smaller than claimed the variances of most points are.
    """

    T_key_camera: np.ndarray
    inliers: np.ndarray
    covariance: np.ndarray
    scale: float


def estimate_relative_pose(
    camera: RectifiedStereo,
    landmarks: np.ndarray,
    landmark_sigma: np.ndarray,
    measurement: np.ndarray,
    noise: np.ndarray,
    probability: np.ndarray,
) -> RelativePose | None:
    """Pose of the current view in the keyframe, from stereo points and where they are seen now.

    The essential matrix uses far points and is blind to errors of depth, but fails without parallax; P3P on stereo
    points is the opposite. Both are tried and refined, the one with the smallest misfit is returned: the sum of squared
    errors in sigmas, at most a gate's each. The number of inliers would not do: with a turn in place of a shift, a pose
    may agree a little with a mover and with the scene alike. Nor would sigmas as they are claimed where matches are
    better: they are scaled by what half of the points agree to.

    Args:
        camera: the rectified pair.
        landmarks: (M, 3) (u, v, disparity) in the keyframe.
        landmark_sigma: (M, 3) their standard deviations, pixels.
        measurement: (M, 3) now; disparity may be NaN.
        noise: (M, 3, 3) covariance of the measurement, pixels squared.
        probability: (M,) that a match is right.
    Returns:
        None when fewer than eight points agree with either.
    """
    near = landmarks[:, 2] >= _LEAST_DISPARITY
    if near.sum() < _LEAST_POINTS:
        return None
    points = camera.triangulate(np.where(near[:, None], landmarks, [0.0, 0.0, 1.0]))
    views = _Views(camera, landmarks, landmark_sigma, measurement, noise, near * probability)
    near_points, near_pixels = points[near], np.ascontiguousarray(measurement[near, :2])
    tried = [
        _from_essential(camera, points, near, landmarks[:, :2], measurement[:, :2], probability, noise[:, :2, :2]),
        *(_from_points(camera, near_points, near_pixels, threshold) for threshold in _THRESHOLDS),
    ]
    guesses = [guess for guess in tried if guess is not None and np.isfinite(guess).all()]
    if not guesses:
        return None
    scale = min(_agreed_scale(views.weight, _squared_errors(views, guess)) for guess in guesses)
    refined = [T for guess in guesses if (T := _refine(views, guess, scale)) is not None]
    if not refined:
        return None
    errors = [_squared_errors(views, T) for T in refined]
    scale = min(_agreed_scale(views.weight, squared) for squared in errors)
    # Squared errors in sigmas by the points' weights, at most a gate's each.
    misfit = [float(views.weight @ np.minimum(squared / scale, CHI_SQUARE_999[3])) for squared in errors]
    best = int(np.argmin(misfit))
    return _agreed(views, refined[best], errors[best], scale)


def _from_essential(
    camera: RectifiedStereo,
    points: np.ndarray,
    near: np.ndarray,
    pixels_key: np.ndarray,
    pixels: np.ndarray,
    probability: np.ndarray,
    covariance: np.ndarray,
) -> np.ndarray | None:
    """T_camera_key from the matches alone; the length of the translation from stereo depth."""
    pose = estimate_epipolar_pose(camera.matrix, pixels_key, pixels, probability, covariance)
    if pose is None:
        return None
    R, direction = pose.R, pose.direction
    used = near & pose.inliers
    if used.sum() < _LEAST_POINTS:
        return None
    # x ~ R X + s t: cross product with the ray leaves one unknown, s, per point; the median is robust.
    rays = np.linalg.solve(camera.matrix, np.c_[pixels[used], np.ones(used.sum())].T).T
    constant = np.cross(rays, points[used] @ R.T)
    slope = np.cross(rays, direction)
    strength = np.einsum("ij,ij->i", slope, slope)
    scales = -np.einsum("ij,ij->i", slope, constant) / np.maximum(strength, 1e-12)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = max(float(np.median(scales)), 0.0) * direction
    return T


def _from_points(
    camera: RectifiedStereo, points: np.ndarray, pixels: np.ndarray, threshold: float
) -> np.ndarray | None:
    """T_camera_key from P3P in RANSAC."""
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        flags=cv2.SOLVEPNP_AP3P,
        iterationsCount=500,
        reprojectionError=threshold,
        confidence=0.9999,
    )
    return _pose(rotation, translation) if found else None


@dataclass(frozen=True, slots=True)
class _Views:
    """Stereo points and where they are seen now; arguments as of `estimate_relative_pose`, weight 0 for far points."""

    camera: RectifiedStereo
    landmarks: np.ndarray
    landmark_sigma: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray
    weight: np.ndarray

    def linearise(self, T_camera_key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual (M, 3), its derivative by a perturbation of T from the left (M, 3, 6), and information (M, 3, 3).

        What is not known, and all of a point behind the camera, has no information.
        """
        camera = self.camera
        focal = camera.fx * camera.baseline
        # Scaled by inverse depth, points at infinity do no harm.
        ray = np.column_stack(
            [
                (self.landmarks[:, 0] - camera.cx) / camera.fx,
                (self.landmarks[:, 1] - camera.cy) / camera.fy,
                np.ones(len(self.landmarks)),
            ]
        )
        inverse_depth = self.landmarks[:, 2] / focal
        R, t = T_camera_key[:3, :3], T_camera_key[:3, 3]
        seen = ray @ R.T + inverse_depth[:, None] * t
        front = seen[:, 2] > 1e-6
        x, y, z = np.where(front[:, None], seen, [0.0, 0.0, 1.0]).T
        predicted = np.column_stack(
            [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, focal * inverse_depth / z]
        )
        by_seen = np.zeros((len(z), 3, 3))
        by_seen[:, 0, 0], by_seen[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
        by_seen[:, 1, 1], by_seen[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
        by_seen[:, 2, 2] = -focal * inverse_depth / z**2
        by_pose = np.concatenate([by_seen * inverse_depth[:, None, None], -by_seen @ skew(seen)], axis=2)
        by_landmark = by_seen @ np.stack(
            [
                np.tile(R[:, 0] / camera.fx, (len(z), 1)),
                np.tile(R[:, 1] / camera.fy, (len(z), 1)),
                np.tile(t / focal, (len(z), 1)),
            ],
            axis=2,
        )
        by_landmark[:, 2, 2] += 1.0 / z
        spread = self.noise + (by_landmark * (self.landmark_sigma**2)[:, None, :]) @ by_landmark.transpose(0, 2, 1)
        residual = self.measurement - predicted
        known = np.isfinite(residual) & front[:, None]
        present = known[:, :, None] & known[:, None, :]
        information = np.where(present, np.linalg.inv(np.where(present, spread, np.eye(3))), 0.0)
        return np.where(known, residual, 0.0), by_pose, information


def _refine(views: _Views, T_camera_key: np.ndarray, variance: float) -> np.ndarray | None:
    """Gauss-Newton on the stereo points by their covariances, with a robust loss that narrows from step to step.

    Args:
        views: the points.
        T_camera_key: (4, 4) where it begins.
        variance: of the loss, in units of what is claimed.
    """
    scale = _FIRST_SCALE
    for _ in range(_STEPS):
        residual, by_pose, information = views.linearise(T_camera_key)
        squared = np.einsum("mi,mij,mj->m", residual, information, residual)
        weight = views.weight / (1.0 + squared / (variance * scale**2)) ** 2
        weighted = by_pose.transpose(0, 2, 1) @ (information * weight[:, None, None])
        normal = (weighted @ by_pose).sum(axis=0)
        gradient = np.einsum("mij,mj->i", weighted, residual)
        if not np.linalg.cond(normal) < _WORST_CONDITION:
            return None
        T_camera_key = se3_exp(np.linalg.solve(normal, gradient)) @ T_camera_key
        scale = max(_NARROWING * scale, _LAST_SCALE)
    return T_camera_key


def _squared_errors(views: _Views, T_camera_key: np.ndarray) -> np.ndarray:
    """(M,) in sigmas; infinite behind the camera."""
    residual, _, information = views.linearise(T_camera_key)
    squared = np.einsum("mi,mij,mj->m", residual, information, residual)
    return np.where(np.trace(information, axis1=1, axis2=2) > 0, squared, np.inf)


def _agreed_scale(weight: np.ndarray, squared: np.ndarray) -> float:
    """How much smaller than claimed the variances of most points are, by the median of their errors; 1 at most."""
    order = np.argsort(squared)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(np.clip(squared[order[half]] / CHI_SQUARE_MEDIAN[3], _LEAST_SCALE, 1.0))


def _agreed(views: _Views, T_camera_key: np.ndarray, squared: np.ndarray, scale: float) -> RelativePose | None:
    """The pose with what agrees with it by its squared errors (M,), and its covariance as the points claim theirs."""
    inliers = (views.weight > 0) & (squared < scale * CHI_SQUARE_999[3])
    if inliers.sum() < _LEAST_POINTS:
        return None
    _, by_pose, information = views.linearise(T_camera_key)
    agreeing = by_pose[inliers]
    normal = (agreeing.transpose(0, 2, 1) @ information[inliers] @ agreeing).sum(axis=0)
    if not np.linalg.cond(normal) < _WORST_CONDITION:
        return None
    return RelativePose(se3_inverse(T_camera_key), inliers, np.linalg.inv(normal), scale)


def _pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = translation.ravel()
    return T
