"""Stereo matches from features of both eyes: how extractors are compared; the tracker searches rows without them."""

import numpy as np

from sigmaslam.frontend.descriptor import LEAST_PROBABILITY, RefinedMatches, refine_with_confidence
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.plane_alignment import refine_in_rows
from sigmaslam.frontend.row_search import MAX_DISPARITY, ROW_TOLERANCE
from sigmaslam.frontend.types import Features
from sigmaslam_training.matching.match_sets import nearest_in_rows

# A little below zero, so that points at infinity survive a disparity offset.
_LEAST_DISPARITY = -2.0


def match_eyes(
    estimator: ConfidenceEstimator,
    left: np.ndarray,
    right: np.ndarray,
    features_left: Features,
    features_right: Features,
) -> RefinedMatches:
    """Stereo matches of a rectified pair: descriptors within a band of rows, then alignment.

    Args:
        estimator: of the matches.
        left, right: (H, W) uint8.
        features_left, features_right: of these images.
    """
    putative = nearest_in_rows(
        features_left.keypoints,
        features_right.keypoints,
        features_left.descriptors,
        features_right.descriptors,
        ROW_TOLERANCE,
        (_LEAST_DISPARITY, MAX_DISPARITY * left.shape[1]),
    )
    found = refine_with_confidence(
        estimator,
        left,
        right,
        features_left,
        features_right,
        putative,
        lambda points0, points1, *_: refine_in_rows(left, right, points0, points1)[0],
    )
    level = np.abs(found.places[:, 1] - features_left.keypoints[found.index0, 1]) <= ROW_TOLERANCE
    return found.select(level & (found.probability >= LEAST_PROBABILITY))
