"""Errors of a trajectory against the truth: ATE, RPE, the KITTI segment errors and the NEES of poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_95
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.se3 import rotation_log, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.table import nearest_rows
from sigmaslam.two_view.absolute_orientation import absolute_orientation
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors

Alignment = Literal["se3", "origin"]
# Seconds that the timestamps of an estimated and a true pose may differ.
MAX_DIFFERENCE = 0.02

KITTI_LENGTHS = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Segment lengths of the KITTI benchmark, metres."""
SHORT_LENGTHS = (10.0, 20.0, 30.0, 40.0, 50.0)
"""Segment lengths for paths too short for the benchmark's, metres."""
KITTI_STEP = 10
"""Frames between the starts of segments in the KITTI benchmark."""
SHORT_PATH = 200.0
"""Below this path length, metres, segments start at every frame."""


@dataclass(frozen=True, slots=True)
class AbsoluteError:
    """Absolute trajectory error after an alignment.

    Attributes:
        rmse, mean, median, maximum: of the distance between positions, metres.
        rotation_rmse_deg: root mean square of the rotation angle between aligned and true poses, degrees.
        count: number of associated poses.
        turn_deg: by how much the alignment may turn about the path and change no position by more than `rmse`: large
            for a straight path, where `rotation_rmse_deg` says little; zero for "origin".
    """

    rmse: float
    mean: float
    median: float
    maximum: float
    rotation_rmse_deg: float
    count: int
    turn_deg: float


@dataclass(frozen=True, slots=True)
class RelativeError:
    """Relative pose error from each associated frame to the next.

    Attributes:
        translation_rmse, translation_median: metres a step.
        rotation_rmse_deg, rotation_median_deg: degrees a step.
        translations: (M,) error of each step, metres.
        rotations_deg: (M,) error of each step, degrees.
        forward: (M,) part of each translation's error along the true step, metres, positive where the estimate goes
            too far; 0 where the true step has no length.
        lengths: (M,) of the true steps, metres.
    """

    translation_rmse: float
    translation_median: float
    rotation_rmse_deg: float
    rotation_median_deg: float
    translations: np.ndarray
    rotations_deg: np.ndarray
    forward: np.ndarray
    lengths: np.ndarray


@dataclass(frozen=True, slots=True)
class KittiErrors:
    """Segment errors as in the KITTI odometry benchmark.

    Attributes:
        lengths: (L,) segment lengths, metres; only those with at least one segment.
        counts: (L,) number of segments of each length.
        translation_percent: (L,) mean translation error of each length, percent of the length.
        rotation_deg_per_100m: (L,) mean rotation error of each length.
        mean_translation_percent: t_rel, mean over all segments; NaN where there are none.
        mean_rotation_deg_per_100m: r_rel, mean over all segments; NaN where there are none.
    """

    lengths: np.ndarray
    counts: np.ndarray
    translation_percent: np.ndarray
    rotation_deg_per_100m: np.ndarray
    mean_translation_percent: float
    mean_rotation_deg_per_100m: float


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """Errors of poses relative to the first associated one, in the body frame.

    Attributes:
        timestamps: (M,) seconds, of the estimate.
        errors: (M, 6) log(T_estimate^-1 T_truth): translation (metres), rotation (radians).
        index: (M,) where in the estimate each comes from.
    """

    timestamps: np.ndarray
    errors: np.ndarray
    index: np.ndarray


@dataclass(frozen=True, slots=True)
class PoseNees:
    """Normalised estimation error squared, per degree of freedom: 1 on average when the covariance is right.

    Attributes:
        mean: over frames and all 6 degrees of freedom; NaN where no frame could be used.
        mean_translation, mean_rotation: the same for the 3 of each alone.
        median: over frames of the 6-dof value (a right covariance gives 0.89).
        timestamps: (M,) seconds of the frames that were used.
        per_frame: (M,) 6-dof value of each.
        with_truth: whether errors of the truth are part of the covariances.
    """

    mean: float
    mean_translation: float
    mean_rotation: float
    median: float
    timestamps: np.ndarray
    per_frame: np.ndarray
    with_truth: bool = False


def associate(
    estimate: Trajectory, truth: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> tuple[np.ndarray, np.ndarray]:
    """Pair each estimated pose with the true pose nearest in time; each pose is used once at most.

    Args:
        estimate: N poses.
        truth: any number of poses, at any rate.
        max_difference: seconds that paired timestamps may differ.
    Returns:
        Indices (M,) into the estimate and (M,) into the truth, both increasing.
    Raises:
        InputError: no timestamps agree (the message gives both ranges).
    """
    if len(estimate) and len(truth):
        nearest = nearest_rows(estimate.timestamps, truth.timestamps)
        difference = np.abs(truth.timestamps[nearest] - estimate.timestamps)
        # Of several estimates that share a true pose, np.unique keeps the first: the nearest in this order.
        candidates = np.flatnonzero(difference <= max_difference)
        candidates = candidates[np.argsort(difference[candidates], kind="stable")]
        truth_index, kept = np.unique(nearest[candidates], return_index=True)
        if len(truth_index):
            return candidates[kept], truth_index
    mend = (
        "they have the same number of poses, so if they are the same frames give both the same timestamps"
        if len(estimate) == len(truth) and len(estimate)
        else "give both in the same clock (for KITTI poses put the times.txt of the images beside them)"
    )
    raise InputError(
        f"no timestamps of estimate and truth agree within {max_difference} s: the estimate has "
        f"{_describe_times(estimate)}, the truth {_describe_times(truth)}; {mend}"
    )


def synchronise(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The associated poses of both, of equal length; see `associate`."""
    estimate_index, truth_index = associate(estimate, truth)
    return estimate.subset(estimate_index), truth.subset(truth_index)


def align(estimate: Trajectory, truth: Trajectory, alignment: Alignment = "se3") -> Trajectory:
    """The estimate moved onto the truth; both must hold the same frames (see `synchronise`).

    Args:
        estimate, truth: N poses each.
        alignment: "se3" the best rigid motion of the positions, "origin" the motion that makes the first poses equal.
    Raises:
        ValueError: the lengths differ.
    """
    if len(estimate) != len(truth):
        raise ValueError(f"{len(estimate)} estimated and {len(truth)} true poses: synchronise them first")
    if alignment == "origin":
        return Trajectory(estimate.timestamps, truth.poses[0] @ se3_inverse(estimate.poses[0]) @ estimate.poses)
    best = absolute_orientation(estimate.positions, truth.positions)
    poses = estimate.poses.copy()
    poses[:, :3, :3] = best.R @ estimate.rotations
    poses[:, :3, 3] = best.apply(estimate.positions)
    return Trajectory(estimate.timestamps, poses)


def absolute_trajectory_error(estimate: Trajectory, truth: Trajectory, alignment: Alignment = "se3") -> AbsoluteError:
    """Absolute trajectory error over the frames that both have.

    On a straight path the rotation about the path, and hence rotation_rmse_deg, is undetermined by "se3".

    Raises:
        InputError: no timestamps agree.
    """
    estimate, truth = synchronise(estimate, truth)
    aligned = align(estimate, truth, alignment)
    distance = np.linalg.norm(aligned.positions - truth.positions, axis=1)
    angle = _angles_deg(np.swapaxes(truth.rotations, 1, 2) @ aligned.rotations)
    rmse = _root_mean_square(distance)
    # The second singular value is the extent of the path across the direction in which it is longest.
    centred = truth.positions - truth.positions.mean(axis=0)
    across = float(np.linalg.svd(centred, compute_uv=False)[1:2].sum()) / math.sqrt(len(distance))
    return AbsoluteError(
        rmse=rmse,
        mean=float(distance.mean()),
        median=float(np.median(distance)),
        maximum=float(distance.max()),
        rotation_rmse_deg=_root_mean_square(angle),
        count=len(distance),
        turn_deg=math.degrees(math.atan2(rmse, across)) if alignment == "se3" else 0.0,
    )


def relative_pose_error(estimate: Trajectory, truth: Trajectory) -> RelativeError:
    """Error of the motion from each associated frame to the next.

    Where the estimate misses frames, the step over the gap is longer.

    Raises:
        InputError: no timestamps agree, or those of one frame alone.
    """
    estimate, truth = synchronise(estimate, truth)
    if len(estimate) < 2:
        raise InputError("one frame of estimate and truth agrees in time, and a step needs two: give more")
    backward = se3_inverse(truth.poses[1:]) @ truth.poses[:-1]
    errors = backward @ se3_inverse(estimate.poses[:-1]) @ estimate.poses[1:]
    translations = np.linalg.norm(errors[:, :3, 3], axis=1)
    rotations = _angles_deg(errors[:, :3, :3])
    lengths = np.linalg.norm(backward[:, :3, 3], axis=1)
    # The errors are in the frame at the step's end, from which its start lies backward.
    forward = -(errors[:, :3, 3] * backward[:, :3, 3]).sum(axis=1) / np.where(lengths > 0.0, lengths, 1.0)
    return RelativeError(
        translation_rmse=_root_mean_square(translations),
        translation_median=float(np.median(translations)),
        rotation_rmse_deg=_root_mean_square(rotations),
        rotation_median_deg=float(np.median(rotations)),
        translations=translations,
        rotations_deg=rotations,
        forward=forward,
        lengths=lengths,
    )


def kitti_errors(
    estimate: Trajectory, truth: Trajectory, lengths: Sequence[float] | None = None, step: int | None = None
) -> KittiErrors:
    """Segment errors of the KITTI odometry development kit (evaluate_odometry.cpp).

    A segment ends at the first frame whose distance along the true path is greater than the length; the mean
    is over all segments of all lengths.

    Args:
        estimate, truth: trajectories; frames that only one has are left out.
        lengths: metres; by default those of 100, 200, ... 800 that fit the path, and 10, 20, ... 50 where it
            is shorter than 100 m.
        step: frames between starts of segments; by default 10 as in the benchmark, and 1 where the path is
            shorter than 200 m.
    Raises:
        InputError: no timestamps agree.
    """
    estimate, truth = synchronise(estimate, truth)
    distances = truth.distances
    if lengths is None:
        lengths = SHORT_LENGTHS if distances[-1] < KITTI_LENGTHS[0] else KITTI_LENGTHS
    if step is None:
        step = 1 if distances[-1] < SHORT_PATH else KITTI_STEP
    starts = np.arange(0, len(truth), step)
    used, counts, translations, rotations = [], [], [], []
    for length in lengths:
        ends = np.searchsorted(distances, distances[starts] + length, side="right")
        first, last = starts[ends < len(truth)], ends[ends < len(truth)]
        if len(first) == 0:
            continue
        errors = se3_inverse(_motions(estimate.poses, first, last)) @ _motions(truth.poses, first, last)
        used.append(length)
        counts.append(len(first))
        translations.append(np.linalg.norm(errors[:, :3, 3], axis=1) / length * 100)
        rotations.append(_angles_deg(errors[:, :3, :3]) / length * 100)
    return KittiErrors(
        lengths=np.array(used),
        counts=np.array(counts, dtype=np.int64),
        translation_percent=np.array([values.mean() for values in translations]),
        rotation_deg_per_100m=np.array([values.mean() for values in rotations]),
        mean_translation_percent=float(np.concatenate(translations).mean()) if used else math.nan,
        mean_rotation_deg_per_100m=float(np.concatenate(rotations).mean()) if used else math.nan,
    )


def pose_errors(estimate: Trajectory, truth: Trajectory) -> PoseErrors:
    """Errors log(T_estimate^-1 T_truth), both relative to their first associated pose.

    Raises:
        InputError: no timestamps agree.
    """
    estimate_index, truth_index = associate(estimate, truth)
    estimated, true = estimate.poses[estimate_index], truth.poses[truth_index]
    since_first, true = (se3_inverse(each[:1]) @ each for each in (estimated, true))
    errors = se3_log(se3_inverse(since_first) @ true)
    return PoseErrors(estimate.timestamps[estimate_index], errors, estimate_index)


def pose_nees(
    estimate: Trajectory, truth: Trajectory, covariance: np.ndarray, of_truth: TruthErrors | None = None
) -> PoseNees:
    """NEES of poses relative to the first, per degree of freedom.

    The first associated frame, whose error is zero by construction, and frames with a singular or non-finite
    covariance are left out. The covariance is taken to be relative to the first pose of the estimate.

    Args:
        estimate: N poses; truth: any.
        covariance: (N, 6, 6) of the pose in its body frame, (translation, rotation), metres and radians.
        of_truth: of the true poses; None: they count as exact.
    Raises:
        ValueError: the covariance is not (N, 6, 6).
        InputError: no timestamps agree.
    """
    if covariance.shape != (len(estimate), 6, 6):
        raise ValueError(f"covariance must be ({len(estimate)}, 6, 6), one a pose; got {covariance.shape}")
    result = pose_errors(estimate, truth)
    used = is_regular(covariance[result.index])
    used[0] = False
    errors, P = result.errors[used], covariance[result.index[used]]
    if of_truth is not None:
        later = associate(estimate, truth)[1]
        P = P + of_truth.between(truth, np.full_like(later, later[0])[used], later[used])
    full = squared_mahalanobis(errors, P) / 6
    translation = squared_mahalanobis(errors[:, :3], P[:, :3, :3]) / 3
    rotation = squared_mahalanobis(errors[:, 3:], P[:, 3:, 3:]) / 3
    some = len(full) > 0
    return PoseNees(
        mean=float(full.mean()) if some else math.nan,
        mean_translation=float(translation.mean()) if some else math.nan,
        mean_rotation=float(rotation.mean()) if some else math.nan,
        median=float(np.median(full)) if some else math.nan,
        timestamps=result.timestamps[used],
        per_frame=full,
        with_truth=of_truth is not None,
    )


def coverage(nees: np.ndarray, dof: int) -> float:
    """Share of errors inside the ellipsoid that holds 95 % of a Gaussian's; NaN without errors.

    Args:
        nees: (N,) normalised errors squared, per degree of freedom.
        dof: of each, 1 to 6.
    """
    return float((nees * dof <= CHI_SQUARE_95[dof]).mean()) if len(nees) else float("nan")


def is_regular(covariance: np.ndarray) -> np.ndarray:
    """Which covariances (N, n, n) are finite and positive definite, whatever the units; (N,) bool."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    regular = np.isfinite(covariance).all(axis=(1, 2)) & (np.nan_to_num(variance) > 0).all(axis=1)
    sigma = np.sqrt(np.where(regular[:, None], variance, 1.0))
    correlation = np.where(regular[:, None, None], covariance, 0.0) / (sigma[:, :, None] * sigma[:, None, :])
    return np.asarray(regular & (np.linalg.eigvalsh(correlation)[:, 0] > 1e-12))


def _motions(poses: np.ndarray, first: np.ndarray, last: np.ndarray) -> np.ndarray:
    return np.asarray(se3_inverse(poses[first]) @ poses[last])


def _angles_deg(rotations: np.ndarray) -> np.ndarray:
    return np.asarray(np.degrees(np.linalg.norm(rotation_log(rotations), axis=-1)))


def _root_mean_square(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _describe_times(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return "no poses"
    first, last = trajectory.timestamps[[0, -1]]
    return f"{len(trajectory)} poses from {first:.3f} to {last:.3f} s"
