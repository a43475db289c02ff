"""Inputs of the match scorer: side information of putative matches, and their neighbours."""

import numpy as np

from sigmaslam.frontend.knn import nearest_points
from sigmaslam.frontend.nearest_neighbours import Putative
from sigmaslam.frontend.types import Features

NEIGHBOURS = 12
"""That a match is compared with; 16 are no better (docs/notebook, matching), and the scorer was trained on 12."""
# With fewer mutual matches all matches may be neighbours.
_MIN_ANCHORS = 32
# Sevenfold sigmas are as unlike as any: the scorer has not to extrapolate beyond.
_MAX_LOG_SIGMA = 2.0


def side_information(putative: Putative, features0: Features, features1: Features) -> np.ndarray:
    """Columns of similarities, scores and sigmas that have the same meaning for every kind of features.

    Similarities enter as their rank in the set or as a ratio of distances, detector scores as their rank in the image.

    Args:
        putative: the matches.
        features0, features1: of either image.
    Returns:
        (M, 9) float32: ranks of similarity and of its margins to the runner-up in image 1 and in image 0; whether
        mutual; distance over that of both runners-up; rank of the keypoints' scores in either image; log of the
        quotient of the keypoints' sigmas.
    """
    similarity = putative.similarity
    distance = np.maximum(1.0 - similarity, 0.0) + 1e-4
    ratios = [
        np.sqrt(distance / (np.maximum(1.0 - other, 0.0) + 1e-4)) for other in (putative.second0, putative.second1)
    ]
    sigma0, sigma1 = features0.sigma[putative.index0], features1.sigma[putative.index1]
    quotient = np.log(np.maximum(sigma1, 1e-6) / np.maximum(sigma0, 1e-6))
    columns = [
        _rank(similarity),
        _rank(similarity - putative.second0),
        _rank(similarity - putative.second1),
        putative.mutual,
        np.minimum(ratios[0], 2.0),
        np.minimum(ratios[1], 2.0),
        _rank(features0.scores)[putative.index0],
        _rank(features1.scores)[putative.index1],
        np.clip(quotient, -_MAX_LOG_SIGMA, _MAX_LOG_SIGMA),
    ]
    return np.stack(columns, axis=1).astype(np.float32)


def nearest_matches(points0: np.ndarray, mutual: np.ndarray) -> np.ndarray:
    """Neighbours of every match in image 0, among the mutual matches, which are right more often.

    Args:
        points0: (M, 2) float32 matched keypoints of image 0.
        mutual: (M,) bool.
    Returns:
        (M, 12) int64, nearest first; the match itself where there are too few.
    """
    anchors = np.flatnonzero(mutual)
    if len(anchors) < _MIN_ANCHORS:
        anchors = np.arange(len(points0))
    rows = np.arange(len(points0))[:, None]
    if len(anchors) < 2:
        return np.tile(rows, (1, NEIGHBOURS))
    near = anchors[nearest_points(points0[anchors], points0, min(NEIGHBOURS + 1, len(anchors)))]
    # The match itself goes last, so that the first twelve are other matches if there are enough.
    near = np.take_along_axis(near, np.argsort(near == rows, axis=1, kind="stable"), axis=1)[:, :NEIGHBOURS]
    missing = NEIGHBOURS - near.shape[1]
    return np.concatenate([near, np.tile(rows, (1, missing))], axis=1) if missing else near


def _rank(values: np.ndarray) -> np.ndarray:
    """Share of the values below each value; equal values count half."""
    _, group, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(counts) - 0.5 * counts)[group] / max(len(values), 1))
