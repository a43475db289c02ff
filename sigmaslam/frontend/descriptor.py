"""Front-end for keypoints with descriptors, learned or classical: detect, match, refine."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sigmaslam.frontend.matching import nearest_in_ellipses, nearest_in_rows, nearest_anywhere
from sigmaslam.frontend.refine import refine
from sigmaslam.frontend.types import Features, StereoView, TemporalMatches

_ROW_TOLERANCE = 2.0
# A little below zero, so that points at infinity survive a disparity offset.
_LEAST_DISPARITY = -2.0
# Share of the image width that disparity may reach.
_MOST_DISPARITY = 0.25
_SIGMA_REFINED = 0.3
_SIGMA_DETECTED = 1.0

Detector = Callable[[np.ndarray], Features]


def match_stereo(
    left: np.ndarray, right: np.ndarray, features_left: Features, features_right: Features, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Stereo matches of a rectified pair: descriptors within a band of rows, then Lucas-Kanade.

    Args:
        left, right: (H, W) uint8.
        features_left, features_right: of these images.
        ratio: as in `match_rows`.
    Returns:
        Indices (K,) into the left features and their places (K, 2) in the right image; what could not be refined is
        left out.
    """
    putative = nearest_in_rows(
        features_left.keypoints,
        features_right.keypoints,
        features_left.descriptors,
        features_right.descriptors,
        _ROW_TOLERANCE,
        (_LEAST_DISPARITY, _MOST_DISPARITY * left.shape[1]),
    )
    kept = putative.mutual & putative.distinct(ratio)
    index_left, index_right = putative.index0[kept], putative.index1[kept]
    places, moved = refine(left, right, features_left.keypoints[index_left], features_right.keypoints[index_right])
    return index_left[moved], places[moved]


class DescriptorFrontend:
    """Matches by mutual nearest descriptor, refined by one Lucas-Kanade level.

    Args:
        name: for reports.
        detect: image (H, W) uint8 to features.
        ratio: nearest over second nearest descriptor distance that is still accepted.
    """

    def __init__(self, name: str, detect: Detector, ratio: float) -> None:
        self.name = name
        self._detect = detect
        self._ratio = ratio

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Features of both images, matched along the rows."""
        features, other = self._detect(left), self._detect(right)
        disparity = np.full(len(features.keypoints), np.nan)
        index, places = match_stereo(left, right, features, other, self._ratio)
        points = features.keypoints[index]
        level = np.abs(places[:, 1] - points[:, 1]) <= _ROW_TOLERANCE
        disparity[index[level]] = points[level, 0] - places[level, 0]
        return StereoView(left, right, features, disparity)

    def match(
        self, key: StereoView, index: np.ndarray, view: StereoView, predicted: np.ndarray, radius: np.ndarray
    ) -> TemporalMatches:
        """Mutual nearest neighbours within the search radius."""
        wanted = key.features.select(index)
        descriptors = wanted.descriptors, view.features.descriptors
        if np.isfinite(radius).all():
            covariance = (radius**2 / 9.21034037197618)[:, None, None] * np.eye(2)
            putative = nearest_in_ellipses(predicted, covariance, view.features.keypoints, *descriptors)
        else:
            putative = nearest_anywhere(*descriptors)
        kept = putative.mutual & putative.distinct(self._ratio)
        first, second = putative.index0[kept], putative.index1[kept]
        points = view.features.keypoints[second]
        places, moved = refine(key.left, view.left, wanted.keypoints[first], points)
        return TemporalMatches(
            index[first], places, view.disparity[second], np.where(moved, _SIGMA_REFINED, _SIGMA_DETECTED)
        )
