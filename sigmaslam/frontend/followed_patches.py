"""Patches of one image found in another one without features: from a start, else from where their neighbours went."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from sigmaslam.frontend.affine_alignment import AlignedPatches, align_patches
from sigmaslam.frontend.knn import nearest_points
from sigmaslam.frontend.lucas_kanade import lucas_kanade
from sigmaslam.frontend.nearest_neighbours import within_ellipses
from sigmaslam.frontend.patch_kernels import Images, compiled
from sigmaslam.frontend.types import PatchMaps
from sigmaslam.table import Table

# Of the optical flow that gives starts, in images of half the size: side of its patches, pixels, and levels above.
_FLOW_WINDOW, _FLOW_LEVELS = 11, 2
# Patches in samples, Gauss-Newton steps, and the window's standard deviation in radii.
_RADIUS, _ITERATIONS, _TAPER = 5, 5, 1.0
# A patch that agrees less than this where it was followed to is searched for again.
_MIN_AGREEMENT = 0.9
# First in images so much smaller: alignment moves a patch by 3 pixels, there by 12 and 6 of the image.
_SCALES = (4, 2)
# A prediction is corrected by so many neighbours, where there are enough.
_CORRECTING, _MIN_CORRECTING = 7, 8
# Neighbours that a found place is compared with.
_COMPARED = 12
# No slopes.
_LEVEL = np.zeros((0, 2))


@dataclass(frozen=True, slots=True)
class PatchTargets(Table):
    """Patches of one image or several that are wanted in another one.

    Attributes:
        points: (K, 2) float64 their centres, pixels.
        maps: how they change.
        predicted: (K, 2) where they are expected, pixels of the other image.
        covariance: (K, 2, 2) of that, pixels squared; only its 99 % ellipse counts.
        start: (K, 2) where they were followed to; NaN where that is not known.
        corrected: (K, 2) where they are expected by what their neighbours were followed to.
        source: (K,) which of several images each patch is of; None: there is one.
    """

    points: np.ndarray
    maps: PatchMaps
    predicted: np.ndarray
    covariance: np.ndarray
    start: np.ndarray
    corrected: np.ndarray
    source: np.ndarray | None = None


def correct_by_neighbours(predicted: np.ndarray, start: np.ndarray) -> np.ndarray:
    """(K, 2) predictions moved by what the seven nearest starts are off, in the median.

    Args:
        predicted: (K, 2) pixels.
        start: (K, 2) where patches were followed to; NaN where that is not known.
    """
    known = np.flatnonzero(np.isfinite(start[:, 0]))
    if len(known) < _MIN_CORRECTING:
        return predicted
    reference, departure, count = predicted[known], start[known] - predicted[known], min(_CORRECTING, len(known))
    kernels = compiled()
    if kernels is not None:
        medians = kernels.neighbour_medians(reference, predicted, departure, 0, count, reference, _LEVEL)
        return np.asarray(predicted + medians[:, :2])
    return np.asarray(predicted + np.median(departure[nearest_points(reference, predicted, count)], axis=1))


def follow_flow(
    image0: np.ndarray, image1: np.ndarray, points: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Starts for `find_patches` by optical flow between images of half the size, which alignment makes exact.

    Args:
        image0, image1: (H, W) uint8.
        points, guess: (M, 2) in image 0, and about where they are in image 1, pixels.
    Returns:
        As of `lucas_kanade`.
    """
    half0, half1 = _half(image0), _half(image1)
    found, inside = lucas_kanade(half0, half1, 0.5 * points - 0.25, 0.5 * guess - 0.25, _FLOW_WINDOW, _FLOW_LEVELS)
    return 2.0 * found + 0.5, inside


def shrink(image: np.ndarray) -> tuple[np.ndarray, ...]:
    """The (H, W) uint8 image at a quarter and half of the size, as `find_patches` takes it."""
    half = _half(image)
    return _half(half), half


def _half(image: np.ndarray) -> np.ndarray:
    # By exactly two, for which OpenCV has a fast way: odd sizes are rounded.
    return cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def find_patches(
    image0: Images,
    image1: np.ndarray,
    small0: tuple[Images, ...],
    small1: tuple[np.ndarray, ...],
    targets: PatchTargets,
) -> tuple[np.ndarray, np.ndarray]:
    """Aligns patches, from their starts or, where there is none or it fits badly, from coarse to fine.

    Args:
        image0, image1: (H, W) uint8; of image 0 there may be several.
        small0, small1: the same, shrunk by `shrink`.
        targets: the patches of image 0.
    Returns:
        (K, 2) places in image 1 and (K,) bool, whether the patch was found there within its ellipse.
    """
    followed = np.isfinite(targets.start[:, 0])
    start = np.where(followed[:, None], targets.start, targets.corrected)
    first = _align(image0, image1, targets, start)
    places, found = first.places, first.moved & within_ellipses(first.places - targets.predicted, targets.covariance)
    again = np.flatnonzero(~found | ~followed | (first.correlation < _MIN_AGREEMENT))
    if len(again):
        wanted = targets.select(again)
        start = _coarse_to_fine(small0, small1, wanted)
        second = _align(image0, image1, wanted, start)
        better = second.moved & within_ellipses(second.places - wanted.predicted, wanted.covariance)
        better &= ~found[again] | (second.correlation > first.correlation[again])
        places[again[better]] = second.places[better]
        found[again[better]] = True
    return places, found


def compare_with_neighbours(
    places: np.ndarray, predicted: np.ndarray, slope: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """How found places depart from their prediction, beside how their neighbours do.

    Args:
        places, predicted: (M, 2) pixels.
        slope: (M, 2) by how much a disparity, the departure along the row, grows with either coordinate of the
            prediction; by default not at all.
    Returns:
        (M, 2) departure less the median of the twelve nearest others, and (M,) the median distance of theirs from
        that; zero where there are no others.
    """
    count = min(_COMPARED + 1, len(places))
    if count < 2:
        return np.zeros((len(places), 2)), np.zeros(len(places))
    departure, kernels = places - predicted, compiled()
    if kernels is not None:
        slopes = _LEVEL if slope is None else slope
        medians = kernels.neighbour_medians(places, places, departure, 1, count, predicted, slopes)
        return departure - medians[:, :2], medians[:, 2]
    near = nearest_points(places, places, count)[:, 1:]
    neighbours = departure[near]
    if slope is not None:
        apart = predicted[near] - predicted[:, None]
        neighbours[..., 0] += np.einsum("mkj,mj->mk", apart, slope)
    usual = np.median(neighbours, axis=1)
    return departure - usual, np.median(np.linalg.norm(neighbours - usual[:, None], axis=2), axis=1)


def _align(image0: Images, image1: np.ndarray, targets: PatchTargets, start: np.ndarray) -> AlignedPatches:
    points, source = (targets.points, start, targets.maps.A, targets.maps.tilt), targets.source
    return align_patches(image0, image1, *points, radius=_RADIUS, iterations=_ITERATIONS, taper=_TAPER, source=source)


def _coarse_to_fine(small0: tuple[Images, ...], small1: tuple[np.ndarray, ...], targets: PatchTargets) -> np.ndarray:
    """(K, 2) places by alignment at a quarter and half of the size, from where the neighbours went."""
    places = targets.corrected
    for scale, image0, image1 in zip(_SCALES, small0, small1, strict=True):
        maps = PatchMaps(targets.maps.A, targets.maps.tilt * scale)
        points, start = ((pixels + 0.5) / scale - 0.5 for pixels in (targets.points, places))
        aligned = _align(image0, image1, replace(targets, points=points, maps=maps), start)
        places = np.where(aligned.moved[:, None], (aligned.places + 0.5) * scale - 0.5, places)
    return places
