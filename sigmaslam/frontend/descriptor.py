"""Front-end for keypoints with descriptors, learned or classical: detect, match, refine, estimate confidence."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.followed_patches import PatchTargets, correct_by_neighbours, find_patches, shrink
from sigmaslam.frontend.lucas_kanade import refine
from sigmaslam.frontend.match_confidence import MIN_LOGIT, ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere, nearest_in_ellipses, within_ellipses
from sigmaslam.frontend.patch_evidence import Evidence, examine_patches
from sigmaslam.frontend.plane_alignment import refine_on_planes
from sigmaslam.frontend.row_search import REACH_PREDICTED, REACH_SEARCHED, align_in_rows, search_rows
from sigmaslam.frontend.types import Features, KeypointSearch, PatchMaps, Refinement, StereoView, TemporalMatches
from sigmaslam.frontend.verifier_inputs import PlaceSearch
from sigmaslam.table import Table

# A little below zero, so that points at infinity survive a disparity offset.
_LEAST_DISPARITY = -2.0
LEAST_PROBABILITY = 0.5
"""What is more likely wrong than right is left out."""
# Pixels from anywhere.
_NOWHERE = 1e6

Detector = Callable[[np.ndarray], Features]


@dataclass(frozen=True, slots=True)
class RefinedMatches(Table):
    """One-to-one matches of two images, refined.

    Attributes:
        index0, index1: (M,) keypoints of either image.
        places: (M, 2) float64 in image 1, refined, pixels.
        probability: (M,) that the match is right.
        covariance: (M, 2, 2) of the places given the keypoints of image 0, pixels squared.
    """

    index0: np.ndarray
    index1: np.ndarray
    places: np.ndarray
    probability: np.ndarray
    covariance: np.ndarray


Refine = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], Refinement]
"""From keypoints (M, 2), (M, 2) of two images, the index (M,) of the first ones, and the scorer's logit (M,)."""


def refine_with_confidence(
    estimator: ConfidenceEstimator,
    image0: np.ndarray,
    image1: np.ndarray,
    features0: Features,
    features1: Features,
    putative: Putative,
    refined: Refine,
) -> RefinedMatches:
    """The mutual matches that the scorer does not refuse, refined, with their confidence.

    Args:
        estimator: of the matches.
        image0, image1: (H, W) uint8.
        features0, features1: of these.
        putative: nearest neighbours among them.
        refined: moves them to where the patches agree.
    """
    logit = estimator.score(putative, features0, features1)
    kept = putative.mutual & (logit > MIN_LOGIT)
    index0, index1, logit = putative.index0[kept], putative.index1[kept], logit[kept]
    points0 = features0.keypoints[index0]
    refinement = refined(points0, features1.keypoints[index1], index0, logit)
    sigma = features0.sigma[index0], features1.sigma[index1]
    probability, covariance = estimator.verify(image0, image1, points0, logit, refinement, sigma)
    return RefinedMatches(index0, index1, refinement.places, probability, covariance)


@dataclass(frozen=True, slots=True)
class RowMatches:
    """Points of the left image of a rectified pair, found in the right one.

    Attributes:
        index: (M,) which of the points.
        places: (M, 2) float64 in the right image, pixels.
        covariance: (M, 2, 2) of the places given the points, pixels squared.
    """

    index: np.ndarray
    places: np.ndarray
    covariance: np.ndarray


def match_rows(
    estimator: ConfidenceEstimator,
    left: np.ndarray,
    right: np.ndarray,
    points: np.ndarray,
    start: np.ndarray,
    sigma0: np.ndarray,
    search: PlaceSearch,
) -> RowMatches:
    """Points of the left image aligned in the right one; what is more likely wrong than right is left out.

    Args:
        estimator: of the matches.
        left, right: (H, W) uint8, a rectified pair.
        points, start: (M, 2) float64 in the left image, and about where they are in the right one, pixels.
        sigma0: (M,) of the points, pixels.
        search: where the start comes from, `ALONG_ROWS` or `PREDICTED_ALONG_ROWS`.
    """
    is_predicted = search is PlaceSearch.PREDICTED_ALONG_ROWS
    reach = REACH_PREDICTED if is_predicted else REACH_SEARCHED
    places, there, slope = align_in_rows(left, right, points, start, reach)
    index = np.flatnonzero(there)
    points, places = points[index], places[index]
    evidence = examine_patches(left, right, points, places)
    predicted, slopes = (start[index], None) if is_predicted else (points, slope[index])
    probability, covariance = estimator.verify_places(places, predicted, evidence, sigma0[index], search, slopes)
    likely = np.flatnonzero(probability >= LEAST_PROBABILITY)
    return RowMatches(index[likely], places[likely], covariance[likely].astype(np.float64))


class DescriptorFrontend:
    """Matches by mutual nearest descriptor, patches aligned, each with its own covariance.

    Args:
        name: for reports.
        detect: image (H, W) uint8 to features.
        estimator: of the matches.
    """

    def __init__(self, name: str, detect: Detector, estimator: ConfidenceEstimator) -> None:
        self.name = name
        self._detect = detect
        self._estimator = estimator

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        """Features of the left image, searched for along the rows of the right one."""
        features = self._detect(left)
        index, start = search_rows(left, right, features.keypoints)
        points = features.keypoints[index].astype(np.float64)
        found, values, sigmas = self._disparities(
            left, right, points, start, features.sigma[index], PlaceSearch.ALONG_ROWS
        )
        behind = values < _LEAST_DISPARITY
        disparity, sigma = np.full((2, len(features.keypoints)), np.nan)
        index = index[found[~behind]]
        disparity[index], sigma[index] = values[~behind], sigmas[~behind]
        return StereoView(left, right, features, disparity, sigma, behind=values[behind], small=shrink(left))

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        """Mutual nearest neighbours within the ellipses of the prediction, or anywhere."""
        key, maps, covariance = search.key, search.maps, search.covariance
        wanted = key.features.select(search.index)
        descriptors = wanted.descriptors, view.features.descriptors
        putative = (
            nearest_anywhere(*descriptors)
            if covariance is None
            else nearest_in_ellipses(search.predicted, covariance, view.features.keypoints, *descriptors)
        )

        def refined(points0: np.ndarray, points1: np.ndarray, index0: np.ndarray, _: np.ndarray) -> Refinement:
            if maps is not None:
                return refine_on_planes(key.left, view.left, points0, points1, maps.select(index0))
            return refine(key.left, view.left, points0, points1)

        found = refine_with_confidence(self._estimator, key.left, view.left, wanted, view.features, putative, refined)
        found = found.select(found.probability >= LEAST_PROBABILITY)
        return TemporalMatches(
            search.index[found.index0],
            found.places,
            view.disparity[found.index1],
            found.covariance.astype(np.float64),
            view.disparity_sigma[found.index1],
            found.probability,
        )

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        """Patches aligned to where they were followed, or to where their neighbours went."""
        if not searches:
            return []
        found = _find(searches, np.concatenate(starts), left)
        verified = self._estimator.verify_places(
            found.places, found.predicted, found.evidence, found.sigma0, PlaceSearch.IN_TIME
        )
        likely = verified[0] >= LEAST_PROBABILITY
        found, probability, covariance = found.select(likely), verified[0][likely], verified[1][likely]
        start = found.places - np.column_stack([found.expected_disparity, np.zeros(len(found))])
        index, *measured = self._disparities(
            left, right, found.places, start, found.sigma0, PlaceSearch.PREDICTED_ALONG_ROWS
        )
        disparity, sigma = np.full((2, len(found)), np.nan)
        disparity[index], sigma[index] = measured
        covariance = covariance.astype(np.float64)
        matches = TemporalMatches(found.key_index, found.places, disparity, covariance, sigma, probability)
        return [matches.select(found.search == number) for number in range(len(searches))]

    def _disparities(
        self,
        left: np.ndarray,
        right: np.ndarray,
        points: np.ndarray,
        start: np.ndarray,
        sigma0: np.ndarray,
        search: PlaceSearch,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which of the points (M, 2) are found in the right image from a start, their disparities and sigmas."""
        found = match_rows(self._estimator, left, right, points, start, sigma0, search)
        return found.index, points[found.index, 0] - found.places[:, 0], np.sqrt(found.covariance[:, 0, 0])


@dataclass(frozen=True, slots=True)
class _FollowedPatches(Table):
    """M keypoints of keyframes in an image, before they are verified.

    Each is number `key_index` of the features of the keyframe of `search`; it was expected at `predicted` (M, 2) with
    `expected_disparity`, and found at `places` (M, 2), all in pixels as is its `sigma0`.
    """

    search: np.ndarray
    key_index: np.ndarray
    predicted: np.ndarray
    expected_disparity: np.ndarray
    sigma0: np.ndarray
    places: np.ndarray
    evidence: Evidence


def _find(searches: list[KeypointSearch], start: np.ndarray, left: np.ndarray) -> _FollowedPatches:
    """The keypoints of keyframes that are found in an image; start: (K, 2) of all, NaN where that is not known."""
    views = [search.key for search in searches]
    counts = [len(search.index) for search in searches]
    parts = []
    for search in searches:
        if search.maps is None or search.covariance is None or search.disparity is None:
            raise ValueError("keypoints are followed with a prediction of their places, patches and disparities")
        features = search.key.features
        keypoints, sigma = features.keypoints[search.index], features.sigma[search.index]
        parts.append((search.index, keypoints, sigma, search.predicted, search.covariance, search.disparity))
    index, keypoints, sigma, predicted, covariance, disparity = map(np.concatenate, zip(*parts, strict=True))
    # Starts outside of the ellipses of their predictions are none.
    offset = np.nan_to_num(start - predicted, nan=_NOWHERE)
    start = np.where(within_ellipses(offset, covariance)[:, None], start, np.nan)
    maps = PatchMaps.concatenate([search.maps for search in searches if search.maps is not None])
    points, source = keypoints.astype(np.float64), np.repeat(np.arange(len(views), dtype=np.int32), counts)
    corrected = correct_by_neighbours(predicted, start)
    targets = PatchTargets(points, maps, predicted, covariance, start, corrected, source)
    images, small = [view.left for view in views], tuple(zip(*(view.small for view in views), strict=True))
    places, found = find_patches(images, left, small, shrink(left), targets)
    rows = np.flatnonzero(found)
    places, source = places[rows], source[rows]
    evidence = examine_patches(images, left, points[rows], places, maps.A[rows], source)
    return _FollowedPatches(source, index[rows], predicted[rows], disparity[rows], sigma[rows], places, evidence)
