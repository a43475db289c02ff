"""A frame with the landmarks that were found in it, for pictures."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.slam.guided_matching import GuidedMatches


@dataclass(frozen=True, slots=True)
class MatchedFrame:
    """What a frame saw; it refers to arrays of the tracker and costs nothing until they are asked for.

    Attributes:
        left, right: (H, W) uint8, rectified.
        landmark: (M,) numbers of the landmarks that were matched, which no other landmarks of the run have.
        matches: of them.
        agreeing: (M,) bool, the matches that the pose agrees with; None without a pose.
        usable: (H, W) bool, pixels of the left image that no mask hides; None: all.
    """

    left: np.ndarray
    right: np.ndarray
    landmark: np.ndarray
    matches: GuidedMatches
    agreeing: np.ndarray | None
    usable: np.ndarray | None = None

    @property
    def pixels(self) -> np.ndarray:
        """(M, 2) places (u, v) in the left image."""
        return self.matches.views.measurement[:, :2]

    @property
    def covariance(self) -> np.ndarray:
        """(M, 2, 2) of them, pixels squared, given where the landmark's first keyframe saw it."""
        return self.matches.views.covariance[:, :2, :2]

    @property
    def inliers(self) -> np.ndarray:
        """(M,) bool, the matches that the pose agrees with; none without a pose."""
        return np.zeros(len(self.landmark), bool) if self.agreeing is None else self.agreeing
