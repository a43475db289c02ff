"""The map: landmarks, refined by every keyframe that saw them again."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.gaussian import project_covariance
from sigmaslam.past import PastPoses, past_slice, point_lever
from sigmaslam.rotation import se3_inverse, turn_covariance
from sigmaslam.tables import LANDMARK_SIZE, MODELLED, pose_slice
from sigmaslam.window import KeyframeWindow

# A keypoint may lie on either end of what its patch shows: standard deviation of its disparity, over that range.
_EITHER_SURFACE = 0.5


@dataclass(frozen=True, slots=True)
class PointMap:
    """Sparse map.

    Attributes:
        points: (M, 3) float64 in the world, metres.
        covariances: (M, 3, 3) of them in the world, that of the keyframe's pose and what surfaces vary by around them
            included, metres squared.
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

    def select(self, index: np.ndarray) -> PointMap:
        """The points of that index or mask."""
        return PointMap(*(getattr(self, name)[index] for name in self.__slots__))


class RetiredPoints:
    """Points that left the window, each in the frame of a remembered keyframe: they move with it.

    Args:
        most: when there are twice as many, the least confirmed half goes.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        # Parts by keyframe, in the order of `PastPoses`.
        self._parts: list[list[PointMap]] = []

    def __len__(self) -> int:
        return sum(len(part.points) for parts in self._parts for part in parts)

    def append(self, points: PointMap) -> None:
        """Takes points in the frame of a keyframe that has just been remembered, with covariances given its pose."""
        self._parts.append([points])
        if len(self) > 2 * self._most:
            self._thin()

    def drop(self, index: int, past: PastPoses) -> None:
        """A keyframe is about to be forgotten: its points go to the one that they are known best from."""
        left = self._parts.pop(index)
        if len(past) < 2:
            return
        heir = past.closest(index)
        T = se3_inverse(past.poses[heir]) @ past.poses[index]
        # In the heir's frame, where the covariance of the step between them is wanted.
        step = turn_covariance(se3_inverse(past.poses[heir]), past.relative(index)[heir])
        heirs = self._parts[heir - (heir > index)]
        for part in left:
            part = part.transform(T)
            heirs.append(
                replace(part, covariances=part.covariances + project_covariance(point_lever(part.points), step))
            )

    def in_world(self, past: PastPoses) -> PointMap:
        """All of them, at what is known of the keyframes now."""
        whole = []
        for index, parts in enumerate(self._parts):
            place = past_slice(index)
            points = merge_maps(parts).transform(past.poses[index])
            spread = project_covariance(point_lever(points.points), past.covariance[place, place])
            whole.append(replace(points, covariances=points.covariances + spread))
        return merge_maps(whole)

    def _thin(self) -> None:
        """Keeps the points that most views have confirmed, and joins the parts of each keyframe."""
        whole = [merge_maps(parts) for parts in self._parts]
        order = np.argsort(-np.concatenate([part.observations for part in whole]), kind="stable")
        kept = np.zeros(len(order), bool)
        kept[order[: self._most]] = True
        ends = np.cumsum([len(part.points) for part in whole])
        self._parts = [[part.select(own)] for part, own in zip(whole, np.split(kept, ends[:-1]), strict=True)]


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
    return _triangulate(window, chosen, keyframe_times, least_views, True)


def host_points(window: KeyframeWindow, host: int, keyframe_times: np.ndarray, least_views: int = 3) -> PointMap:
    """The same of the landmarks of one keyframe in its own frame, with covariances given its pose."""
    chosen = window.landmarks.host == host
    points = _triangulate(window, chosen, keyframe_times, least_views, False)
    return points.transform(se3_inverse(window.poses[host]))


def _triangulate(
    window: KeyframeWindow, chosen: np.ndarray, keyframe_times: np.ndarray, least_views: int, absolute: bool
) -> PointMap:
    """Points in the world; their covariances with that of the host's pose, or given it."""
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
    # Landmarks depend on poses relative to the host alone: without its lever this is what is left given its pose.
    if absolute:
        lever = point_lever(points)
        for host in np.unique(landmarks.host):
            own = landmarks.host == host
            by_state[own, :, pose_slice(host)] += lever[own]
    covariances = by_state @ window.covariance @ by_state.transpose(0, 2, 1)
    covariances += by_landmark @ landmarks.covariance @ by_landmark.transpose(0, 2, 1)
    by_relief = _EITHER_SURFACE * landmarks.relief[:, None, None] * by_disparity[:, :, 2:]
    covariances += by_relief @ by_relief.transpose(0, 2, 1)
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
