"""Matches of two views that lie near each other's epipolar lines."""

from dataclasses import dataclass

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
# What the matches leave uncertain of a line is allowed to so many standard deviations.
_DEVIATIONS = 3.0
# Of the solution of the eight-point equations.
_UNKNOWNS = 8
# Looked at together; bounds the memory.
_PAIRS_AT_A_TIME = 1 << 22
# Beyond this share of the largest eigenvalue a direction is not determined at all.
_LEAST_EIGENVALUE = 1e-12


@dataclass(frozen=True, slots=True)
class UncertainGeometry:
    """The fundamental matrix of two views, and what their matches leave uncertain of it.

    Attributes:
        F: (3, 3) with p1^T F p0 = 0 for homogeneous pixels of one point.
        deviations: (8, 3, 3) one standard deviation of F along each of its independent directions.
    """

    F: np.ndarray
    deviations: np.ndarray


def find_epipolar_geometry(points0: np.ndarray, points1: np.ndarray) -> UncertainGeometry | None:
    """The geometry that most of the matched pixels (M, 2), (M, 2) agree on, by a sampling consensus.

    From its inliers by the normalised eight-point equations (Hartley 1997), weighted as Sampson's error is, without the
    constraint of rank 2. If they lie on a plane, or the camera only turned, F is free in some directions, and their
    deviations are large.

    Returns:
        None where fewer than 16 matches agree or the consensus fails.
    """
    if len(points0) < _LEAST_MATCHES:
        return None
    points0, points1 = points0.astype(np.float64), points1.astype(np.float64)
    try:
        F, chosen = cv2.findFundamentalMat(points0, points1, cv2.USAC_ACCURATE, _THRESHOLD, _CONFIDENCE, _SAMPLES)
    except cv2.error:  # an assertion of OpenCV 5.0, for few sets of points
        return None
    # OpenCV returns None on failure, although its type hints exclude None.
    if np.shape(F) != (3, 3) or chosen.sum() < _LEAST_MATCHES:
        return None
    inliers = chosen.ravel().astype(bool)
    (to0, scaled0), (to1, scaled1) = normalised(points0[inliers]), normalised(points1[inliers])
    start = np.linalg.inv(to1).T @ F @ np.linalg.inv(to0)
    slopes = np.column_stack([(scaled0 @ start.T)[:, :2], (scaled1 @ start)[:, :2]])
    weight = 1.0 / np.maximum(np.linalg.norm(slopes, axis=1), 1e-12)
    equations = (weight[:, None, None] * scaled1[:, :, None] * scaled0[:, None, :]).reshape(-1, 9)
    values, vectors = np.linalg.eigh(equations.T @ equations)
    noise = max(values[0], 0.0) / max(len(equations) - _UNKNOWNS, 1)
    deviation = np.sqrt(noise / np.maximum(values[1:], _LEAST_EIGENVALUE * values[-1]))
    in_pixels = to1.T @ vectors.T.reshape(9, 3, 3) @ to0
    return UncertainGeometry(in_pixels[0], in_pixels[1:] * deviation[:, None, None])


def nearest_near_lines(
    geometry: UncertainGeometry, features0: Features, features1: Features, settled0: np.ndarray, settled1: np.ndarray
) -> Putative:
    """Nearest neighbours among keypoints near each other's epipolar lines.

    Near is within 2 px, the keypoints' own error, and three standard deviations of the line.

    Args:
        geometry: of the views.
        features0, features1: of either image.
        settled0, settled1: (K,) keypoints that are matched to each other and to nothing else.
    """
    free0, free1 = (
        np.setdiff1d(np.arange(len(features.keypoints)), settled)
        for features, settled in ((features0, settled0), (features1, settled1))
    )
    pixels0, pixels1 = _homogeneous(features0.keypoints[free0]), _homogeneous(features1.keypoints[free1])
    parts = len(free0) * len(free1) // _PAIRS_AT_A_TIME + 1
    pairs = [_near_lines(geometry, part, pixels1) for part in np.array_split(pixels0, parts)]
    row = np.repeat(np.arange(len(free0)), np.concatenate([count for count, _ in pairs]))
    column = np.concatenate([columns for _, columns in pairs])
    first = np.concatenate([settled0, free0[row]])
    second = np.concatenate([settled1, free1[column]])
    order = np.argsort(first, kind="stable")
    return nearest_among_pairs(features0.descriptors, features1.descriptors, first[order], second[order])


def _near_lines(geometry: UncertainGeometry, pixels0: np.ndarray, pixels1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of homogeneous pixels (N, 3), (M, 3): how many of image 1 are near each of image 0 (N,), and which, in a row."""
    lines1, lines0 = pixels0 @ geometry.F.T, pixels1 @ geometry.F
    # p1^T F p0 over the length of a line's normal is the distance from that line.
    shorter = np.minimum((lines1[:, :2] ** 2).sum(axis=1)[:, None], (lines0[:, :2] ** 2).sum(axis=1))
    allowed = _REACH**2 * shorter
    for deviation in geometry.deviations:
        allowed += (_DEVIATIONS * (pixels0 @ deviation.T @ pixels1.T)) ** 2
    near = (lines1 @ pixels1.T) ** 2 <= allowed
    return near.sum(axis=1), np.nonzero(near)[1]


def normalised(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Similarity (3, 3) to mean zero and root mean square distance sqrt(2), and homogeneous points (M, 3) after it."""
    mean = points.mean(axis=0)
    scale = np.sqrt(2.0 / max(((points - mean) ** 2).sum(axis=1).mean(), 1e-12))
    T = np.array([[scale, 0.0, -scale * mean[0]], [0.0, scale, -scale * mean[1]], [0.0, 0.0, 1.0]])
    return T, _homogeneous(points) @ T.T


def _homogeneous(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points.astype(np.float64), np.ones(len(points))])
