"""The map: landmarks, refined by every keyframe that saw them again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.window import KeyframeWindow, Landmarks


@dataclass(frozen=True, slots=True)
class PointMap:
    """Sparse map.

    Attributes:
        points: (M, 3) float64 in the world, metres.
        covariances: (M, 3, 3) metres squared, relative to the keyframe that saw the point first.
        observations: (M,) views that confirmed it.
    """

    points: np.ndarray
    covariances: np.ndarray
    observations: np.ndarray


def map_points(landmarks: Landmarks, window: KeyframeWindow, least_views: int = 3) -> PointMap:
    """Landmarks of the window that were seen often enough and are closer than half a pixel of disparity says."""
    uvd = window.true_disparity(landmarks.estimate)
    kept = (landmarks.views >= least_views) & (uvd[:, 2] > 0.5)
    uvd, landmarks = uvd[kept], landmarks.select(kept)
    points = window.camera.triangulate(uvd)
    poses = window.poses[landmarks.host]
    R = poses[:, :3, :3]
    jacobian = R @ _triangulation_jacobian(uvd, points, window.camera)
    jacobian = np.concatenate([jacobian, -jacobian[:, :, 2:]], axis=2)
    spread = jacobian @ landmarks.covariance @ jacobian.transpose(0, 2, 1)
    return PointMap((R @ points[..., None])[..., 0] + poses[:, :3, 3], spread, landmarks.views)


def merge_maps(parts: list[PointMap]) -> PointMap:
    """All points of all parts."""
    if not parts:
        return PointMap(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64))
    return PointMap(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.covariances for part in parts]),
        np.concatenate([part.observations for part in parts]),
    )


def _triangulation_jacobian(uvd: np.ndarray, points: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    """Derivative of (9.34) by (u, v, disparity), (K, 3, 3): the chapter's (9.35)."""
    depth, disparity = points[:, 2], uvd[:, 2]
    jacobian = np.zeros((len(uvd), 3, 3))
    jacobian[:, 0, 0] = depth / camera.fx
    jacobian[:, 1, 1] = depth / camera.fy
    jacobian[:, :, 2] = -points / disparity[:, None]
    return jacobian
