"""Matches between the two eyes, searched in the whole image so that wrong rows and swapped eyes show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from sigmaslam.frontend.image_pair import MIN_PROBABILITY, match_features
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.lucas_kanade import follow_both_ways
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers.stereo_sequence import FrameStep, StereoFrame
from sigmaslam.table import Table

_KEYPOINTS = 512


@dataclass(frozen=True, slots=True)
class EyeMatches(Table):
    """Matches of the left with the right image of rectified pairs, those of all pairs in one table.

    Attributes:
        left, right: (M, 2) float64 pixels (u, v).
        covariance: (M, 2, 2) of right given left, pixels squared.
        probability: (M,) that the match is right, 0.5 at least.
        flow: (M, 2) motion of the right place to the next right image, pixels; NaN where it could not be followed.
        pair: (M,) number of the pair.
    """

    left: np.ndarray
    right: np.ndarray
    covariance: np.ndarray
    probability: np.ndarray
    flow: np.ndarray
    pair: np.ndarray

    @classmethod
    def empty(cls) -> Self:
        """No matches."""
        places = np.zeros((0, 2))
        return cls(places, places, np.zeros((0, 2, 2)), np.zeros(0), places, np.zeros(0, int))

    def unfollowed(self) -> Self:
        """The same without motion."""
        return replace(self, flow=np.full_like(self.flow, np.nan))

    @property
    def row_difference(self) -> np.ndarray:
        """(M,) row in the right image minus row in the left one, pixels; zero if all is right."""
        return np.asarray(self.right[:, 1] - self.left[:, 1])

    @property
    def disparity(self) -> np.ndarray:
        """(M,) pixels."""
        return np.asarray(self.left[:, 0] - self.right[:, 0])


class EyeMatcher:
    """Matches the eyes of pairs with the shipped features."""

    def __init__(self, rectifier: StereoRectifier, threads: int = 2) -> None:
        self.rectifier = rectifier
        self._detect = LearnedDetector(_KEYPOINTS, threads=threads)
        self._estimator = ConfidenceEstimator()

    def match(self, steps: Sequence[FrameStep]) -> EyeMatches:
        """Matches of the first frame of each step, and their motion to the second."""
        return EyeMatches.concatenate([self._match_pair(pair, step) for pair, step in enumerate(steps)])

    def count_keypoints(self, frame: StereoFrame) -> int:
        """Number of keypoints in the left image."""
        return len(self._detect(self.rectifier.rectify(frame.left, frame.right)[0]).keypoints)

    def _match_pair(self, pair: int, step: FrameStep) -> EyeMatches:
        first, second = step
        left, right = self.rectifier.rectify(first.left, first.right)
        features = self._detect(left), self._detect(right)
        matches = match_features(self._estimator, left, right, *features, MIN_PROBABILITY)
        places = matches.keypoints1.astype(np.float64)
        flow = np.full(places.shape, np.nan)
        if second is not None:
            after = self.rectifier.rectify(second.left, second.right)[1]
            there, good = follow_both_ways(right, after, places, places)
            flow = np.where(good[:, None], there - places, np.nan)
        return EyeMatches(
            matches.keypoints0.astype(np.float64),
            places,
            matches.covariance.astype(np.float64),
            matches.probability.astype(np.float64),
            flow,
            np.full(len(places), pair),
        )


def draw_rows(left: np.ndarray, right: np.ndarray, matches: EyeMatches, tolerance: float) -> np.ndarray:
    """Left over right image (H, W) uint8 with a match in green where the rows agree, else in orange; (2 H, W, 3) BGR.

    A line leads from each place of the left image to where the right one has it, so that rows and disparity show.
    """
    canvases = [cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) for image in (left, right)]
    good = np.abs(matches.row_difference) <= tolerance
    for k in np.argsort(good, kind="stable")[::-1]:
        colour = (115, 158, 0) if good[k] else (0, 94, 213)
        start, end = (np.rint(each[k]).astype(int).tolist() for each in (matches.left, matches.right))
        for canvas in canvases:
            cv2.line(canvas, start, end, colour, 1, cv2.LINE_AA)
        cv2.circle(canvases[0], start, 3, colour, 1, cv2.LINE_AA)
        cv2.circle(canvases[1], end, 3, colour, 1, cv2.LINE_AA)
    return np.vstack(canvases)
