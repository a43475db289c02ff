"""What the verifier of places learns from: patches of rendered pairs found without features of the second image."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from sigmaslam.errors import SigmaSlamError
from sigmaslam.frontend.affine_alignment import local_maps
from sigmaslam.frontend.followed_patches import (
    PatchTargets,
    compare_with_neighbours,
    correct_by_neighbours,
    find_patches,
    follow_flow,
    shrink,
)
from sigmaslam.frontend.nearest_neighbours import within_ellipses
from sigmaslam.frontend.patch_evidence import examine_patches
from sigmaslam.frontend.row_search import REACH_PREDICTED, REACH_SEARCHED, align_in_rows, search_rows
from sigmaslam.frontend.types import PatchMaps
from sigmaslam.frontend.verifier_inputs import PlaceSearch, describe_places
from sigmaslam_training.matching.match_sets import MatchSet, PairRecord
from sigmaslam_training.matching.verifier_training import VerifierRows, error_along_axes

# Of predictions, pixels: what all are off by, drawn evenly in the logarithm, and what they claim beside it.
_SIGMAS, _OWN_SIGMA = (0.5, 15.0), 1.0
# Their error grows by so much a pixel from the middle of the image; so many have the wrong depth and err on their own.
_STRETCH, _WRONG_DEPTH = 0.01, 0.1
# Places of the last frame carried on are off by so much; hidden ones drift away from where they were.
_CARRIED, _DRIFT, _FORGOTTEN = 0.3, 2.0, 0.1
# Relative error of the patches' maps.
_MAP_ERROR = 0.03
# Pairs whose second image shows another place.
_FOREIGN = 0.15
# Of predicted disparities, pixels, drawn evenly in the logarithm.
_DISPARITY_SIGMAS = (0.1, 1.5)
_MIN_ROWS = 16


def collect_place_rows(records: Iterable[PairRecord], seed: int, note: Callable[[int], None]) -> VerifierRows:
    """Finds the keypoints of all records as the run time does without features of the second image.

    Args:
        records: pairs with their sets.
        seed: of predictions and starts.
        note: is told how many records are done.
    """
    parts = []
    for number, record in enumerate(records):
        rng = np.random.default_rng((seed, 5, number))
        for found in record.sets.values():
            image1, truth = record.image1, np.where(found.visible[:, None], found.expected, np.inf)
            if rng.random() < _FOREIGN:
                image1, truth = (
                    np.roll(image1, [side // 2 for side in image1.shape], (0, 1)),
                    np.full_like(truth, np.inf),
                )
            shown = _Shown((record.image0, image1), found, truth)
            if found.source == "stereo":
                drawn = [_along_rows(shown), _followed_along_rows(shown, rng)]
            else:
                drawn = [_followed(shown, rng)]
            for columns, error in drawn:
                if len(columns) >= _MIN_ROWS:
                    parts.append(VerifierRows(columns, error, np.full(len(columns), number)))
        note(number + 1)
    if not parts:
        raise SigmaSlamError("no keypoint is found again in any pair: train on more pairs")
    return VerifierRows.concatenate(parts)


class _Shown(NamedTuple):
    """Two images, keypoints of the first, and where they lie in the second (N, 2), infinite where not seen."""

    pair: tuple[np.ndarray, np.ndarray]
    found: MatchSet
    truth: np.ndarray


def _followed(shown: _Shown, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Columns and errors of keypoints followed near a prediction."""
    pair, found, _ = shown
    size = np.array(pair[1].shape[::-1])
    sigma = np.exp(rng.uniform(*np.log(_SIGMAS)))
    points = found.features0.keypoints.astype(np.float64)
    stretch = _STRETCH * rng.standard_normal((2, 2))
    predicted = found.expected + sigma * rng.standard_normal(2) + (points - 0.5 * size) @ stretch
    alone = rng.random(len(points)) < _WRONG_DEPTH
    predicted[alone] += sigma * rng.standard_normal((int(alone.sum()), 2))
    usable = np.flatnonzero(((predicted >= 0) & (predicted < size)).all(axis=1))
    points, predicted, expected = points[usable], predicted[usable], found.expected[usable]
    covariance = np.tile((sigma**2 + _OWN_SIGMA**2) * np.eye(2), (len(points), 1, 1))
    start = _starts(shown, usable, predicted, rng)
    start[~within_ellipses(np.nan_to_num(start, nan=1e6) - predicted, covariance)] = np.nan
    A, _ = local_maps(points, expected, np.ones(len(points)))
    A = A @ (np.eye(2) + _MAP_ERROR * rng.standard_normal((len(points), 2, 2)))
    maps = PatchMaps(A, np.zeros_like(points))
    targets = PatchTargets(points, maps, predicted, covariance, start, correct_by_neighbours(predicted, start))
    small0, small1 = (shrink(image) for image in pair)
    places, there = find_patches(*pair, small0, small1, targets)
    search = PlaceSearch.IN_TIME
    return _describe(shown, usable[there], points[there], places[there], predicted[there], search, A[there])


def _starts(shown: _Shown, rows: np.ndarray, predicted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Where such keypoints were followed to: by Lucas-Kanade over the whole way, or carried on from a frame before."""
    found = shown.found
    if rng.random() < 0.5:
        points = found.features0.keypoints[rows].astype(np.float64)
        places, kept = follow_flow(*shown.pair, points, predicted)
    else:
        noise = np.where(found.visible[rows], _CARRIED, _DRIFT)[:, None] * rng.standard_normal(predicted.shape)
        places, kept = found.expected[rows] + noise, rng.random(len(rows)) > _FORGOTTEN
    return np.where(kept[:, None], places, np.nan)


def _along_rows(shown: _Shown) -> tuple[np.ndarray, np.ndarray]:
    """Columns and errors of keypoints searched for along the rows of a stereo pair."""
    pair, found, _ = shown
    index, start = search_rows(*pair, found.features0.keypoints)
    points = found.features0.keypoints[index].astype(np.float64)
    places, there, slope = align_in_rows(*pair, points, start, REACH_SEARCHED)
    points = points[there]
    search = PlaceSearch.ALONG_ROWS
    return _describe(shown, index[there], points, places[there], points, search, slope=slope[there])


def _followed_along_rows(shown: _Shown, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Columns and errors of keypoints whose disparity is predicted."""
    pair, found, _ = shown
    points = found.features0.keypoints.astype(np.float64)
    low, high = np.log(_DISPARITY_SIGMAS)
    sigmas = np.exp(rng.uniform(low, high, 2))
    start = points.copy()
    shifted = found.expected[:, 0] + sigmas[0] * rng.standard_normal()
    start[:, 0] = shifted + sigmas[1] * rng.standard_normal(len(points))
    usable = np.flatnonzero((start[:, 0] >= 0) & (start[:, 0] < pair[1].shape[1]))
    points, start = points[usable], start[usable]
    places, there, _ = align_in_rows(*pair, points, start, REACH_PREDICTED)
    search = PlaceSearch.PREDICTED_ALONG_ROWS
    return _describe(shown, usable[there], points[there], places[there], start[there], search)


def _describe(
    shown: _Shown,
    index: np.ndarray,
    points: np.ndarray,
    places: np.ndarray,
    predicted: np.ndarray,
    search: PlaceSearch,
    A: np.ndarray | None = None,
    slope: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Columns and errors of places (M, 2) of keypoints with that index (M,)."""
    evidence = examine_patches(*shown.pair, points, places, A)
    sigma = shown.found.features0.sigma[index]
    columns = describe_places(*compare_with_neighbours(places, predicted, slope), evidence, sigma, search)
    return columns, error_along_axes(evidence, places, shown.truth[index])
