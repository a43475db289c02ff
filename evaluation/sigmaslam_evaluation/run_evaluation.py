"""Evaluate a run, or a trajectory of any origin, against the truth."""

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text
from sigmaslam.errors import InputError
from sigmaslam.files import save_png
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import has_matplotlib
from sigmaslam.readers.trajectory_files import kitti_times_path, read_covariances, read_trajectory, trajectory_format
from sigmaslam.run_record.frame_table import FRAMES_NAME, FrameTable, predicted_poses, read_frames
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME, read_frame_pairs
from sigmaslam.run_record.run_folder import FINAL_COVARIANCE, FINAL_TRAJECTORY, check_has_trajectory
from sigmaslam_evaluation.evaluation_figure import draw_evaluation
from sigmaslam_evaluation.evaluation_result import Evaluation, FinalErrors
from sigmaslam_evaluation.kept_evaluation import keep_evaluation
from sigmaslam_evaluation.metrics.relative_consistency import SpanConsistency, relative_consistency
from sigmaslam_evaluation.metrics.trajectory_errors import (
    MAX_DIFFERENCE,
    absolute_trajectory_error,
    associate,
    kitti_errors,
    pose_nees,
    relative_pose_error,
    synchronise,
)
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors
from sigmaslam_evaluation.nees_verdict import judge_nees
from sigmaslam_evaluation.truth_conventions import (
    TruthConvention,
    describe_clock_offset,
    describe_lack_of_rotation,
    describe_mirror,
    find_convention,
    find_truth,
    interpolate_truth,
    times_in_seconds,
)
from sigmaslam_evaluation.truth_errors import TruthKind, leave_out_interpolated, truth_errors

_LOGGER = logging.getLogger(__name__)
# An error is of poses relative to others.
_FEWEST_PAIRS = 2
# Fewer pairs than this share of what is possible are more than some missing poses.
_USUAL_PAIRS = 0.9


def evaluate_run(
    run_or_trajectory: Path,
    truth: Path,
    *,
    lengths: Sequence[float] | None = None,
    step: int | None = None,
    plot: bool = True,
    truth_sigma_position: float | None = None,
    truth_sigma_rotation: float | None = None,
    truth_convention: TruthConvention | None = None,
    truth_kind: TruthKind | None = "exact",
) -> Evaluation:
    """Compare a run folder or a trajectory file with the truth.

    Frames are paired by time (see `interpolate_truth`). Where either file is KITTI without times.txt and both have as
    many poses, or a run as many frames, they are paired by index; else 10 Hz are assumed and every time must agree.
    Of a run with `--track-object` the truth is T_camera_object of any frame that is fixed to the body.
    The frames of a run are those of its `frames.csv` that have a truth; for a file alone they are as many as fit into
    the time of the truth at the estimate's rate, and never more than there are true poses. Where the truth would fit in
    another convention the evaluation says so, and is not changed.

    Args:
        run_or_trajectory: a folder with `trajectory.tum` (and `covariance.npy`, (N, 6, 6) in the body frame;
            `trajectory_final.tum` and its covariance are evaluated beside them), or a TUM or KITTI file. Poses
            relative to earlier ones are judged where it holds `relative_poses.npz`.
        truth: TUM, KITTI, or EuRoC ground truth, or a folder with one of a usual name.
        lengths, step: segments of the KITTI errors (see `kitti_errors`).
        plot: write `evaluation.png` into the run folder or beside the trajectory, where matplotlib is installed; of a
            run also `evaluation.json` and `evaluation.npz`, with which its report is written anew.
        truth_sigma_position, truth_sigma_rotation: standard deviations of each true pose, of each coordinate (metres)
            and about each axis (degrees): part of every NEES; None: that of the kind.
        truth_convention: how the truth is to be read; None: as T_world_camera in metres, x before w.
        truth_kind: what measured it, which says how good it is (see `TRUTH_SIGMAS`); None: as it is guessed, and said.
            Poses of a truth with errors that are interpolated are left out.
    Raises:
        InputError: a file is missing or wrong, no frame has a pose, or the timestamps do not meet.
    """
    run_or_trajectory, truth = Path(run_or_trajectory), find_truth(Path(truth))
    is_run = run_or_trajectory.is_dir()
    estimate_path = run_or_trajectory / "trajectory.tum" if is_run else run_or_trajectory
    if is_run:
        check_has_trajectory(run_or_trajectory)
    frames = read_frames(run_or_trajectory / FRAMES_NAME) if (run_or_trajectory / FRAMES_NAME).is_file() else None
    estimate, true, association = _same_clock(estimate_path, truth, frames)
    unpaired = _describe_unpaired(estimate, true, _count_pairs(estimate_path, truth, estimate, true, association))
    follows_object = is_run and _follows_object(run_or_trajectory)
    convention, has_quaternions = truth_convention or TruthConvention(), trajectory_format(truth) == "tum"
    if convention.quaternion != "xyzw" and not has_quaternions:
        raise InputError(f"{truth}: the order of quaternions can be chosen for TUM files alone, and this is none")
    other = None if follows_object else find_convention(estimate, true, convention, has_quaternions)
    true = convention.apply(true)
    hint = other.describe() if other else None if follows_object else describe_mirror(estimate, true)
    doubts = [describe_lack_of_rotation(estimate, true), describe_clock_offset(estimate, true)]
    if truth.name.startswith("trajectory") and (truth.parent / "run.json").is_file():
        doubts.append("is another run: of the same images both share errors, and NEES is too small")
    true, interpolated = interpolate_truth(estimate, true)
    kept, left_out = leave_out_interpolated(estimate, true)
    of_truth, guess = truth_errors(truth, kept, truth_kind, (truth_sigma_position, truth_sigma_rotation))
    true, left_out = (true, None) if of_truth is None else (kept, left_out)
    relative = _judge_relative_poses(run_or_trajectory, estimate, true, of_truth, follows_object) if is_run else None
    if follows_object:
        # What the run follows lies to the body of the truth as the first pair of poses has them, both in the camera.
        followed, body = (each.poses[0] for each in synchronise(estimate, true))
        T_body_followed = se3_inverse(body) @ followed
        true = Trajectory(true.timestamps, true.poses @ T_body_followed)
        of_truth = None if of_truth is None else of_truth.turned(se3_inverse(T_body_followed))
    path = run_or_trajectory / "covariance.npy"  # of a run alone
    covariance = read_covariances(path, len(estimate)) if path.is_file() else None
    nees = pose_nees(estimate, true, covariance, of_truth) if covariance is not None else None
    matched_estimate, matched_truth = synchronise(estimate, true)
    predicted = np.zeros(len(estimate), bool) if frames is None else predicted_poses(frames, estimate.timestamps)
    evaluation = Evaluation(
        estimate_path=estimate_path,
        truth_path=truth,
        association=association,
        matched=len(matched_estimate),
        frames=_frame_count(frames, estimate, true, len(matched_estimate)),
        path_length=matched_truth.path_length,
        estimate_path_length=matched_estimate.path_length,
        ate=absolute_trajectory_error(estimate, true, "se3"),
        ate_origin=absolute_trajectory_error(estimate, true, "origin"),
        rpe=relative_pose_error(estimate, true),
        kitti=kitti_errors(estimate, true, lengths, step),
        nees=nees,
        relative=relative,
        figure_path=estimate_path.parent / "evaluation.png" if plot and has_matplotlib() else None,
        final=_evaluate_final(run_or_trajectory, estimate, true, of_truth) if is_run else None,
        predicted=int(predicted[associate(estimate, true)[0]].sum()),
        truth_hint=hint,
        truth_notes=tuple(note for note in (guess, left_out, unpaired, interpolated, *doubts) if note),
        nees_verdict=None if hint or any(doubts) else judge_nees(nees, relative),
    )
    if plot and is_run:
        keep_evaluation(run_or_trajectory, evaluation.to_dict(), estimate, true, nees)
    if evaluation.figure_path:
        figure = draw_evaluation(evaluation, estimate, true, covariance, predicted)
        try:
            save_png(figure, evaluation.figure_path)
        except (OSError, InputError) as error:
            _LOGGER.warning("evaluation.png is not written: %s", getattr(error, "strerror", None) or error)
            return replace(evaluation, figure_path=None)
    return evaluation


def _judge_relative_poses(
    run: Path, estimate: Trajectory, truth: Trajectory, of_truth: TruthErrors | None, follows_object: bool
) -> tuple[SpanConsistency, ...] | None:
    """Consistency of the camera's poses relative to earlier ones; of a followed body's run in the body's frame."""
    path = run / RELATIVE_POSES_NAME
    if not path.is_file():
        return None
    pairs = read_frame_pairs(path, len(estimate))
    if follows_object:
        of_truth = None if of_truth is None else of_truth.turned(truth.poses)
        truth = Trajectory(truth.timestamps, se3_inverse(truth.poses))
    return relative_consistency(pairs, estimate, truth, of_truth)


def _evaluate_final(
    run: Path, estimate: Trajectory, truth: Trajectory, of_truth: TruthErrors | None
) -> FinalErrors | None:
    """The errors after the fact, of a run that has them; the trajectories are in the clock of the truth."""
    path = run / FINAL_TRAJECTORY
    if not path.is_file():
        return None
    final = read_trajectory(path)
    if len(final) != len(estimate):
        raise InputError(
            f"{path}: has {len(final)} poses, but trajectory.tum beside it {len(estimate)}: both must come from the "
            "same run"
        )
    final = Trajectory(estimate.timestamps, final.poses)
    path = run / FINAL_COVARIANCE
    covariance = read_covariances(path, len(final)) if path.is_file() else None
    return FinalErrors(
        absolute_trajectory_error(final, truth, "se3"),
        absolute_trajectory_error(final, truth, "origin"),
        relative_pose_error(final, truth),
        None if covariance is None else pose_nees(final, truth, covariance, of_truth),
    )


def _same_clock(estimate_path: Path, truth_path: Path, frames: FrameTable | None) -> tuple[Trajectory, Trajectory, str]:
    """Both trajectories, in one clock, and how that was reached; with all frames of a run, with a pose or without."""
    estimate, truth = read_trajectory(estimate_path), read_trajectory(truth_path)
    untimed = any(
        trajectory_format(path) == "kitti" and kitti_times_path(path) is None for path in (estimate_path, truth_path)
    )
    if not untimed:
        return estimate, *times_in_seconds(estimate, truth)
    if len(estimate) == len(truth):
        return estimate, Trajectory(estimate.timestamps, truth.poses), "index"
    if frames is not None and len(frames) == len(truth):
        return estimate, Trajectory(frames.columns["timestamp"], truth.poses), "index"
    return estimate, truth, "time at 10 Hz"


def _count_pairs(estimate_path: Path, source: Path, estimate: Trajectory, truth: Trajectory, association: str) -> int:
    """Poses of one time in both; InputError where they are too few."""
    paired, _ = associate(estimate, truth, 1e-3 if association == "time at 10 Hz" else MAX_DIFFERENCE)
    if len(paired) < _FEWEST_PAIRS:
        raise InputError(
            f"{source}: one of its {len(truth)} poses alone is of the time of a pose of {estimate_path}; two are "
            "needed. Is it the truth of this run, and are both in the same clock?"
        )
    if association == "time at 10 Hz" and len(paired) < len(estimate):
        raise InputError(
            f"{source}: a KITTI file without times.txt beside it is taken as 10 Hz, but only "
            f"{len(paired)} of the {len(estimate)} poses of {estimate_path} have such times: put the "
            "times.txt of the images beside the pose file"
        )
    return len(paired)


def _describe_unpaired(estimate: Trajectory, truth: Trajectory, pairs: int) -> str | None:
    """A word where fewer poses meet than one of the two has in the time of both, as of two clocks."""
    begin, end = (f(estimate.timestamps[k], truth.timestamps[k]) for f, k in ((max, 0), (min, -1)))
    possible = min(np.sum((begin <= each.timestamps) & (each.timestamps <= end)) for each in (estimate, truth))
    if pairs >= _USUAL_PAIRS * possible:
        return None
    return f"meets {pairs} of {possible} poses within {MAX_DIFFERENCE:g} s: are both in the clock of the images?"


def _follows_object(run: Path) -> bool:
    """Whether a run's poses are those of a body before a camera at rest."""
    try:
        return "object" in json.loads(read_text(run / "run.json", TABLE_BYTES, "the run"))
    except (InputError, ValueError, RecursionError, TypeError):
        return False


def _frame_count(frames: FrameTable | None, estimate: Trajectory, truth: Trajectory, matched: int) -> int:
    if frames is not None:
        times = frames.columns["timestamp"]
        everywhere = Trajectory(times, np.tile(np.eye(4), (len(times), 1, 1)))
        return max(len(associate(everywhere, truth)[0]), matched)
    if len(estimate) < 2:
        return max(len(truth), matched)
    interval = float(np.median(np.diff(estimate.timestamps)))
    fitting = round(float(truth.timestamps[-1] - truth.timestamps[0]) / interval) + 1
    return max(matched, min(len(truth), max(len(estimate), fitting)))
