"""The map: landmarks, refined by every keyframe that saw them again."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.calibration_errors import measured_errors
from sigmaslam.estimation.gaussian import project_covariance
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.marginalised_poses import PastPoses, past_slice, point_lever
from sigmaslam.estimation.published_state import published_state
from sigmaslam.estimation.state_layout import CALIBRATION, LANDMARK_SIZE, MODELLED, pose_slice
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.table import Table

# A keypoint may lie on either end of what its patch shows: standard deviation of its disparity, over that range.
_EITHER_SURFACE = 0.5
MIN_VIEWS = 3
"""Landmarks that fewer have confirmed are not in the map."""
# Points with less disparity are too far away for the map.
_MIN_DISPARITY = 0.5


@dataclass(frozen=True, slots=True)
class PointMap(Table):
    """Sparse map.

    Attributes:
        points: (M, 3) float64 in the world, metres.
        covariances: (M, 3, 3) of them in the world, that of the keyframe's pose and what surfaces vary by around them
            included, metres squared.
        observations: (M,) views that confirmed it.
        timestamps: (M,) of the keyframe that saw the point first, seconds.
        pixels: (M, 2) its place there, in the rectified left image.
        intensity: (M,) float32 grey value of that place, 0 to 255; NaN where it is not known.
    """

    points: np.ndarray
    covariances: np.ndarray
    observations: np.ndarray
    timestamps: np.ndarray
    pixels: np.ndarray
    intensity: np.ndarray

    @classmethod
    def empty(cls) -> Self:
        """No points."""
        flat = np.zeros(0)
        return cls(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64), flat, np.zeros((0, 2)), _unknown(0))

    def shade(self, image: np.ndarray, timestamp: float) -> Self:
        """The map with the grey values of the points that the keyframe of that time saw first.

        Args:
            image: (H, W) its rectified left image.
            timestamp: seconds.
        """
        rows = self.timestamps == timestamp
        u, v = np.clip(np.rint(self.pixels[rows]).astype(np.int64), 0, np.array(image.shape[::-1]) - 1).T
        intensity = self.intensity.copy()
        intensity[rows] = image[v, u]
        return replace(self, intensity=intensity)

    def transform(self, T: np.ndarray) -> Self:
        """The map in another world, T (4, 4) takes this one there."""
        R = T[:3, :3]
        return replace(self, points=transform_points(T, self.points), covariances=R @ self.covariances @ R.T)


def hand_over_points(points: PointMap, step: np.ndarray, covariance: np.ndarray) -> PointMap:
    """Points in the frame of a past pose that is about to be forgotten, in that of another one.

    Args:
        points: in the frame of the pose that leaves, covariances given it.
        step: (4, 4) takes them into that of the heir.
        covariance: (6, 6) of the step, perturbed from the left in the heir.
    """
    moved = points.transform(step)
    return replace(moved, covariances=moved.covariances + project_covariance(point_lever(moved.points), covariance))


def points_in_world(parts: list[PointMap], past: PastPoses) -> PointMap:
    """All points that hang at past poses, each part in the frame of the pose of its index."""
    whole = []
    for index, part in enumerate(parts):
        place = past_slice(index)
        points = part.transform(past.poses[index])
        spread = project_covariance(point_lever(points.points), past.whole_covariance[place, place])
        whole.append(replace(points, covariances=points.covariances + spread))
    return merge_maps(whole)


def most_confirmed(parts: list[PointMap], max_points: int) -> list[PointMap]:
    """Of all parts together, the points that most views have confirmed."""
    order = np.argsort(-np.concatenate([part.observations for part in parts]), kind="stable")
    kept = np.zeros(len(order), bool)
    kept[order[:max_points]] = True
    ends = np.cumsum([len(part) for part in parts])
    return [part.select(chosen) for part, chosen in zip(parts, np.split(kept, ends[:-1]), strict=True)]


def window_points(window: KeyframeWindow, keyframe_times: np.ndarray, min_views: int = MIN_VIEWS) -> PointMap:
    """Landmarks of the window in the world.

    Of those that were seen often enough and have more than half a pixel of disparity.

    Args:
        keyframe_times: (K,) time stamps of the window's keyframes.
        min_views: fewer do not count.
    """
    return _triangulate(window, np.ones(len(window.landmarks), bool), keyframe_times, min_views, True)


def anchor_points(window: KeyframeWindow, anchor: int, keyframe_times: np.ndarray) -> PointMap:
    """The same of the landmarks of one anchor keyframe in its own frame, with covariances given its pose."""
    points = _triangulate(window, window.landmarks.anchor == anchor, keyframe_times, MIN_VIEWS, False)
    return points.transform(se3_inverse(window.posterior.poses[anchor]))


def _triangulate(
    window: KeyframeWindow, chosen: np.ndarray, keyframe_times: np.ndarray, min_views: int, absolute: bool
) -> PointMap:
    """Points in the world; their covariances with that of the anchor's pose, or given it."""
    landmarks, state = window.landmarks, published_state(window)
    uvd = window.as_calibrated(landmarks.estimate)
    kept = chosen & (landmarks.views >= min_views) & (uvd[:, 2] > _MIN_DISPARITY)
    uvd, landmarks = uvd[kept], landmarks.select(kept)
    if not len(landmarks):
        return PointMap.empty()
    points = window.camera.triangulate(uvd)
    R = state.poses[landmarks.anchor, :3, :3]
    by_disparity = R @ _triangulation_jacobian(uvd, points, window.camera)
    unmoved = np.zeros((len(points), 3, LANDMARK_SIZE - MODELLED))
    by_landmark = np.concatenate([by_disparity, -by_disparity[:, :, 2:], unmoved], axis=2)
    points = (R @ points[..., None])[..., 0] + state.poses[landmarks.anchor, :3, 3]
    by_state = by_landmark @ landmarks.dependence
    by_state[:, :, CALIBRATION] -= by_disparity @ measured_errors(window.camera, landmarks.estimate[:, :3])
    # Landmarks depend on poses relative to the anchor alone: without its lever this is what remains given its pose.
    if absolute:
        lever = point_lever(points)
        for anchor in np.unique(landmarks.anchor):
            rows = landmarks.anchor == anchor
            by_state[rows, :, pose_slice(anchor)] += lever[rows]
    covariances = by_state @ state.whole_covariance @ by_state.transpose(0, 2, 1)
    covariances += by_landmark @ landmarks.covariance @ by_landmark.transpose(0, 2, 1)
    by_surface = _EITHER_SURFACE * landmarks.disparity_range[:, None, None] * by_disparity[:, :, 2:]
    covariances += by_surface @ by_surface.transpose(0, 2, 1)
    times, pixels = keyframe_times[landmarks.anchor], landmarks.measured[:, :2].copy()
    return PointMap(points, covariances, landmarks.views, times, pixels, _unknown(len(points)))


def _unknown(count: int) -> np.ndarray:
    """Grey values (count,) that are not known."""
    return np.full(count, np.nan, np.float32)


def merge_maps(parts: list[PointMap]) -> PointMap:
    """All points of all parts."""
    return PointMap.concatenate([PointMap.empty(), *parts])


def _triangulation_jacobian(uvd: np.ndarray, points: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    """Derivative of (9.34) by (u, v, disparity), (K, 3, 3): the chapter's (9.35)."""
    depth, disparity = points[:, 2], uvd[:, 2]
    jacobian = np.zeros((len(uvd), 3, 3))
    jacobian[:, 0, 0] = depth / camera.fx
    jacobian[:, 1, 1] = depth / camera.fy
    jacobian[:, :, 2] = -points / disparity[:, None]
    return jacobian
