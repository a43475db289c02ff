"""Errors of poses in the sigmas that the tracker claims: over a step, over some frames, since the start."""

import numpy as np
from scipy.special import ndtri_exp

from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.se3 import se3_inverse, se3_log, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam_evaluation.metrics.trajectory_errors import associate, is_regular


def motion_errors(
    estimate: Trajectory, truth: Trajectory, covariance: np.ndarray, frames: int | None = None
) -> np.ndarray:
    """How wrong the motion to each pose is from the pose some frames before, or from the first pose.

    Of the absolute poses' errors only the covariance of each is known, not that between them. The motion is held
    against the sum of both, as if they were independent. As they mostly share what came before, the motion is known
    better than that: errors are larger in sigmas than found here, not smaller.

    Args:
        estimate: N poses.
        truth: a true pose for each of them.
        covariance: (N, 6, 6) of the poses in their body frames, translation (metres) before rotation (radians),
            relative to the first one.
        frames: between the two poses; None: from the first one.
    Returns:
        (N,) size of the error of the motion that ends at each frame under what is claimed, see `sigmas_of_pose`; NaN
        where nothing is claimed.
    Raises:
        ValueError: the covariance is not (N, 6, 6), or frames is not positive.
        InputError: no timestamps agree.
    """
    count = len(estimate)
    if covariance.shape != (count, 6, 6) or (frames is not None and frames < 1):
        raise ValueError(f"give covariances ({count}, 6, 6), not {covariance.shape}, and 1 frame or more, not {frames}")
    index, true_index = associate(estimate, truth)
    true = np.full((count, 4, 4), np.nan)
    true[index] = truth.poses[true_index]
    last = np.arange(frames or 1, count)
    first = np.zeros_like(last) if frames is None else last - frames
    known = np.isfinite(true[first]).all(axis=(1, 2)) & np.isfinite(true[last]).all(axis=(1, 2))
    first, last = first[known], last[known]
    motion = se3_inverse(estimate.poses[first]) @ estimate.poses[last]
    errors = se3_log(se3_inverse(motion) @ se3_inverse(true[first]) @ true[last])
    claimed = covariance[last] + turn_covariance(se3_inverse(motion), covariance[first])
    regular = is_regular(claimed)
    sigmas = np.full(count, np.nan)
    sigmas[last[regular]] = sigmas_of_pose(squared_mahalanobis(errors[regular], claimed[regular]))
    return sigmas


def sigmas_of_pose(squares: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis lengths (N,) of 6 degrees of freedom as sigmas (N,) of one Gaussian that is as rarely passed.

    Five sigmas, passed once in 1.7 million times, are a length of 6.4.
    """
    half = 0.5 * np.asarray(squares, dtype=np.float64)
    # The upper tail of chi-square with 6 degrees of freedom, in closed form: it does not underflow.
    log_tail = -half + np.log1p(half + 0.5 * half**2)
    return np.asarray(-ndtri_exp(log_tail - np.log(2.0)))
