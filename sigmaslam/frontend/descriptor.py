"""Front-end for keypoints with descriptors, learned or classical: detect, match, refine, estimate confidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.lucas_kanade import refine
from sigmaslam.frontend.match_confidence import MIN_LOGIT, ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere, nearest_in_ellipses, nearest_in_rows
from sigmaslam.frontend.plane_alignment import refine_in_rows, refine_on_planes
from sigmaslam.frontend.types import Features, KeypointSearch, Refinement, StereoView, TemporalMatches

_ROW_TOLERANCE = 2.0
# A little below zero, so that points at infinity survive a disparity offset.
_LEAST_DISPARITY = -2.0
# Share of the image width that disparity may reach.
_MOST_DISPARITY = 0.25
# What is more likely wrong than right is left out.
_LEAST_PROBABILITY = 0.5

Detector = Callable[[np.ndarray], Features]


@dataclass(frozen=True, slots=True)
class RefinedMatches:
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

    def select(self, index: np.ndarray) -> RefinedMatches:
        """The matches of that index or mask."""
        return RefinedMatches(
            self.index0[index], self.index1[index], self.places[index], self.probability[index], self.covariance[index]
        )


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


def match_stereo(
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
        _ROW_TOLERANCE,
        (_LEAST_DISPARITY, _MOST_DISPARITY * left.shape[1]),
    )
    found = refine_with_confidence(
        estimator,
        left,
        right,
        features_left,
        features_right,
        putative,
        lambda points0, points1, *_: refine_in_rows(left, right, points0, points1),
    )
    level = np.abs(found.places[:, 1] - features_left.keypoints[found.index0, 1]) <= _ROW_TOLERANCE
    return found.select(level & (found.probability >= _LEAST_PROBABILITY))


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
        """Features of both images, matched along the rows."""
        features = self._detect(left)
        found = match_stereo(self._estimator, left, right, features, self._detect(right))
        disparity, sigma = np.full((2, len(features.keypoints)), np.nan)
        disparity[found.index0] = features.keypoints[found.index0, 0] - found.places[:, 0]
        sigma[found.index0] = np.sqrt(found.covariance[:, 0, 0])
        return StereoView(left, right, features, disparity, sigma)

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
        found = found.select(found.probability >= _LEAST_PROBABILITY)
        return TemporalMatches(
            search.index[found.index0],
            found.places,
            view.disparity[found.index1],
            found.covariance.astype(np.float64),
            view.disparity_sigma[found.index1],
            found.probability,
        )
