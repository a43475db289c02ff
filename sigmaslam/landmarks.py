"""The map: landmarks, refined by every keyframe that saw them again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.rotation import skew
from sigmaslam.tables import LANDMARK_SIZE, MODELLED, pose_slice
from sigmaslam.window import KeyframeWindow


@dataclass(frozen=True, slots=True)
class PointMap:
    """Sparse map.

    Attributes:
        points: (M, 3) float64 in the world, metres.
        covariances: (M, 3, 3) of them in the world, that of the keyframe's pose included, metres squared.
        observations: (M,) views that confirmed it.
        timestamps: (M,) of the keyframe that saw the point first, seconds.
        pixels: (M, 2) its place there, in the rectified left image.
    """

    points: np.ndarray
    covariances: np.ndarray
    observations: np.ndarray
    timestamps: np.ndarray
    pixels: np.ndarray

    @classmethod
    def empty(cls) -> PointMap:
        """No points."""
        flat = np.zeros(0)
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64), flat, np.zeros((0, 2)))

    def transform(self, T: np.ndarray) -> PointMap:
        """The map in another world, T (4, 4) takes this one there."""
        R = T[:3, :3]
        return replace(self, points=self.points @ R.T + T[:3, 3], covariances=R @ self.covariances @ R.T)


def thin_map(whole: PointMap, count: int) -> PointMap:
    """The `count` points that most views have confirmed, in their order."""
    kept = np.sort(np.argsort(-whole.observations, kind="stable")[:count])
    return PointMap(*(getattr(whole, name)[kept] for name in PointMap.__slots__))


def map_points(
    window: KeyframeWindow, chosen: np.ndarray, keyframe_times: np.ndarray, least_views: int = 3
) -> PointMap:
    """Landmarks of the window that were seen often enough and are closer than half a pixel of disparity says.

    Args:
        window: whose landmarks.
        chosen: (L,) bool, which of them.
        keyframe_times: (K,) time stamps of the window's keyframes.
        least_views: fewer do not count.
    """
    landmarks = window.landmarks
    uvd = window.true_disparity(landmarks.estimate)
    kept = chosen & (landmarks.views >= least_views) & (uvd[:, 2] > 0.5)
    uvd, landmarks = uvd[kept], landmarks.select(kept)
    if not len(landmarks):
        return PointMap.empty()
    points = window.camera.triangulate(uvd)
    R = window.poses[landmarks.host, :3, :3]
    by_disparity = R @ _triangulation_jacobian(uvd, points, window.camera)
    unmoved = np.zeros((len(points), 3, LANDMARK_SIZE - MODELLED))
    by_landmark = np.concatenate([by_disparity, -by_disparity[:, :, 2:], unmoved], axis=2)
    points = (R @ points[..., None])[..., 0] + window.poses[landmarks.host, :3, 3]
    by_state = by_landmark @ landmarks.dependence
    by_state[:, :, 0] -= by_disparity[:, :, 2]
    turn = skew(points)
    for host in np.unique(landmarks.host):
        own, place = landmarks.host == host, pose_slice(host)
        by_state[own, :, place.start : place.start + 3] += np.eye(3)
        by_state[own, :, place.start + 3 : place.stop] -= turn[own]
    covariances = by_state @ window.covariance @ by_state.transpose(0, 2, 1)
    covariances += by_landmark @ landmarks.covariance @ by_landmark.transpose(0, 2, 1)
    return PointMap(
        points, covariances, landmarks.views, keyframe_times[landmarks.host], landmarks.measured[:, :2].copy()
    )


def merge_maps(parts: list[PointMap]) -> PointMap:
    """All points of all parts."""
    parts = [PointMap.empty(), *parts]
    return PointMap(*(np.concatenate([getattr(part, name) for part in parts]) for name in PointMap.__slots__))


def _triangulation_jacobian(uvd: np.ndarray, points: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    """Derivative of (9.34) by (u, v, disparity), (K, 3, 3): the chapter's (9.35)."""
    depth, disparity = points[:, 2], uvd[:, 2]
    jacobian = np.zeros((len(uvd), 3, 3))
    jacobian[:, 0, 0] = depth / camera.fx
    jacobian[:, 1, 1] = depth / camera.fy
    jacobian[:, :, 2] = -points / disparity[:, None]
    return jacobian
