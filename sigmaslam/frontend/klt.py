"""Corners followed by pyramidal Lucas-Kanade, without descriptors."""

import cv2
import numpy as np

from sigmaslam.frontend.lucas_kanade import follow_both_ways
from sigmaslam.frontend.nearest_neighbours import within_ellipses
from sigmaslam.frontend.row_search import ROW_TOLERANCE
from sigmaslam.frontend.types import Features, KeypointSearch, StereoView, TemporalMatches

# Of a followed corner, pixels per axis, for all alike; the tracker scales it as the NIS asks.
_SIGMA = 0.3
# Both eyes' places err: the root of two times as much, about.
_DISPARITY_SIGMA = 0.4


class KltFrontend:
    """Shi-Tomasi corners tracked forward and backward.

    Args:
        max_keypoints: corners per keyframe.
    """

    name = "klt"

    def __init__(self, max_keypoints: int) -> None:
        self._max_keypoints = max_keypoints

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Corners of the left image, followed into the right one."""
        distance = max(5.0, 0.5 * np.sqrt(left.size / self._max_keypoints))
        corners = cv2.goodFeaturesToTrack(left, self._max_keypoints, 0.003, distance, blockSize=5)
        keypoints = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        features = Features(
            keypoints,
            np.zeros((len(keypoints), 0), np.float32),
            np.linspace(1, 0, len(keypoints), dtype=np.float32),
            np.full(len(keypoints), _SIGMA, np.float32),
        )
        disparity = _disparity(left, right, keypoints)
        return StereoView(left, right, features, disparity, np.where(np.isfinite(disparity), _DISPARITY_SIGMA, np.nan))

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        """Corners of the keyframe followed into the current left image, then into the right one; no patch is warped."""
        return _match(search, search.predicted, view.left, view.right)

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        """The same from where optical flow took the corners."""
        return [
            _match(search, np.where(np.isfinite(start), start, search.predicted), left, right)
            for search, start in zip(searches, starts, strict=True)
        ]


def _match(search: KeypointSearch, start: np.ndarray, left: np.ndarray, right: np.ndarray) -> TemporalMatches:
    """Corners of a keyframe in a pair, from a start (K, 2)."""
    points = search.key.features.keypoints[search.index]
    height, width = left.shape
    places, tracked = follow_both_ways(search.key.left, left, points, np.clip(start, 0, (width - 1, height - 1)))
    if search.covariance is not None:
        tracked &= within_ellipses(places - search.predicted, search.covariance)
    places = places[tracked]
    disparity = _disparity(left, right, places)
    return TemporalMatches(
        search.index[tracked],
        places,
        disparity,
        np.tile(_SIGMA**2 * np.eye(2), (len(places), 1, 1)),
        np.where(np.isfinite(disparity), _DISPARITY_SIGMA, np.nan),
        np.ones(len(places)),
    )


def _disparity(left: np.ndarray, right: np.ndarray, points: np.ndarray) -> np.ndarray:
    if not right.size:  # of a keyframe in a map
        return np.full(len(points), np.nan)
    places, tracked = follow_both_ways(left, right, points, points)
    disparity = points[:, 0] - places[:, 0]
    level = tracked & (np.abs(places[:, 1] - points[:, 1]) <= ROW_TOLERANCE) & (disparity > -2.0)
    return np.where(level, disparity, np.nan)
