"""Probability and covariance of matches, from ONNX graphs or the same networks in torch."""

from collections.abc import Callable, Mapping

import numpy as np

from sigmaslam.frontend.followed_patches import compare_with_neighbours
from sigmaslam.frontend.nearest_neighbours import Putative
from sigmaslam.frontend.patch_evidence import Evidence, examine_patches
from sigmaslam.frontend.scorer_inputs import nearest_matches, side_information
from sigmaslam.frontend.types import Features, Refinement
from sigmaslam.frontend.verifier_inputs import PlaceSearch, describe_matches, describe_places
from sigmaslam.inference.backends import open_network
from sigmaslam.inference.networks import WeightsFolder

MIN_LOGIT = -4.0
"""Matches with a smaller logit from the scorer are dropped; the verifier was trained without them."""

_Graph = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]


class ConfidenceEstimator:
    """Estimates the probability that a match is right, and the covariance of its error.

    Args:
        backend: "onnx", or "torch" (needs the extra `train`).
        provider: where ONNX Runtime computes.
        weights: folder of networks of one's own; None, and for those that it lacks: the ones that ship.
    """

    def __init__(self, backend: str = "onnx", provider: str = "cpu", weights: WeightsFolder = None) -> None:
        self._scorer: _Graph = open_network("scorer", weights, provider=provider, backend=backend)
        self._verifier: _Graph = open_network("verifier", weights, provider=provider, backend=backend)
        self._place_verifier: _Graph = open_network("place_verifier", weights, provider=provider, backend=backend)

    def score(self, putative: Putative, features0: Features, features1: Features) -> np.ndarray:
        """Logit (M,) that each match is right, from its neighbours and its margins, without the images.

        Args:
            putative: nearest neighbours, mutual or not, of one pair of images.
            features0, features1: of these.
        """
        if len(putative.index0) == 0:
            return np.zeros(0, np.float32)
        points0, points1 = (
            np.asarray(features.keypoints[index], np.float32)
            for features, index in ((features0, putative.index0), (features1, putative.index1))
        )
        feed = {
            "points0": points0,
            "points1": points1,
            "side": side_information(putative, features0, features1),
            "near": nearest_matches(points0, putative.mutual),
        }
        return self._scorer(feed)[0]

    def verify(
        self,
        image0: np.ndarray,
        image1: np.ndarray,
        points0: np.ndarray,
        logit: np.ndarray,
        refinement: Refinement,
        sigma: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probability (M,) and covariance (M, 2, 2) of the refined places given points0, pixels squared.

        Args:
            image0, image1: (H, W) uint8.
            points0: (M, 2) in image 0.
            logit: (M,) as `score` gives it.
            refinement: of their places in image 1.
            sigma: (M,) of the detected keypoints in either image, pixels.
        """
        if len(points0) == 0:
            return np.zeros(0, np.float32), np.zeros((0, 2, 2), np.float32)
        evidence = examine_patches(image0, image1, points0, refinement.places, refinement.A)
        columns = describe_matches(logit, evidence, refinement, *sigma)
        probability, covariance = self._verifier({"columns": columns, "axes": evidence.axes.astype(np.float32)})
        return probability, covariance

    def verify_places(
        self,
        places: np.ndarray,
        predicted: np.ndarray,
        evidence: Evidence,
        sigma0: np.ndarray,
        search: PlaceSearch,
        slope: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Probability (M,) and covariance (M, 2, 2) as of `verify`, of places found without features of image 1.

        Args:
            places, predicted: (M, 2) in image 1, pixels; of places along rows the prediction is the keypoint itself.
            evidence: of the patches at the places.
            sigma0: (M,) of the keypoints of image 0, pixels.
            search: how the places were found.
            slope: (M, 2) of the disparities, where they were not predicted.
        """
        if len(places) == 0:
            return np.zeros(0, np.float32), np.zeros((0, 2, 2), np.float32)
        columns = describe_places(*compare_with_neighbours(places, predicted, slope), evidence, sigma0, search)
        probability, covariance = self._place_verifier({"columns": columns, "axes": evidence.axes.astype(np.float32)})
        return probability, covariance
