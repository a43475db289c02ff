"""Where keypoints of the left image are in the right one of a rectified pair: patches of edges, searched along the row.

Edges are compared, those of large images at half the resolution, there and back; whole pixels are found, which
alignment refines.
"""

import cv2
import numpy as np

from sigmaslam.frontend.patch_kernels import compiled
from sigmaslam.frontend.plane_alignment import refine_in_rows

# Images from this width on are searched at half the resolution.
_HALVED_FROM = 640
MAX_DISPARITY = 0.25
"""Share of the image width that disparity may reach."""
# The patches, pixels: rows above the keypoint and in all, columns before it and in all.
_ABOVE, _TALL, _BEFORE, _BROAD = 5, 11, 8, 16
# The best place must have less than this share of the difference of the second best one.
_MAX_RATIO = 0.9
# Times the contrast of the other eye, from which on its light differs, and not what it sees.
_EQUAL_CONTRAST = 1.25
# Disparities that count as neighbours of the best one, and by how many the way back may miss.
_NEIGHBOURS, _MAX_MISS = 2, 1
# Stands for no disparity: below all that are searched in images narrower than 8,000 pixels.
_NOWHERE = -1000
ROW_TOLERANCE = 2.0
"""Rows that the eyes of a rectified pair may be off by, pixels."""
REACH_SEARCHED, REACH_PREDICTED = 2.0, 3.0
"""How far alignment may move a disparity that was searched for, and one that was predicted, pixels."""


def search_rows(left: np.ndarray, right: np.ndarray, keypoints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds keypoints in the right image, in front of infinity and, where the eyes are swapped, behind it.

    Args:
        left, right: (H, W) uint8, a rectified pair.
        keypoints: (N, 2) of the left image, pixels.
    Returns:
        (M,) which keypoints were found, and (M, 2) float64 where, to a pixel or two along the row.
    """
    scale = 2 if left.shape[1] >= _HALVED_FROM else 1
    edges = _alike(_derivative(left, scale), _derivative(right, scale))
    places = np.rint((keypoints + 0.5) / scale - 0.5).astype(np.int32)
    most = int(MAX_DISPARITY * left.shape[1] / scale)
    kernels = compiled()
    search = search_reference if kernels is None else kernels.search_rows
    disparity = search(*edges, places, -most, most, _MAX_RATIO)
    index = np.flatnonzero(disparity != _NOWHERE)
    found = keypoints[index].astype(np.float64)
    found[:, 0] -= float(scale) * disparity[index]
    return index, found


def align_in_rows(
    left: np.ndarray, right: np.ndarray, points: np.ndarray, start: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Exact places of points of the left image in the right one.

    Args:
        left, right: (H, W) uint8, a rectified pair.
        points, start: (M, 2) float64 in the left image, and about where they are in the right one, pixels.
        reach: longest move, pixels.
    Returns:
        (M, 2) float64 places; (M,) bool, whether the patches could be aligned, and near the row; and the slopes (M, 2)
        as of `disparity_slopes`.
    """
    refined, slope = refine_in_rows(left, right, points, start, reach)
    return refined.places, refined.moved & (np.abs(refined.places[:, 1] - points[:, 1]) <= ROW_TOLERANCE), slope


def search_reference(
    left: np.ndarray, right: np.ndarray, places: np.ndarray, lowest: int, highest: int, ratio: float
) -> np.ndarray:
    """The search in NumPy.

    Args:
        left, right: (H, W) uint8.
        places: (N, 2) pixels of the left image, whole numbers.
        lowest, highest: disparities to search between.
        ratio: the best difference must be smaller than this share of the second best.
    Returns:
        (N,) disparity, or -1000 where none is found.
    """
    disparities = np.arange(lowest, highest + 1)
    there = _differences(left, right, places, -disparities)
    best = there.argmin(axis=1)
    apart = np.abs(disparities[None] - disparities[best][:, None]) > _NEIGHBOURS
    second = np.where(apart, there, np.inf).min(axis=1)
    cost = there[np.arange(len(places)), best]
    found = np.isfinite(cost) & np.isfinite(second) & (cost <= np.float32(ratio) * second)
    seen = places - np.column_stack([disparities[best], np.zeros(len(places), int)])
    back = _differences(right, left, np.where(found[:, None], seen, places), disparities).argmin(axis=1)
    found &= np.abs(disparities[back] - disparities[best]) <= _MAX_MISS
    return np.where(found, disparities[best], _NOWHERE)


def _differences(image0: np.ndarray, image1: np.ndarray, places: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """(N, S) sums of absolute differences of patches of image 0 and those shifted along the row in image 1."""
    height, width = image0.shape
    dv, du = np.mgrid[-_ABOVE : _TALL - _ABOVE, -_BEFORE : _BROAD - _BEFORE]
    u, v = places[:, 0, None, None], places[:, 1, None, None]
    rows = np.clip(v + dv, 0, height - 1)
    wanted = image0[rows, np.clip(u + du, 0, width - 1)].astype(np.int32)
    tall = (places[:, 1] >= _ABOVE) & (places[:, 1] + _TALL - _ABOVE <= height)
    sums = np.full((len(places), len(shifts)), np.inf)
    inside0 = tall & (places[:, 0] >= _BEFORE) & (places[:, 0] + _BROAD - _BEFORE <= width)
    for k, shift in enumerate(shifts):
        column = places[:, 0] + shift
        inside = inside0 & (column >= _BEFORE) & (column + _BROAD - _BEFORE <= width)
        patch = image1[rows, np.clip(u + shift + du, 0, width - 1)]
        sums[inside, k] = np.abs(wanted - patch).sum(axis=(1, 2))[inside]
    return sums


def _derivative(image: np.ndarray, scale: int) -> np.ndarray:
    """Along the rows, of an image shrunk by a whole factor, (H / scale, W / scale) int16."""
    if scale > 1:
        image = cv2.resize(image, None, fx=1.0 / scale, fy=1.0 / scale, interpolation=cv2.INTER_AREA)
    return cv2.Sobel(image, cv2.CV_16S, 1, 0)


def _alike(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives (H, W) of two eyes as uint8 about 128; those of an eye with far less light are raised."""
    one, other = (max(float(cv2.meanStdDev(each)[1][0, 0]), 1.0) for each in (left, right))
    gain = other / one
    raised = (max(gain, 1.0), max(1.0 / gain, 1.0)) if max(gain, 1.0 / gain) > _EQUAL_CONTRAST else (1.0, 1.0)
    first, second = (
        cv2.convertScaleAbs(each, alpha=0.5 * by, beta=128.0) for each, by in zip((left, right), raised, strict=True)
    )
    return first, second
