"""Covariances of true poses, where the truth was measured, too."""

import math

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse, turn_covariance


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
