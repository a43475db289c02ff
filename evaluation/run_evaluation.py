"""Evaluate a run, or a trajectory of any origin, against the truth."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text
from sigmaslam.errors import InputError
from sigmaslam.evaluation.kept_evaluation import keep_evaluation
from sigmaslam.evaluation.metrics.map_consistency import coverage
from sigmaslam.evaluation.metrics.relative_consistency import SpanConsistency, relative_consistency, truth_covariance
from sigmaslam.evaluation.metrics.trajectory_errors import (
    MAX_DIFFERENCE,
    AbsoluteError,
    KittiErrors,
    PoseNees,
    RelativeError,
    absolute_trajectory_error,
    align,
    associate,
    kitti_errors,
    pose_errors,
    pose_nees,
    relative_pose_error,
    synchronise,
)
from sigmaslam.evaluation.relative_summary import draw_relative, format_relative, span_to_dict
from sigmaslam.evaluation.truth_conventions import TruthConvention, find_convention, find_time_unit, scale_times
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import BLUE, VERMILLION, has_matplotlib, style_axes
from sigmaslam.readers.trajectory_files import kitti_times_path, read_covariances, read_trajectory, trajectory_format
from sigmaslam.runs.figures import AXIS_NAMES, plot_trajectory, save_png
from sigmaslam.runs.frame_table import FRAMES_NAME, FrameTable, predicted_poses, read_frames
from sigmaslam.runs.relative_pose_file import RELATIVE_POSES_NAME, read_frame_pairs
from sigmaslam.runs.run_folder import FINAL_COVARIANCE, FINAL_TRAJECTORY, check_has_trajectory

_LOGGER = logging.getLogger(__name__)
# An error is of poses relative to others.
_FEWEST_PAIRS = 2

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True)
class FinalErrors:
    """Errors of the same frames after the fact, of `trajectory_final.tum`; attributes as of `Evaluation`."""

    ate: AbsoluteError
    ate_origin: AbsoluteError
    rpe: RelativeError
    nees: PoseNees | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Everything that was found about one trajectory.

    Attributes:
        estimate_path, truth_path: the files that were compared.
        association: how frames were paired: "time" (with the unit where the truth's times are not in seconds), "index"
            (a file without times, as many poses in both) or "time at 10 Hz" (a KITTI file without times).
        matched: number of estimated poses with a true one.
        frames: number of frames with a truth, with a pose or without (see `evaluate_run`).
        predicted: number of the matched poses that the motion alone predicts, while the camera was lost.
        path_length, estimate_path_length: of the matched poses, metres.
        ate, ate_origin: absolute error after the best rigid alignment, and with only the first poses equal.
        rpe: error of the motion from frame to frame.
        kitti: segment errors.
        nees: of poses relative to the first; None where there is no covariance.
        relative: consistency of poses relative to earlier ones, by span; None where the run does not say.
        figure_path: the plots; None where none were asked for, or matplotlib is not installed.
        final: of the trajectory after the fact; None where there is none.
        truth_hint: the convention in which the truth would fit, in words and as options; None where it fits as it was
            read, or in no way.
    """

    estimate_path: Path
    truth_path: Path
    association: str
    matched: int
    frames: int
    path_length: float
    estimate_path_length: float
    ate: AbsoluteError
    ate_origin: AbsoluteError
    rpe: RelativeError
    kitti: KittiErrors
    nees: PoseNees | None
    relative: tuple[SpanConsistency, ...] | None
    figure_path: Path | None
    final: FinalErrors | None = None
    predicted: int = 0
    truth_hint: str | None = None

    @property
    def coverage(self) -> float:
        """Share of the frames that have a pose and a truth, 0 to 1."""
        return self.matched / self.frames

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, texts and lists for JSON; None stands for what could not be computed."""
        result = {
            "estimate": str(self.estimate_path),
            "truth": str(self.truth_path),
            "association": self.association,
            "truth_hint": self.truth_hint,
            "matched": self.matched,
            "frames": self.frames,
            "coverage": self.coverage,
            "predicted": self.predicted,
            "path_length": self.path_length,
            "estimate_path_length": self.estimate_path_length,
            **_errors_to_dict(self),
            "kitti": asdict(self.kitti),
            "relative": None if self.relative is None else [span_to_dict(span) for span in self.relative],
            "figure": str(self.figure_path) if self.figure_path else None,
            "final": None if self.final is None else _errors_to_dict(self.final),
        }
        return {key: _plain(value) for key, value in result.items()}


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
) -> Evaluation:
    """Compare a run folder or a trajectory file with the truth.

    Frames are paired by time. Where either file is KITTI without times.txt and both have as many poses, or a run has as
    many frames, they are paired by index; else the 10 Hz of KITTI are assumed and every time must then agree.
    Of a run with `--track-object` the truth is T_camera_object of any frame that is fixed to the body.
    The frames of a run are those of its `frames.csv` that have a truth; for a file alone they are as many as fit into
    the time of the truth at the estimate's rate, and never more than there are true poses. Where the truth would fit in
    another convention the evaluation says so, and is not changed.

    Args:
        run_or_trajectory: a folder with `trajectory.tum` (and `covariance.npy`, (N, 6, 6) in the body frame;
            `trajectory_final.tum` and its covariance are evaluated beside them), or a TUM or KITTI file. Poses
            relative to earlier ones are judged where it holds `relative_poses.npz`.
        truth: TUM, KITTI, or EuRoC ground truth.
        lengths, step: segments of the KITTI errors (see `kitti_errors`).
        plot: write `evaluation.png` into the run folder or beside the trajectory, where matplotlib is installed; of a
            run also `evaluation.json` and `evaluation.npz`, with which its report is written anew.
        truth_sigma_position, truth_sigma_rotation: standard deviations of each true pose, of each coordinate (metres)
            and about each axis (degrees), for the poses relative to earlier ones; where one alone is given the other is
            zero.
        truth_convention: how the truth is to be read; None: as T_world_camera in metres, x before w.
    Raises:
        InputError: a file is missing or wrong, no frame has a pose, or the timestamps do not meet.
    """
    run_or_trajectory, truth = Path(run_or_trajectory), Path(truth)
    is_run = run_or_trajectory.is_dir()
    estimate_path = run_or_trajectory / "trajectory.tum" if is_run else run_or_trajectory
    frames = None
    if is_run:
        check_has_trajectory(run_or_trajectory)
        if (run_or_trajectory / FRAMES_NAME).is_file():
            frames = read_frames(run_or_trajectory / FRAMES_NAME)
    estimate, true, association = _same_clock(estimate_path, truth, frames)
    paired, _ = associate(estimate, true, 1e-3 if association == "time at 10 Hz" else MAX_DIFFERENCE)
    if len(paired) < _FEWEST_PAIRS:
        raise InputError(
            f"{truth}: one of its {len(true)} poses alone is of the time of a pose of {estimate_path}; two are needed. "
            "Is it the truth of this run, and are both in the same clock?"
        )
    if association == "time at 10 Hz" and len(paired) < len(estimate):
        raise InputError(
            f"{truth}: a KITTI file without times.txt beside it is taken as 10 Hz, but only "
            f"{len(paired)} of the {len(estimate)} poses of {estimate_path} have such times: put the "
            "times.txt of the images beside the pose file"
        )
    follows_object = is_run and _follows_object(run_or_trajectory)
    convention, has_quaternions = truth_convention or TruthConvention(), trajectory_format(truth) == "tum"
    if convention.quaternion != "xyzw" and not has_quaternions:
        raise InputError(f"{truth}: the order of quaternions can be chosen for TUM files alone, and this is none")
    other = None if follows_object else find_convention(estimate, true, convention, has_quaternions)
    true = convention.apply(true)
    sigmas = truth_sigma_position, truth_sigma_rotation
    relative = _judge_relative_poses(run_or_trajectory, estimate, true, sigmas, follows_object) if is_run else None
    if follows_object:
        true = _of_followed_frame(estimate, true)
    covariance = _read_covariance(run_or_trajectory / "covariance.npy", len(estimate)) if is_run else None
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
        nees=pose_nees(estimate, true, covariance) if covariance is not None else None,
        relative=relative,
        figure_path=estimate_path.parent / "evaluation.png" if plot and has_matplotlib() else None,
        final=_evaluate_final(run_or_trajectory, estimate, true) if is_run else None,
        predicted=int(predicted[associate(estimate, true)[0]].sum()),
        truth_hint=None if other is None else other.describe(),
    )
    if plot and is_run:
        keep_evaluation(run_or_trajectory, evaluation.to_dict(), estimate, true, evaluation.nees)
    if evaluation.figure_path:
        figure = draw_evaluation(evaluation, estimate, true, covariance, predicted)
        try:
            save_png(figure, evaluation.figure_path)
        except (OSError, InputError) as error:
            _LOGGER.warning("evaluation.png is not written: %s", getattr(error, "strerror", None) or error)
            return replace(evaluation, figure_path=None)
    return evaluation


def format_evaluation(evaluation: Evaluation) -> str:
    """The evaluation as a text table."""
    e = evaluation
    lines = [
        f"estimate  {e.estimate_path}",
        f"truth     {e.truth_path} (paired by {e.association})",
        f"frames    {e.matched} of the {e.frames} with a truth have an estimate ({100 * e.coverage:.1f} %)"
        + (f", {e.predicted} of them while lost, from the motion alone" if e.predicted else ""),
        f"path      {e.path_length:.2f} m true, {e.estimate_path_length:.2f} m estimated",
        *([f"The truth looks like {e.truth_hint}"] if e.truth_hint else []),
        "",
        f"{'':<24}{'rmse [m]':>11}{'mean [m]':>11}{'median [m]':>12}{'max [m]':>11}{'rotation [deg]':>16}",
        *_error_rows(e),
        "",
    ]
    if len(e.kitti.lengths):
        lines.append(f"{'KITTI segments':<24}{'count':>11}{'t_rel [%]':>11}{'r_rel [deg/100 m]':>19}")
        k = e.kitti
        columns = (k.lengths, k.counts, k.translation_percent, k.rotation_deg_per_100m)
        for length, count, translation, rotation in zip(*columns, strict=True):
            lines.append(f"{f'  {length:g} m':<24}{count:>11}{translation:>11.3f}{rotation:>19.3f}")
        lines.append(
            f"{'  all':<24}{e.kitti.counts.sum():>11}{e.kitti.mean_translation_percent:>11.3f}"
            f"{e.kitti.mean_rotation_deg_per_100m:>19.3f}"
        )
    else:
        lines.append("KITTI segments: none, the path is shorter than a segment")
    lines += ["", _nees_line(e.nees)]
    if e.final is not None:
        lines += ["", "After the fact, with loops and smoothing (trajectory_final.tum):", *_error_rows(e.final)]
        lines.append(_nees_line(e.final.nees))
    return "\n".join([*lines, "", *format_relative(e.relative)]) + "\n"


def draw_evaluation(
    evaluation: Evaluation,
    estimate: Trajectory,
    truth: Trajectory,
    covariance: np.ndarray | None = None,
    predicted: np.ndarray | None = None,
) -> Figure:
    """View from above, height, errors over time with 3 sigma, and segment errors.

    Args:
        evaluation: of these trajectories.
        estimate, truth: trajectories in one clock.
        covariance: (N, 6, 6) of the estimate, body frame, translation first.
        predicted: (N,) bool, which poses of the estimate no image confirms; None: none of them.
    """
    from matplotlib.figure import Figure

    spans = evaluation.relative or ()
    rows = (1.5, 1, 1, 1) if spans else (1.5, 1, 1)
    figure = Figure(figsize=(11, 2.0 + 2.6 * sum(rows) - 0.1), layout="constrained")
    grid = figure.add_gridspec(len(rows), 2, height_ratios=rows)
    matched_estimate, matched_truth = synchronise(estimate, truth)
    aligned = align(matched_estimate, matched_truth, "se3")
    seconds = matched_estimate.timestamps - matched_estimate.timestamps[0]

    above = figure.add_subplot(grid[0, 0])
    guesses = {} if predicted is None else {"estimate": predicted[associate(estimate, truth)[0]]}
    _, _, height = plot_trajectory(above, {"truth": matched_truth, "estimate": aligned}, predicted=guesses)
    above.set_title(f"From above, best alignment: ATE {evaluation.ate.rmse:.3g} m rmse", fontsize=10)

    side = figure.add_subplot(grid[0, 1])
    side.plot(seconds, matched_truth.positions[:, height], "-", color=BLUE, lw=1.6, label="truth")
    side.plot(seconds, aligned.positions[:, height], "--", color=VERMILLION, lw=1.6, label="estimate")
    side.set(xlabel="time [s]", ylabel=f"{AXIS_NAMES[height]} [m]")
    side.set_title("Third axis, best alignment", fontsize=10)
    side.legend(fontsize=8)

    errors = pose_errors(estimate, truth)
    units = ((slice(0, 3), 1.0, "position error [m]"), (slice(3, 6), 180 / math.pi, "rotation error [deg]"))
    panels = [above, side]
    for column, (part, unit, label) in enumerate(units):
        panel = figure.add_subplot(grid[1, column])
        size = unit * np.linalg.norm(errors.errors[:, part], axis=1)
        panel.plot(seconds, size, color=BLUE, lw=1.3, label="error")
        if covariance is not None:
            variance = np.trace(covariance[errors.index][:, part, part], axis1=1, axis2=2)
            sigma = unit * np.sqrt(np.maximum(variance, 0.0))
            panel.plot(seconds, 3 * sigma, color=VERMILLION, lw=1.3, ls="--", label="3 sigma of the estimate")
        panel.set(xlabel="time [s]", ylabel=label)
        panel.set_ylim(bottom=0)
        panel.set_title("Error, first poses equal", fontsize=10)
        panel.legend(fontsize=8, loc="upper left")
        panels.append(panel)

    kitti = evaluation.kitti
    values = (
        (kitti.translation_percent, kitti.mean_translation_percent, "t_rel [%]"),
        (kitti.rotation_deg_per_100m, kitti.mean_rotation_deg_per_100m, "r_rel [deg/100 m]"),
    )
    for column, (by_length, mean, label) in enumerate(values):
        panel = figure.add_subplot(grid[2, column])
        _draw_segments(panel, kitti.lengths, by_length, mean)
        panel.set(xlabel="segment length [m]", ylabel=label)
        panels.append(panel)
    if spans:
        panels += [figure.add_subplot(grid[3, 0]), figure.add_subplot(grid[3, 1])]
        draw_relative(panels[-2], panels[-1], spans)
    for panel in panels:
        style_axes(panel)
    return figure


def _draw_segments(panel: Axes, lengths: np.ndarray, by_length: np.ndarray, mean: float) -> None:
    panel.set_title("Segment errors", fontsize=10)
    if len(lengths) == 0:
        panel.text(0.5, 0.5, "path shorter than a segment", ha="center", va="center", transform=panel.transAxes)
        panel.set_xticks([])
        panel.set_yticks([])
        return
    panel.plot(lengths, by_length, "o-", color=BLUE, lw=1.3, label="mean of each length")
    panel.axhline(mean, color=VERMILLION, lw=1.3, ls="--", label=f"mean of all segments: {mean:.3g}")
    panel.set_xticks(lengths)
    panel.set_ylim(0, 1.2 * max(float(np.max(by_length)), 1e-9))
    panel.legend(fontsize=8, loc="best")


def _judge_relative_poses(
    run: Path,
    estimate: Trajectory,
    truth: Trajectory,
    sigmas: tuple[float | None, float | None],
    follows_object: bool,
) -> tuple[SpanConsistency, ...] | None:
    """Consistency of the camera's poses relative to earlier ones; of a followed body's run in the body's frame."""
    path = run / RELATIVE_POSES_NAME
    if not path.is_file():
        return None
    pairs = read_frame_pairs(path, len(estimate))
    covariances = None
    if any(sigma is not None for sigma in sigmas):
        covariances = np.tile(truth_covariance(sigmas[0] or 0.0, sigmas[1] or 0.0), (len(truth), 1, 1))
    if follows_object:
        covariances = covariances if covariances is None else turn_covariance(truth.poses, covariances)
        truth = Trajectory(truth.timestamps, se3_inverse(truth.poses))
    return relative_consistency(pairs, estimate, truth, covariances)


def _error_rows(errors: Evaluation | FinalErrors) -> list[str]:
    """ATE and RPE, a line each."""
    # On a straight path the best alignment may turn about the path, by much more than the rotations are wrong.
    rotation_error = errors.ate_origin.rotation_rmse_deg
    straight = errors.ate.turn_deg > rotation_error and errors.ate.rotation_rmse_deg > 2 * rotation_error
    turn = "not determined" if straight else f"{errors.ate.rotation_rmse_deg:.4f}"
    rows = [
        f"{name:<24}{ate.rmse:>11.4f}{ate.mean:>11.4f}{ate.median:>12.4f}{ate.maximum:>11.4f}{rotation:>16}"
        for name, ate, rotation in (
            ("ATE, best alignment", errors.ate, turn),
            ("ATE, first pose", errors.ate_origin, f"{errors.ate_origin.rotation_rmse_deg:.4f}"),
        )
    ]
    rpe = errors.rpe
    name = f"RPE, {rpe.delta} frame" + ("s" if rpe.delta > 1 else "")
    return [
        *rows,
        f"{name:<24}{rpe.translation_rmse:>11.4f}{rpe.translations.mean():>11.4f}"
        f"{rpe.translation_median:>12.4f}{rpe.translations.max():>11.4f}{rpe.rotation_rmse_deg:>16.4f}",
    ]


def _nees_line(nees: PoseNees | None) -> str:
    if nees is None:
        return "NEES: no covariance"
    if len(nees.per_frame) == 0:
        return "NEES: no frame has a regular covariance"
    return (
        f"NEES per degree of freedom (1 is right, more is overconfident): {nees.mean:.2f}; translation "
        f"{nees.mean_translation:.2f}, rotation {nees.mean_rotation:.2f}, median {nees.median:.2f}; "
        f"inside 95 %: {100 * coverage(nees.per_frame, 6):.0f} %"
    )


def _errors_to_dict(errors: Evaluation | FinalErrors) -> dict[str, Any]:
    """ATE, RPE without its steps, and NEES with the number of its frames in their place."""
    rpe, nees = asdict(errors.rpe), asdict(errors.nees) if errors.nees else None
    del rpe["translations"], rpe["rotations_deg"]
    if nees:
        per_frame = nees.pop("per_frame")
        nees |= {"count": len(per_frame), "inside": coverage(per_frame, 6)}
        del nees["timestamps"]
    return {"ate": asdict(errors.ate), "ate_origin": asdict(errors.ate_origin), "rpe": rpe, "nees": nees}


def _evaluate_final(run: Path, estimate: Trajectory, truth: Trajectory) -> FinalErrors | None:
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
    covariance = _read_covariance(run / FINAL_COVARIANCE, len(final))
    return FinalErrors(
        absolute_trajectory_error(final, truth, "se3"),
        absolute_trajectory_error(final, truth, "origin"),
        relative_pose_error(final, truth),
        None if covariance is None else pose_nees(final, truth, covariance),
    )


def _same_clock(estimate_path: Path, truth_path: Path, frames: FrameTable | None) -> tuple[Trajectory, Trajectory, str]:
    """Both trajectories, in one clock, and how that was reached; with all frames of a run, with a pose or without."""
    estimate, truth = read_trajectory(estimate_path), read_trajectory(truth_path)
    untimed = any(
        trajectory_format(path) == "kitti" and kitti_times_path(path) is None for path in (estimate_path, truth_path)
    )
    if not untimed:
        unit = find_time_unit(estimate, truth)
        if unit is None:
            return estimate, truth, "time"
        return estimate, scale_times(truth, unit), f"time, that of the truth in {unit}"
    if len(estimate) == len(truth):
        return estimate, Trajectory(estimate.timestamps, truth.poses), "index"
    if frames is not None and len(frames) == len(truth):
        return estimate, Trajectory(frames.columns["timestamp"], truth.poses), "index"
    return estimate, truth, "time at 10 Hz"


def _follows_object(run: Path) -> bool:
    """Whether a run's poses are those of a body before a camera at rest."""
    try:
        return "object" in json.loads(read_text(run / "run.json", TABLE_BYTES, "the run"))
    except (InputError, ValueError, RecursionError, TypeError):
        return False


def _of_followed_frame(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The truth of the frame on the body that the run follows; the truth may be of another frame on the body.

    The two frames are taken as the first pair of poses has them to each other. The fixed frame is the camera's in both.
    """
    estimate_index, truth_index = associate(estimate, truth)
    first = se3_inverse(truth.poses[truth_index[0]]) @ estimate.poses[estimate_index[0]]
    return Trajectory(truth.timestamps, truth.poses @ first)


def _read_covariance(path: Path, count: int) -> np.ndarray | None:
    if not path.is_file():
        return None
    return read_covariances(path, count)


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


def _plain(value: Any) -> Any:
    """Arrays as lists, and None for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
