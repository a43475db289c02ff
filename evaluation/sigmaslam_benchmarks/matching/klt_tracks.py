"""Correct matches from frame to frame beside those of KLT, which has no descriptors."""

from collections.abc import Sequence

import numpy as np

from sigmaslam.frontend.klt import KltFrontend
from sigmaslam.frontend.types import KeypointSearch
from sigmaslam_benchmarks.matching.image_pairs import ImagePair, Motion

KLT = "klt"
TRACKED_KEYPOINTS = 2048
"""Of everyone in this comparison."""


def score_klt(pairs: Sequence[ImagePair]) -> dict[str, float]:
    """KLT on the pairs with a known motion, the part's name before each figure as in `score_pairs`.

    Returns:
        klt_1: share of the tracks within 1 px of their epipolar line; klt_matches: their number.
    """
    parts: dict[str, list[tuple[float, float]]] = {}
    for pair in pairs:
        if isinstance(pair.truth, Motion):
            points0, points1 = follow_corners(pair.image0, pair.image1)
            near = pair.truth.epipolar_distance(points0, points1) < 1.0
            parts.setdefault(pair.part, []).append((float(near.mean()) if len(near) else 0.0, float(near.sum())))
    return {
        (f"{part}_{name}" if part else name): float(value)
        for part, scores in parts.items()
        for name, value in zip(("klt_1", "klt_matches"), np.mean(scores, axis=0), strict=True)
    }


def follow_corners(image0: np.ndarray, image1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """At most 2,048 corners of image 0, (N, 2), and where they are in image 1, forward and back without a prediction.

    The tracker's own KLT; its stereo matching, which is done too, is not used.
    """
    klt = KltFrontend(TRACKED_KEYPOINTS)
    key, view = klt.observe(image0, image0), klt.observe(image1, image1)
    points = key.features.keypoints
    tracks = klt.match(KeypointSearch.anywhere(key, np.arange(len(points))), view)
    return points[tracks.key_index].astype(np.float64), tracks.points
