"""Relative pose without a prediction (9.5.1): 5-point method with scale from stereo, checked against P3P."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.epipolar import estimate_epipolar_pose
from sigmaslam.rotation import se3_inverse

_THRESHOLD = 2.0  # pixels
_LEAST_POINTS = 8
# Depth from less disparity than this says nothing about scale.
_LEAST_DISPARITY = 1.0


@dataclass(frozen=True, slots=True)
class RelativePose:
    """Pose between two views of a scene.

    Attributes:
        T_key_camera: (4, 4).
        inliers: (M,) bool, points that agree with it.
    """

    T_key_camera: np.ndarray
    inliers: np.ndarray


def estimate_relative_pose(
    camera: RectifiedStereo,
    landmarks: np.ndarray,
    measurement: np.ndarray,
    probability: np.ndarray,
    covariance: np.ndarray,
) -> RelativePose | None:
    """Pose of the current view in the keyframe, from stereo points and where they are seen now.

    The essential matrix uses far points and is blind to errors of depth, but fails without parallax; P3P on stereo
    points is the opposite. Both are tried and refined, the one that more points agree with is returned.

    Args:
        camera: the rectified pair.
        landmarks: (M, 3) (u, v, disparity) in the keyframe.
        measurement: (M, 3) now; disparity may be NaN.
        probability: (M,) that a match is right.
        covariance: (M, 2, 2) of its place now, pixels squared.
    Returns:
        None when fewer than eight points agree with either.
    """
    near = landmarks[:, 2] >= _LEAST_DISPARITY
    if near.sum() < _LEAST_POINTS:
        return None
    points = camera.triangulate(np.where(near[:, None], landmarks, [0.0, 0.0, 1.0]))
    best: RelativePose | None = None
    for guess in (
        _from_essential(camera, points, near, landmarks[:, :2], measurement[:, :2], probability, covariance),
        _from_points(camera, points[near], measurement[near, :2]),
    ):
        if guess is None:
            continue
        refined = _refine(camera, points, near, measurement, guess)
        if refined is not None and (best is None or refined.inliers.sum() > best.inliers.sum()):
            best = refined
    return best


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


def _from_points(camera: RectifiedStereo, points: np.ndarray, pixels: np.ndarray) -> np.ndarray | None:
    """T_camera_key from P3P in RANSAC."""
    cv2.setRNGSeed(0)
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points,
        np.ascontiguousarray(pixels),
        camera.matrix,
        None,
        flags=cv2.SOLVEPNP_AP3P,
        iterationsCount=500,
        reprojectionError=_THRESHOLD,
        confidence=0.9999,
    )
    return _pose(rotation, translation) if found else None


def _refine(
    camera: RectifiedStereo, points: np.ndarray, near: np.ndarray, measurement: np.ndarray, T_camera_key: np.ndarray
) -> RelativePose | None:
    """Levenberg-Marquardt on the points that agree, twice, because the first set is chosen by a rough pose."""
    for _ in range(2):
        inliers = near & _agree(camera, points, measurement, T_camera_key)
        if inliers.sum() < _LEAST_POINTS:
            return None
        rotation, _ = cv2.Rodrigues(T_camera_key[:3, :3])
        rotation, translation = cv2.solvePnPRefineLM(
            points[inliers],
            np.ascontiguousarray(measurement[inliers, :2]),
            camera.matrix,
            None,
            rotation,
            T_camera_key[:3, 3:].copy(),
        )
        T_camera_key = _pose(rotation, translation)
    inliers = near & _agree(camera, points, measurement, T_camera_key)
    if inliers.sum() < _LEAST_POINTS:
        return None
    return RelativePose(se3_inverse(T_camera_key), inliers)


def _agree(
    camera: RectifiedStereo, points: np.ndarray, measurement: np.ndarray, T_camera_key: np.ndarray
) -> np.ndarray:
    """Which points are seen where the pose says, in image and disparity, and in front."""
    seen = points @ T_camera_key[:3, :3].T + T_camera_key[:3, 3]
    front = seen[:, 2] > 1e-6
    expected = camera.project(np.where(front[:, None], seen, [0.0, 0.0, 1.0]))
    error = np.abs(expected - measurement)
    close = np.hypot(error[:, 0], error[:, 1]) <= _THRESHOLD
    # A disparity that is not known cannot disagree.
    return front & close & ~(error[:, 2] > 2.0 * _THRESHOLD)


def _pose(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = translation.ravel()
    return T
