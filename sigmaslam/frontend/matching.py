"""Mutual nearest neighbours among unit descriptors, where geometry allows them."""

from __future__ import annotations

import numpy as np


def match_rows(
    left: np.ndarray,
    right: np.ndarray,
    descriptors_left: np.ndarray,
    descriptors_right: np.ndarray,
    row_tolerance: float,
    disparity_range: tuple[float, float],
    ratio: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Stereo matches along the rows of a rectified pair.

    Args:
        left, right: (N, 2), (M, 2) keypoints.
        descriptors_left, descriptors_right: (N, D), (M, D) of unit length.
        row_tolerance: largest |v_left - v_right|, pixels.
        disparity_range: allowed u_left - u_right, pixels.
        ratio: distance of the best over the second best within the band must be below it.
    Returns:
        Indices (K,) into left and right, one to one.
    """
    disparity = left[:, None, 0] - right[None, :, 0]
    allowed = np.abs(left[:, None, 1] - right[None, :, 1]) <= row_tolerance
    allowed &= (disparity >= disparity_range[0]) & (disparity <= disparity_range[1])
    return _mutual(descriptors_left, descriptors_right, allowed, ratio)


def match_near(
    predicted: np.ndarray,
    radius: np.ndarray,
    keypoints: np.ndarray,
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    ratio: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Matches within a radius of a predicted place.

    Args:
        predicted: (N, 2) expected pixel coordinates in image 1.
        radius: (N,) pixels; infinite allows any place.
        keypoints: (M, 2) of image 1.
        descriptors0, descriptors1: (N, D), (M, D) of unit length.
        ratio: as in `match_rows`.
    """
    u = predicted[:, None, 0] - keypoints[None, :, 0]
    v = predicted[:, None, 1] - keypoints[None, :, 1]
    return _mutual(descriptors0, descriptors1, u * u + v * v <= (radius * radius)[:, None], ratio)


def _mutual(
    descriptors0: np.ndarray, descriptors1: np.ndarray, allowed: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    if len(descriptors0) == 0 or len(descriptors1) == 0:
        none = np.zeros(0, np.int64)
        return none, none
    similarity = descriptors0 @ descriptors1.T
    similarity[~allowed] = -2.0
    rows = np.arange(len(descriptors0))
    best1 = similarity.argmax(axis=1)
    best = similarity[rows, best1]
    mutual = (similarity.argmax(axis=0)[best1] == rows) & (best > -1.5)
    # Squared distance of unit vectors is 2 - 2 cos; the runner-up is looked up after the winner is struck out.
    similarity[rows, best1] = -2.0
    second = similarity.max(axis=1)
    # The margin keeps two identical candidates, both at distance zero, from passing as distinct.
    distinct = (1.0 - best) + 1e-6 <= ratio * ratio * (1.0 - second)
    chosen = np.flatnonzero(mutual & distinct)
    return chosen, best1[chosen]
