"""Dense disparity of a rectified pair with a variance for each pixel.

Semi-global matching finds the disparity to a pixel. Its sixteenths are drawn towards whole pixels, so the smoothed map
is aligned anew, by Gauss-Newton steps that minimise the difference of the images in a window around each pixel. What
they leave of the difference, and how much texture it was found by, give the Cramer-Rao bound of the disparity; what it
is off by in truth was fitted on renders.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

# Semi-global matching: side of its blocks, what steps of disparity cost by OpenCV's own rule, by how many percent the
# best must win, and how large what departs by more than a pixel must be to be believed.
_BLOCK = 3
_SMALL_STEP, _LARGE_STEP = 8 * _BLOCK**2, 32 * _BLOCK**2
_UNIQUE, _SPECKLE = 5, 100
# Disparities searched: from behind infinity, for the sake of a disparity offset, to nearer than all of half the image.
_LEAST, _BEYOND = -4, 8
# The largest disparity that half the image is searched for, as a share of its width, and which of them counts.
_WIDEST, _NEARLY_ALL = 0.4, 99.8
# Alignment: radius of the window, steps, and how far one may go, pixels.
_RADIUS, _STEPS, _LONGEST = 3, 2, 0.5
# Smoothing before each step: diameter, what disparities may differ by, and spread, all pixels.
_DIAMETER, _SAME_SURFACE, _SPREAD = 7, 1.0, 3.0
# A pixel this far from the mean of its window is at an edge, and farther makes no difference, pixels.
_WIDEST_EDGE = 2.0
# Squared gradients below this, grey values^2 / pixel^2, are quantisation.
_NO_TEXTURE = 0.05
# Marks pixels without a disparity where NaN would spread.
_NOWHERE = np.float32(-1000.0)

Matcher = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Disparities (H, W) float32 of a rectified pair of (H, W) uint8 images, NaN where there is none."""


@dataclass(frozen=True, slots=True)
class DisparityModel:
    """The variance of a disparity as a sum of what it depends on.

    Attributes:
        floor: variance of the best disparities, pixels squared.
        bound: factor of the Cramer-Rao bound.
        relief: factor of the variance of the disparities around the pixel about a smooth surface.
        edge: factor of the squared distance from their mean, which is large where surfaces meet.
    """

    floor: float
    bound: float
    relief: float
    edge: float


# Fitted on renders of room, street and organ with seeds below 1000, by the likelihood of Student's t distribution with
# five degrees of freedom, then all times 1.2, as the tails on streets are heavier still.
FITTED = DisparityModel(floor=0.01**2, bound=1.8, relief=3.1, edge=3.6)


@dataclass(frozen=True, slots=True)
class DisparityMap:
    """Disparities of the left image of a rectified pair.

    Attributes:
        disparity: (H, W) float32 pixels; NaN where there is none.
        variance: (H, W) float32 pixels squared; NaN where there is no disparity.
    """

    disparity: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True, slots=True)
class Alignment:
    """What the alignment of a disparity map found.

    Attributes:
        disparity: (H, W) float32 pixels, NaN where there was none.
        bound: (H, W) Cramer-Rao bound of its variance for independent noise in the window, pixels squared.
        relief: (H, W) variance of the disparities in the window about the smoothed ones, pixels squared.
        edge: (H, W) squared difference of the disparity and the mean of the window, pixels squared.
    """

    disparity: np.ndarray
    bound: np.ndarray
    relief: np.ndarray
    edge: np.ndarray


def measure_disparity(
    left: np.ndarray, right: np.ndarray, match: Matcher, model: DisparityModel = FITTED
) -> DisparityMap:
    """Disparities with their variances.

    Args:
        left, right: (H, W) uint8 rectified images.
        match: finds disparities to a pixel, such as `semi_global_disparity`.
        model: of the variance.
    """
    aligned = align_disparity(left, right, match(left, right))
    variance = model.floor + model.bound * aligned.bound + model.relief * aligned.relief + model.edge * aligned.edge
    missing = np.isnan(aligned.disparity)
    return DisparityMap(aligned.disparity, np.where(missing, np.nan, variance).astype(np.float32))


def semi_global_disparity(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Disparities (H, W) float32 in sixteenths of a pixel by OpenCV's semi-global matching; NaN where there is none.

    Args:
        left, right: (H, W) uint8 rectified images.
    """
    halves = [cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (left, right)]
    known = _seen_by_both(halves[0], halves[1], _WIDEST * halves[0].shape[1])
    largest = 2.0 * float(np.percentile(known, _NEARLY_ALL)) + _BEYOND if len(known) else 0.0
    return _semi_global(left, right, max(largest, _BEYOND))


def _seen_by_both(left: np.ndarray, right: np.ndarray, largest: float) -> np.ndarray:
    """(N,) disparities that matching from the right image to the left one finds, too, within a pixel.

    Skies and plain walls match anywhere, mostly far off, and would make the search several times as long.
    """
    there = _semi_global(left, right, largest)
    mirrored_left, mirrored_right = (np.ascontiguousarray(image[:, ::-1]) for image in (left, right))
    back = _semi_global(mirrored_right, mirrored_left, largest)[:, ::-1]
    v, u = np.nonzero(np.isfinite(there))
    found = there[v, u]
    u_right = np.rint(u - found).astype(np.int64).clip(0, left.shape[1] - 1)
    return np.asarray(found[np.abs(back[v, u_right] - found) <= 1.0])


def _semi_global(left: np.ndarray, right: np.ndarray, largest: float) -> np.ndarray:
    levels = 16 * int(np.ceil((largest - _LEAST) / 16))
    matcher = cv2.StereoSGBM.create(
        minDisparity=_LEAST,
        numDisparities=levels,
        blockSize=_BLOCK,
        P1=_SMALL_STEP,
        P2=_LARGE_STEP,
        disp12MaxDiff=1,
        uniquenessRatio=_UNIQUE,
        speckleWindowSize=_SPECKLE,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    # It gives none to columns that the whole range of disparities would leave.
    wide = [cv2.copyMakeBorder(image, 0, 0, levels, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    disparity = matcher.compute(*wide)[:, levels:] / np.float32(16.0)
    # What would lie left of the right image matches its repeated border.
    inside = disparity <= np.arange(left.shape[1], dtype=np.float32)
    return np.where((disparity >= _LEAST) & inside, disparity, np.float32(np.nan))


def align_disparity(left: np.ndarray, right: np.ndarray, disparity: np.ndarray) -> Alignment:
    """Aligns the images by Gauss-Newton steps of every pixel's disparity; brightness may differ by an offset.

    Args:
        left, right: (H, W) uint8 rectified images.
        disparity: (H, W) float32 right to about a pixel, NaN where there is none.
    """
    reference, other = left.astype(np.float32), right.astype(np.float32)
    gradient = cv2.filter2D(other, -1, np.array([[-0.5, 0.0, 0.5]], np.float32))
    u, v = pixel_grid(*left.shape)
    known = np.isfinite(disparity)
    weight = known.astype(np.float32)
    share = np.maximum(_mean(weight), 1e-3)

    def mean(values: np.ndarray) -> np.ndarray:
        return _mean(values * weight) / share

    found = np.where(known, disparity, _NOWHERE).astype(np.float32)
    for _ in range(_STEPS):
        smooth = cv2.bilateralFilter(found, _DIAMETER, _SAME_SURFACE, _SPREAD)
        relief = np.where(known, np.minimum(np.abs(found - smooth), _SAME_SURFACE), 0.0) ** 2
        warped = cv2.remap(other, u - smooth, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        slope = cv2.remap(gradient, u - smooth, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        difference = reference - warped
        mean_slope, mean_difference = mean(slope), mean(difference)
        texture = np.maximum(mean(slope * slope) - mean_slope**2, _NO_TEXTURE)
        product = mean(slope * difference) - mean_slope * mean_difference
        unexplained = mean(difference * difference) - mean_difference**2 - product**2 / texture
        found = np.where(known, smooth - np.clip(product / texture, -_LONGEST, _LONGEST), _NOWHERE)
    pixels = (2 * _RADIUS + 1) ** 2 * share
    # Grey values are whole numbers: their rounding is noise where nothing else is.
    bound = (np.maximum(unexplained, 0.0) + 1.0 / 6.0) / (texture * pixels)
    aligned = np.where(known, found, 0.0).astype(np.float32)
    edge = np.minimum(np.abs(aligned - mean(aligned)), _WIDEST_EDGE) ** 2
    return Alignment(
        np.where(known, aligned, np.float32(np.nan)), bound, mean(relief.astype(np.float32)), edge.astype(np.float32)
    )


def pixel_grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates u and v of all pixels, (H, W) float32 each."""
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return u, v


def _mean(values: np.ndarray) -> np.ndarray:
    """Means over the window of each pixel."""
    return np.asarray(cv2.blur(values, (2 * _RADIUS + 1, 2 * _RADIUS + 1)))
