"""Whether poses that are called right are right: errors of the poses of one run against what is claimed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error, is_regular
from sigmaslam_evaluation.metrics.truth_covariance import relative_truth_covariance

_POSITION, _POSE = 3, 6
# An alignment is determined by three; below ten its error says little.
_FEWEST_POSES = 10


@dataclass(frozen=True, slots=True)
class DrivenPose:
    """What a method says of one delivered frame.

    Attributes:
        moment: number of the true pose.
        status: as the method calls it.
        T_world_camera: (4, 4); NaN without a pose.
        covariance: (6, 6) of the pose in the camera's own frame; None where the method claims none.
    """

    moment: int
    status: str
    T_world_camera: np.ndarray
    covariance: np.ndarray | None


@dataclass(frozen=True, slots=True)
class References:
    """What poses are held against.

    Attributes:
        poses: (N, 4, 4) by moment; NaN where nothing is known.
        covariance: (6, 6) of each of them in its own frame; zero where they are exact.
    """

    poses: np.ndarray
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))


@dataclass(frozen=True, slots=True)
class Errors:
    """Errors of poses relative to the start, by delivered frame; NaN where nothing can be said.

    Attributes:
        metres: (M,) of the position.
        position: (M,) squared Mahalanobis length of the position's error, 3 degrees of freedom.
        pose: (M,) the same of the pose's, 6 degrees of freedom.
    """

    metres: np.ndarray
    position: np.ndarray
    pose: np.ndarray

    @property
    def beyond(self) -> np.ndarray:
        """(M,) bool, position or pose is beyond its 99.9 % bound."""
        return (self.position > CHI_SQUARE_999[_POSITION]) | (self.pose > CHI_SQUARE_999[_POSE])

    @property
    def sigmas(self) -> np.ndarray:
        """(M,) length of the position's error in sigmas; 4.0 is its 99.9 % bound."""
        return np.sqrt(self.position)


@dataclass(frozen=True, slots=True)
class Judgement:
    """One method on one faulty recording.

    Attributes:
        statuses: frames by status; those without a pose and those that started included.
        judged: frames called `tracking` whose error is known.
        wrong: of these, moments of the frames beyond the 99.9 % bound of position or pose.
        metres, sigmas: largest errors of the position of frames called `tracking`; NaN where there is none.
        end_metres: of the last frame with a pose.
        away_wrong: as `wrong`, against the run with good frames in place of the truth.
        away_metres, away_sigmas: as `metres` and `sigmas`, against that run.
        said: sentences about the run, warnings first.
        refused: why the run broke off; empty where it did not.
        ate: root mean square error of positions after the best alignment, metres.
        length: of the path, relative to the true one, less one.
        end_sigmas: as `end_metres`, in sigmas.
        learned: errors of the calibration by name: value and standard deviation.
        true_errors: by which the calibration that was given is off from the recording's, by their names.
    """

    statuses: Mapping[str, int]
    judged: int
    wrong: Sequence[int]
    metres: float
    sigmas: float
    end_metres: float
    away_wrong: Sequence[int]
    away_metres: float
    away_sigmas: float
    said: Sequence[str]
    refused: str = ""
    ate: float = float("nan")
    length: float = float("nan")
    end_sigmas: float = float("nan")
    learned: Mapping[str, Sequence[float]] = field(default_factory=dict)
    true_errors: Mapping[str, float] = field(default_factory=dict)

    def silent(self, good: Judgement | None = None) -> int:
        """Frames called `tracking` that are wrong.

        Args:
            good: with a truth that was measured, of the run with good frames: what is wrong by that run counts, too,
                and where that run departs from the truth itself, the truth says nothing of the fault.
        """
        return len(self.wrong) if good is None else len({*self.away_wrong} | ({*self.wrong} - {*good.wrong}))


def pose_errors(poses: Sequence[DrivenPose], references: References) -> Errors:
    """Errors of the motion from the first frame with a pose, which defines the world.

    The covariance of each pose is relative to that frame; of references that were measured, the covariances of both
    ends are added.
    """
    metres, position, pose = (np.full(len(poses), np.nan) for _ in range(3))
    found = [number for number, each in enumerate(poses) if np.isfinite(each.T_world_camera).all()]
    true = np.array([references.poses[each.moment] for each in poses]).reshape(-1, 4, 4)
    found = [number for number in found if np.isfinite(true[number]).all()]
    if not found:
        return Errors(metres, position, pose)
    first, rest = found[0], np.array(found[1:], int)
    estimated = np.array([each.T_world_camera for each in poses])
    motion = se3_inverse(estimated[first]) @ estimated[rest]
    true_motion = se3_inverse(true[first]) @ true[rest]
    errors = se3_log(se3_inverse(motion) @ true_motion)
    metres[rest] = np.linalg.norm(motion[:, :3, 3] - true_motion[:, :3, 3], axis=1)
    claimed = np.array([np.zeros((6, 6)) if each.covariance is None else each.covariance for each in poses])[rest]
    known = is_regular(claimed)
    spread = np.broadcast_to(references.covariance, (len(rest), 6, 6))
    claimed = claimed + relative_truth_covariance(true_motion, spread, spread)
    at = rest[known]
    pose[at] = squared_mahalanobis(errors[known], claimed[known])
    position[at] = squared_mahalanobis(errors[known, :3], claimed[known, :3, :3])
    return Errors(metres, position, pose)


def judge(
    poses: Sequence[DrivenPose],
    truth: References,
    good: References | None = None,
    said: Sequence[str] = (),
    refused: str = "",
    learned: Mapping[str, Sequence[float]] | None = None,
) -> Judgement:
    """Holds the poses of a run against the truth, and against the run with good frames.

    Args:
        poses: of the delivered frames, in order.
        truth, good: by moment; None: nothing is said of it.
        said, refused, learned: see `Judgement`.
    """
    tracking = np.array([each.status == "tracking" for each in poses], bool)
    errors = pose_errors(poses, truth)
    away = errors if good is None else pose_errors(poses, good)
    known, sigmas = (each[np.isfinite(errors.metres)] for each in (errors.metres, errors.sigmas))
    ate, length = _path_errors(poses, truth)
    return Judgement(
        statuses=dict(Counter(each.status for each in poses)),
        judged=int((tracking & np.isfinite(errors.pose)).sum()),
        wrong=[poses[k].moment for k in np.flatnonzero(errors.beyond & tracking).tolist()],
        metres=_largest(errors.metres[tracking]),
        sigmas=_largest(errors.sigmas[tracking]),
        end_metres=float(known[-1]) if len(known) else float("nan"),
        away_wrong=[] if good is None else [poses[k].moment for k in np.flatnonzero(away.beyond & tracking).tolist()],
        away_metres=float("nan") if good is None else _largest(away.metres[tracking]),
        away_sigmas=float("nan") if good is None else _largest(away.sigmas[tracking]),
        said=list(said),
        refused=refused,
        ate=ate,
        length=length,
        end_sigmas=float(sigmas[-1]) if len(sigmas) else float("nan"),
        learned=learned or {},
    )


def good_poses(poses: Sequence[DrivenPose], count: int) -> References:
    """The poses of the run with good frames, by moment; those that are not called `tracking` are left out."""
    by_moment = np.full((count, 4, 4), np.nan)
    for number, each in enumerate(poses):
        if each.status == "tracking" or number == 0:
            by_moment[each.moment] = each.T_world_camera
    return References(by_moment)


def _path_errors(poses: Sequence[DrivenPose], truth: References) -> tuple[float, float]:
    """`ate` and `length` of a judgement."""
    true = np.array([truth.poses[each.moment] for each in poses]).reshape(-1, 4, 4)
    said = np.array([each.T_world_camera for each in poses]).reshape(-1, 4, 4)
    usable = np.isfinite(true).all(axis=(1, 2)) & np.isfinite(said).all(axis=(1, 2))
    if usable.sum() < _FEWEST_POSES:
        return float("nan"), float("nan")
    estimate, exact = (Trajectory(np.arange(float(usable.sum())), each[usable]) for each in (said, true))
    ways = [np.linalg.norm(np.diff(each.positions, axis=0), axis=1).sum() for each in (estimate, exact)]
    return absolute_trajectory_error(estimate, exact).rmse, float(ways[0] / ways[1] - 1.0)


def _largest(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(values.max()) if len(values) else float("nan")
