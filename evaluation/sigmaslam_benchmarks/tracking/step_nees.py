"""Whether a covariance of a pose is right as that of the last step, where it does not grow along the path."""

import numpy as np

from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam_evaluation.metrics.trajectory_errors import associate, is_regular


def step_nees(estimate: Trajectory, truth: Trajectory, covariance: np.ndarray) -> np.ndarray:
    """NEES of the step from each associated pose to the next, per degree of freedom: 1 in the mean is right.

    The error is log(T_i_j^-1 T_i_j of the truth), in the frame at the step's end. Steps whose covariance is singular
    are left out.

    Args:
        estimate: N poses; truth: any number.
        covariance: (N, 6, 6) of the step that ends in each pose, in the body frame there, translation (metres) before
            rotation (radians).
    Returns:
        (M,) values, M < N.
    Raises:
        InputError: no timestamps agree.
    """
    of_estimate, of_truth = associate(estimate, truth)
    estimated, true = estimate.poses[of_estimate], truth.poses[of_truth]
    steps, true_steps = (se3_inverse(poses[:-1]) @ poses[1:] for poses in (estimated, true))
    errors, P = se3_log(se3_inverse(steps) @ true_steps), covariance[of_estimate[1:]]
    used = is_regular(P)
    return np.asarray(squared_mahalanobis(errors[used], P[used]) / 6)
