"""Dense disparity of a rectified pair with a variance for each pixel.

Semi-global matching finds the disparity to a pixel. Its sixteenths are drawn towards whole pixels, so the smoothed map
is aligned anew, by Gauss-Newton steps that minimise the difference of the images in a window around each pixel. What
they leave of the difference, and how much texture it was found by, give the Cramer-Rao bound of the disparity; what it
is off by in truth was fitted on renders.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.compiled import open_compiled
from sigmaslam.frontend.patch_disparity_range import semi_global

kernels = open_compiled("reconstruction._depths")

# Semi-global matching: side of its blocks, what steps of disparity cost, twice OpenCV's own rule, the largest gradient
# that counts, by how many percent the best must win, and how large what departs by more than a pixel must be to be
# believed. The best of sixteen on renders of a street and a room.
_BLOCK = 3
_SMALL_STEP, _LARGE_STEP = 16 * _BLOCK**2, 64 * _BLOCK**2
_CAP = 63
_UNIQUE, _SPECKLE = 5, 100
# Disparities searched: from behind infinity, for the sake of a disparity offset, to nearer than all of half the image.
_LEAST, _BEYOND = -4, 8
# How far to search is found at a quarter of the size, or at so many columns; the largest disparity as a share of these,
# and which of those found counts.
_COLUMNS, _WIDEST, _NEARLY_ALL = 160, 0.4, 99.8
# Alignment: radius of the window, steps, and how far one may go, pixels.
_RADIUS, _STEPS, _LONGEST = 3, 2, 0.5
_WINDOW = np.full(2 * _RADIUS + 1, 1.0 / (2 * _RADIUS + 1), np.float32)
# Smoothing before each step: diameter, what disparities may differ by, and spread, all pixels.
_DIAMETER, _SAME_SURFACE, _SPREAD = 7, 1.0, 3.0
# A pixel this far from the mean of its window is at an edge, and farther makes no difference, pixels.
_WIDEST_EDGE = 2.0
# Variance of the smoothed map about the truth, the prior of a step, pixels squared: the best on noisy renders.
_PRIOR_VARIANCE = np.float32(0.07**2)
# Variance of the rounding of two grey values, the value that is saturated, and how much brighter one eye may be.
_ROUNDING, _SATURATED, _MOST_GAIN = np.float32(1.0 / 6.0), 255, np.float32(2.0)
# A bound of this is no information, pixels squared.
_WIDEST_BOUND = np.float32(4.0)
# The plane of row offsets: every so many rows are enough, steps, differences that count in their median, information of
# a prior (grey values^2 per pixel^2, that of a thousand pixels with a slope of one), the largest offset, pixels, and
# the window about which brightness may differ.
_ROW_STRIDE, _ROW_STEPS, _OUTLYING, _ROW_INFORMATION = 8, 2, 4.5, np.float32(1e3)
_MOST_ROWS, _ROW_WINDOW = np.float32(1.0), (15, 15)
# A disparity is the same at half the size to a pixel of that; one with a sigma of the first of these needs no such
# confirmation, one of the second is none, pixels.
_SAME_AT_HALF, _SURE, _UNSURE = 2.0, 0.5, 2.0
# The variance of a disparity is a sum of what it depends on: a floor, pixels squared, and factors of the Cramer-Rao
# bound, of the variance of the disparities in the window about a smooth surface (relief), and of the squared distance
# from their mean (edge). Fitted on renders of room, street and organ with seeds below 1000 by
# the likelihood of Student's t distribution with five degrees of freedom, then all times 2.35, which brings 95.4 % of
# their pixels inside two sigma. The renders are as unlike eyes see them: exposure, gain, gamma, vignetting, blur and
# noise differ, and rows are off by 0.15 pixels.
_FLOOR, _BY_BOUND, _BY_RELIEF, _BY_EDGE = 0.01**2, 0.83, 37.0, 8.0
# Marks pixels without a disparity where NaN would spread.
_NOWHERE = np.float32(-1000.0)

Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Disparities (H, W) float32 of a rectified pair of (H, W) uint8 images, NaN where there is none."""


@dataclass(frozen=True, slots=True)
class DisparityMap:
    """Disparities of the left image of a rectified pair.

    Attributes:
        disparity: (H, W) float32 pixels; NaN where there is none.
        variance: (H, W) float32 pixels squared; NaN where there is no disparity.
    """

    disparity: np.ndarray
    variance: np.ndarray


def measure_disparity(left: np.ndarray, right: np.ndarray, match: Matcher) -> DisparityMap:
    """Disparities with their variances.

    A disparity stays if the images at half their size say the same, or the alignment is sure of it: where neither is
    so, in saturated and plain parts of the image, the smoothness of the matching made it up.

    Args:
        left, right: (H, W) uint8 rectified images.
        match: finds disparities to a pixel, such as `semi_global_disparity`.
    """
    matched = match(left, right)
    aligned = align_disparity(left, right, matched)
    with np.errstate(invalid="ignore"):
        confirmed = np.abs(_half_size_disparity(left, right, matched) - matched) <= _SAME_AT_HALF
    stays = (confirmed | (aligned.variance < _SURE**2)) & (aligned.variance < _UNSURE**2) & np.isfinite(matched)
    return DisparityMap(*(np.where(stays, each, np.float32(np.nan)) for each in (aligned.disparity, aligned.variance)))


def semi_global_disparity(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparities (H, W) float32 in sixteenths of a pixel by OpenCV's semi-global matching; NaN where there is none.

    Args:
        left, right: (H, W) uint8 rectified images.
    """
    smaller = max(left.shape[1] / _COLUMNS, 4.0)
    small = [shrink(image, smaller) for image in (left, right)]
    known = _seen_by_both(small[0], small[1], _WIDEST * small[0].shape[1], (4.0 / smaller) ** 2)
    known = known[np.isfinite(known)]
    largest = smaller * float(np.percentile(known, _NEARLY_ALL)) + _BEYOND if len(known) else 0.0
    return _semi_global(left, right, max(largest, _BEYOND))


def shrink(image: np.ndarray, smaller: float) -> np.ndarray:
    """The image so many times smaller."""
    return np.asarray(cv2.resize(image, None, fx=1.0 / smaller, fy=1.0 / smaller, interpolation=cv2.INTER_AREA))


def _half_size_disparity(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """(H, W) disparities, pixels of the whole size, that both eyes' images at half their size agree on; else NaN.

    `disparity` (H, W), found at the whole size, says how far to search.
    """
    height, width = left.shape
    found = disparity[np.isfinite(disparity)]
    if not len(found):
        return np.full((height, width), np.nan, np.float32)
    both = _seen_by_both(shrink(left, 2.0), shrink(right, 2.0), float(found.max()) / 2.0)
    return 2.0 * cv2.resize(both, (width, height), interpolation=cv2.INTER_NEAREST)


def _seen_by_both(left: np.ndarray, right: np.ndarray, largest: float, speckle: float = 1.0) -> np.ndarray:
    """(H, W) disparities that matching from the right image to the left one finds, too, within a pixel; else NaN.

    Speckles are `speckle` times as large as those of the whole image.
    Skies and plain walls match anywhere, mostly far off.
    """
    there = _semi_global(left, right, largest, speckle)
    mirrored_left, mirrored_right = (np.ascontiguousarray(image[:, ::-1]) for image in (left, right))
    back = _semi_global(mirrored_right, mirrored_left, largest, speckle)[:, ::-1]
    v, u = np.nonzero(np.isfinite(there))
    u_right = np.rint(u - there[v, u]).astype(np.int64).clip(0, left.shape[1] - 1)
    differs = ~(np.abs(back[v, u_right] - there[v, u]) <= 1.0)
    there[v[differs], u[differs]] = np.nan
    return there


def _semi_global(left: np.ndarray, right: np.ndarray, largest: float, speckle: float = 1.0) -> np.ndarray:
    levels = 16 * int(np.ceil((largest - _LEAST) / 16))
    costs = {"blockSize": _BLOCK, "P1": _SMALL_STEP, "P2": _LARGE_STEP, "disp12MaxDiff": 1, "preFilterCap": _CAP}
    speckle_size = round(speckle * _SPECKLE)
    settings = {**costs, "uniquenessRatio": _UNIQUE, "speckleWindowSize": speckle_size}
    disparity = semi_global(left, right, _LEAST, levels, **settings)
    # What would lie left of the right image matches its repeated border.
    return np.where(disparity <= np.arange(left.shape[1], dtype=np.float32), disparity, np.float32(np.nan))


def align_disparity(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> DisparityMap:
    """Aligns the images by Gauss-Newton steps of every pixel's disparity, each the mode of its posterior.

    The prior of a step is the smoothed map. Brightness may differ between the eyes by a gain and an offset, rows by a
    plane that is fitted to the whole image: what is left of a rectification error would be read as disparity.

    Args:
        left, right: (H, W) uint8 rectified images.
        disparity: (H, W) float32 right to about a pixel, NaN where there is none.
    """
    reference, other = left.astype(np.float32), right.astype(np.float32)
    gradient = cv2.filter2D(other, -1, np.array([[-0.5, 0.0, 0.5]], np.float32))
    u, v = pixel_grid(*left.shape)
    known = np.isfinite(disparity)
    found = np.where(known, disparity, _NOWHERE).astype(np.float32)
    smooth = _smooth(found)
    offset = row_offset(reference, other, np.where(known, smooth, np.float32(np.nan)))
    v = v + offset
    # What is saturated shows no texture, and its edges are not where the surface's are.
    seen = cv2.remap(right, u - smooth, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    weight = (known & (left < _SATURATED) & (seen < _SATURATED)).astype(np.float32)
    for step in range(_STEPS):
        smooth = smooth if step == 0 else _smooth(found)
        warped = cv2.remap(other, u - smooth, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slope = cv2.remap(gradient, u - smooth, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        moved, bound = _gauss_newton(reference, warped, slope, weight)
        departs, found = found, np.where(known, smooth - moved, _NOWHERE)
    # Rectification leaves as much along the rows as across them, where it can be seen.
    variance = _variance(found, departs, smooth, bound, _FLOOR + float(np.mean(offset**2)))
    return DisparityMap(np.where(known, found, np.float32(np.nan)), variance)


def _variance(
    found: np.ndarray, departs: np.ndarray, smooth: np.ndarray, bound: np.ndarray, floor: float
) -> np.ndarray:
    """Variances (H, W) of disparities, pixels squared, by what the last step began with about the smooth surface."""
    if kernels is not None:
        limits = _NOWHERE, _SAME_SURFACE, _WIDEST_EDGE, floor, _BY_BOUND, _BY_RELIEF, _BY_EDGE
        return np.asarray(kernels.variance(found, departs, smooth, bound, limits))
    known = found > _NOWHERE
    relief = np.where(known, np.minimum(np.abs(departs - smooth), _SAME_SURFACE), np.float32(0.0)) ** 2
    inverse = np.float32(1.0) / np.maximum(window_mean(known.astype(np.float32)), np.float32(1e-3))
    aligned = np.where(known, found, np.float32(0.0))
    edge = np.minimum(np.abs(aligned - window_mean(aligned) * inverse), _WIDEST_EDGE) ** 2
    return np.float32(floor) + _BY_BOUND * bound + _BY_EDGE * edge + _BY_RELIEF * (window_mean(relief) * inverse)


def _gauss_newton(
    reference: np.ndarray, warped: np.ndarray, slope: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Steps (H, W) of the disparities, pixels, and their Cramer-Rao bounds, pixels squared; `weight` is 1 or 0."""
    if kernels is not None:
        limits = _PRIOR_VARIANCE, _WIDEST_BOUND, _ROUNDING, _MOST_GAIN, _LONGEST
        return tuple(kernels.gauss_newton(reference, warped, slope, weight, limits))
    inverse = np.float32(1.0) / np.maximum(window_mean(weight), np.float32(1e-3))

    def mean(weighted: np.ndarray) -> np.ndarray:
        return window_mean(weighted) * inverse

    (mean_reference, spread_reference), (mean_warped, spread) = (
        (each := mean(image * weight), mean((image * weight) ** 2) - each**2) for image in (reference, warped)
    )
    gain = np.sqrt((spread_reference + _ROUNDING) / np.maximum(spread + _ROUNDING, _ROUNDING))
    gain = np.clip(gain, 1.0 / _MOST_GAIN, _MOST_GAIN)
    difference = ((reference - mean_reference) - gain * (warped - mean_warped)) * weight
    slope = slope * (gain * weight)
    mean_slope, mean_difference = mean(slope), mean(difference)
    texture = np.maximum(mean(slope * slope) - mean_slope**2, np.float32(1e-6))
    product = mean(slope * difference) - mean_slope * mean_difference
    unexplained = mean(difference * difference) - mean_difference**2 - product**2 / texture
    # Grey values are whole numbers: their rounding is noise where nothing else is.
    noise = (np.maximum(unexplained, 0.0) + _ROUNDING) * inverse / np.float32(len(_WINDOW) ** 2)
    moved = product / (texture + noise / _PRIOR_VARIANCE)
    return np.clip(moved, -_LONGEST, _LONGEST), np.minimum(noise / texture, _WIDEST_BOUND)


def row_offset(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> np.ndarray:
    """Rows (H, W) float32 by which the right image shows pixels of the left one lower: what rectification left over.

    Least squares over the whole image of a plane, which roll, pitch and unlike focal lengths make to first order.

    Args:
        left, right: (H, W) float32 images.
        disparity: (H, W) float32, NaN where there is none.
    """
    height, width = left.shape
    across = np.arange(width, dtype=np.float32) / width - np.float32(0.5)
    down = (np.arange(height, dtype=np.float32) / height - np.float32(0.5))[:, None]
    rows = slice(None, None, _ROW_STRIDE)
    known = np.isfinite(disparity[rows])
    plane = np.zeros(3, np.float32)
    if not known.any():
        return np.zeros_like(left)
    # Brightness differs in what is smooth.
    left, right = (image - cv2.blur(image, _ROW_WINDOW) for image in (left, right))
    gradient = cv2.filter2D(right, -1, np.array([[-0.5], [0.0], [0.5]], np.float32))
    u, v = pixel_grid(height, width)
    columns = u[rows] - np.where(known, disparity[rows], np.float32(0.0))
    # Moments of slopes by powers of both coordinates give the normal equations.
    powers = np.stack([np.ones_like(across), across, across**2], axis=1)
    heights = np.stack([np.ones_like(down[rows, 0]), down[rows, 0], down[rows, 0] ** 2])
    for _ in range(_ROW_STEPS):
        lines = v[rows] + (plane[0] + plane[1] * across + plane[2] * down[rows])
        warped, slope = (cv2.remap(image, columns, lines, cv2.INTER_LINEAR) for image in (right, gradient))
        difference = left[rows] - warped
        size = np.abs(difference)
        slope *= known & (size < _OUTLYING * np.median(size[known]))
        normal, product = (heights @ each @ powers for each in (slope * slope, slope * difference))
        (one, by_u, by_uu), (by_v, by_uv, _), (by_vv, _, _) = normal
        normal = np.array([[one, by_u, by_v], [by_u, by_uu, by_uv], [by_v, by_uv, by_vv]])
        moments = np.array([product[0, 0], product[0, 1], product[1, 0]])
        plane += np.linalg.solve(normal + _ROW_INFORMATION * np.eye(3, dtype=np.float32), moments)
    return np.clip(plane[0] + plane[1] * across + plane[2] * down, -_MOST_ROWS, _MOST_ROWS)


def _smooth(disparity: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.bilateralFilter(disparity, _DIAMETER, _SAME_SURFACE, _SPREAD))


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates u and v of all pixels, (H, W) float32 each."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return u, v


def window_mean(values: np.ndarray) -> np.ndarray:
    """Means over the window of each pixel."""
    return np.asarray(cv2.sepFilter2D(values, -1, _WINDOW, _WINDOW))
