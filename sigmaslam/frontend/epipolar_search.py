"""Matches of two views that lie near each other's epipolar lines."""

from __future__ import annotations

import cv2
import numpy as np

from sigmaslam.frontend.nearest_neighbours import Putative, nearest_among_pairs
from sigmaslam.frontend.types import Features

# Below so many matches the seven degrees of freedom of a geometry fit by chance.
_LEAST_MATCHES = 16
# The sampling consensus accepts this epipolar distance, pixels, and draws this many samples.
_THRESHOLD, _SAMPLES, _CONFIDENCE = 1.0, 2000, 0.999
# A keypoint is detected within about a pixel, in either image.
_REACH = 2.0


def find_epipolar_geometry(points0: np.ndarray, points1: np.ndarray) -> np.ndarray | None:
    """The fundamental matrix (3, 3), p1^T F p0 = 0, that most of the matched pixels (M, 2), (M, 2) agree on.

    None where they are fewer than 16 or the consensus fails.
    """
    if len(points0) < _LEAST_MATCHES:
        return None
    F, _ = cv2.findFundamentalMat(
        points0.astype(np.float64), points1.astype(np.float64), cv2.USAC_ACCURATE, _THRESHOLD, _CONFIDENCE, _SAMPLES
    )
    # OpenCV returns None on failure, although its type hints exclude None.
    return np.asarray(F) if np.shape(F) == (3, 3) else None


def nearest_near_lines(
    F: np.ndarray, features0: Features, features1: Features, settled0: np.ndarray, settled1: np.ndarray
) -> Putative:
    """Nearest neighbours among keypoints within 2 px of each other's epipolar lines.

    Args:
        F: (3, 3) with p1^T F p0 = 0 for pixels of one point.
        features0, features1: of either image.
        settled0, settled1: (K,) keypoints that are matched to each other and to nothing else.
    """
    free0, free1 = (
        np.setdiff1d(np.arange(len(features.keypoints)), settled)
        for features, settled in ((features0, settled0), (features1, settled1))
    )
    rays0, rays1 = (
        np.column_stack([features.keypoints[free], np.ones(len(free), np.float32)])
        for features, free in ((features0, free0), (features1, free1))
    )
    lines1, lines0 = rays0 @ F.T, rays1 @ F
    # p1^T F p0 over the length of a line's normal is the distance from that line.
    product = np.abs(lines1 @ rays1.T)
    near = product <= _REACH * np.hypot(lines1[:, 0], lines1[:, 1])[:, None]
    near &= product <= _REACH * np.hypot(lines0[:, 0], lines0[:, 1])
    row, column = np.nonzero(near)
    first = np.concatenate([settled0, free0[row]])
    second = np.concatenate([settled1, free1[column]])
    order = np.argsort(first, kind="stable")
    return nearest_among_pairs(features0.descriptors, features1.descriptors, first[order], second[order])
