"""Covariances of true poses, where the truth was measured, too."""

import math
from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class TruthErrors:
    """How far true poses may be off, each independently of the others but for positions that are near in time.

    Attributes:
        covariance: (K, 6, 6) of the poses in their body frames, or (6, 6) of each.
        unrelated_after: seconds; sooner, the sigmas of two positions count in proportion to the time between.
    """

    covariance: np.ndarray
    unrelated_after: float = 0.0

    def between(self, truth: Trajectory, earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
        """(M, 6, 6) of relative poses in the frame of the later ends, from the rows (M,) of both ends."""
        seconds = np.abs(truth.timestamps[later] - truth.timestamps[earlier])
        factors = np.ones((len(seconds), 6, 1))
        factors[:, :3, 0] = np.minimum(seconds / max(self.unrelated_after, 1e-9), 1.0)[:, None]
        each = np.broadcast_to(self.covariance, (len(truth), 6, 6))
        ends = (factors * each[rows] * factors.swapaxes(1, 2) for rows in (earlier, later))
        return relative_truth_covariance(se3_inverse(truth.poses[earlier]) @ truth.poses[later], *ends)

    def turned(self, T: np.ndarray) -> "TruthErrors":
        """In body frames that T (4, 4), or (K, 4, 4), takes the bodies' points into."""
        return replace(self, covariance=turn_covariance(T, self.covariance))


def truth_covariance(position_sigma: float, rotation_sigma_deg: float) -> np.ndarray:
    """(6, 6) of a true pose in its body frame.

    Args:
        position_sigma: standard deviation of each coordinate, metres.
        rotation_sigma_deg: of the rotation about each axis, degrees.
    """
    return np.diag(np.repeat([position_sigma, math.radians(rotation_sigma_deg)], 3) ** 2)


def relative_truth_covariance(relative: np.ndarray, earlier: np.ndarray, later: np.ndarray) -> np.ndarray:
    """Covariances of true relative poses, errors of the two ends independent of each other.

    The rotation of the earlier end has the way between the two as its lever.

    Args:
        relative: (M, 4, 4) T_earlier_later.
        earlier, later: (M, 6, 6) of the true poses, each in its body frame.
    Returns:
        (M, 6, 6) in the frame of the later end.
    """
    return np.asarray(later + turn_covariance(se3_inverse(relative), earlier))
