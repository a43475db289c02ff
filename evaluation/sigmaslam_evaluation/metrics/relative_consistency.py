"""Whether poses relative to earlier ones are as sure as they say, where errors of the first true pose do not rule."""

import math
from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.run_record.relative_pose_file import FramePairs
from sigmaslam.slam.relative_poses import SPANS
from sigmaslam_evaluation.metrics.trajectory_errors import associate, coverage, is_regular
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors


@dataclass(frozen=True, slots=True)
class SpanConsistency:
    """Errors of poses relative to earlier ones, over one distance travelled or one time.

    Errors are log(T_i_j^-1 T_i_j of the truth), in the later camera's frame. Covariances are the estimate's and the
    truth's together. Pairs overlap, so their errors are not independent.

    Attributes:
        span: name of the distance or the time, as "10 m" or "5 s".
        nees: (M,) normalised errors squared of all pairs, per degree of freedom: 1 on average is right.
        translation_nees, rotation_nees: means of the 3 of each alone, likewise.
        inside: share of the pairs inside the 95 % ellipsoid (6 degrees of freedom).
        translation_rmse, translation_sigma: root mean square error, and what the covariances say it is, metres.
        rotation_rmse_deg, rotation_sigma_deg: the same of rotations.
        truth_share: median share of the truth in the covariances, 0 to 1; NaN where nothing is known of the truth's.
    """

    span: str
    nees: np.ndarray
    translation_nees: float
    rotation_nees: float
    inside: float
    translation_rmse: float
    translation_sigma: float
    rotation_rmse_deg: float
    rotation_sigma_deg: float
    truth_share: float

    @property
    def count(self) -> int:
        """Number of pairs."""
        return len(self.nees)

    @property
    def mean_nees(self) -> float:
        """Over pairs."""
        return float(self.nees.mean())

    @property
    def median_nees(self) -> float:
        """Over pairs; a right covariance gives 0.89."""
        return float(np.median(self.nees))

    @property
    def truth_rules(self) -> bool:
        """The truth is no better than the estimate: it makes more than half of the covariances, and of what is seen.

        An estimate that is too sure of itself leaves nearly all of the covariances to the truth; its errors tell.
        """
        return self.truth_share > 0.5 * max(1.0, self.mean_nees)


def relative_consistency(
    pairs: FramePairs, estimate: Trajectory, truth: Trajectory, truth_errors: TruthErrors | None = None
) -> tuple[SpanConsistency, ...]:
    """Consistency of relative poses for each span that has pairs with truth and regular covariances.

    Args:
        pairs: of the estimate.
        estimate: N poses, whose time stamps count.
        truth: any number of poses.
        truth_errors: of the true poses; None: they count as exact.
    Raises:
        InputError: no timestamps agree.
    """
    estimate_index, truth_index = associate(estimate, truth)
    true_row = np.full(len(estimate), -1)
    true_row[estimate_index] = truth_index
    earlier, later = true_row[pairs.earlier], true_row[pairs.later]
    known = (earlier >= 0) & (later >= 0)
    pairs, earlier, later = pairs.select(known), earlier[known], later[known]
    true = se3_inverse(truth.poses[earlier]) @ truth.poses[later]
    covariances, of_truth = pairs.covariance, np.zeros_like(pairs.covariance)
    if truth_errors is not None:
        of_truth = truth_errors.between(truth, earlier, later)
        covariances = covariances + of_truth
    regular = is_regular(covariances)
    errors = se3_log(se3_inverse(pairs.pose) @ true)
    found = []
    for span in SPANS:
        rows = regular & (pairs.span == span)
        if rows.any():
            parts = of_truth[rows] if truth_errors is not None else None
            found.append(_judge(span, errors[rows], covariances[rows], parts))
    return tuple(found)


def _judge(span: str, errors: np.ndarray, covariances: np.ndarray, of_truth: np.ndarray | None) -> SpanConsistency:
    """Of errors (M, 6), covariances (M, 6, 6), and the truth's part in them."""
    nees = squared_mahalanobis(errors, covariances) / 6
    halves = (slice(0, 3), slice(3, 6))
    partial = [squared_mahalanobis(errors[:, half], covariances[:, half, half]).mean() / 3 for half in halves]
    rmse = [np.sqrt((errors[:, half] ** 2).sum(axis=1).mean()) for half in halves]
    sigma = [np.sqrt(np.trace(covariances[:, half, half], axis1=1, axis2=2).mean()) for half in halves]
    share = math.nan
    if of_truth is not None:
        share = float(np.median(np.trace(np.linalg.solve(covariances, of_truth), axis1=1, axis2=2) / 6))
    return SpanConsistency(
        span=span,
        nees=nees,
        translation_nees=float(partial[0]),
        rotation_nees=float(partial[1]),
        inside=coverage(nees, 6),
        translation_rmse=float(rmse[0]),
        translation_sigma=float(sigma[0]),
        rotation_rmse_deg=float(np.degrees(rmse[1])),
        rotation_sigma_deg=float(np.degrees(sigma[1])),
        truth_share=share,
    )
