"""The figure of an evaluation."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import BLUE, SERIES, VERMILLION, style_axes
from sigmaslam_evaluation.evaluation_result import Evaluation
from sigmaslam_evaluation.metrics.trajectory_errors import align, associate, pose_errors, synchronise
from sigmaslam_evaluation.relative_summary import draw_relative

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AXIS_NAMES = ("x", "y", "z")


def draw_evaluation(
    evaluation: Evaluation,
    estimate: Trajectory,
    truth: Trajectory,
    covariance: np.ndarray | None = None,
    predicted: np.ndarray | None = None,
) -> "Figure":
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

    kitti = evaluation.kitti
    values = (
        (kitti.translation_percent, kitti.mean_translation_percent, "t_rel [%]"),
        (kitti.rotation_deg_per_100m, kitti.mean_rotation_deg_per_100m, "r_rel [deg/100 m]"),
    )
    for column, (by_length, mean, label) in enumerate(values):
        panel = figure.add_subplot(grid[2, column])
        _draw_segments(panel, kitti.lengths, by_length, mean)
        panel.set(xlabel="segment length [m]", ylabel=label)
    if spans:
        draw_relative(figure.add_subplot(grid[3, 0]), figure.add_subplot(grid[3, 1]), spans)
    for panel in figure.axes:
        style_axes(panel)
    return figure


def _draw_segments(panel: "Axes", lengths: np.ndarray, by_length: np.ndarray, mean: float) -> None:
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


def plot_trajectory(
    axes: "Axes", trajectories: Mapping[str, Trajectory], predicted: Mapping[str, np.ndarray] | None = None
) -> tuple[int, int, int]:
    """Draw trajectories from above, with equal scales and a mark where each begins; dashed where they are guesses.

    Args:
        axes: where to draw.
        trajectories: by label; the first determines the plane of the view.
        predicted: by label, (N,) bool, which poses no image confirms; a trajectory that is not named has none.
    Returns:
        The axes of the view: the two along which the first trajectory extends most, then the third. For a camera that
        drives with z forward and y down these are x, z and y.
    """
    positions = next(iter(trajectories.values())).positions
    extent = np.ptp(positions, axis=0) if len(positions) else np.zeros(3)
    # For equal extents the height is y, the axis that points down in a level camera.
    height = min((1, 2, 0), key=lambda axis: float(extent[axis]))
    horizontal, vertical = (axis for axis in range(3) if axis != height)
    plane = [horizontal, vertical]
    for number, (label, trajectory) in enumerate(trajectories.items()):
        colour = SERIES[number % len(SERIES)]
        path = trajectory.positions[:, plane]
        style: dict[str, Any] = {"color": colour, "zorder": 3 + number}
        width = 2.6 if number == 0 and len(trajectories) > 1 else 1.4
        guess = (predicted or {}).get(label, np.zeros(len(path), bool))
        axes.plot(*np.where(guess[:, None], np.nan, path).T, "-", lw=width, label=label, **style)
        if guess.any():
            # The ways into a guess and out of it are guesses, too.
            beside = guess | np.append(guess[1:], False) | np.append(False, guess[:-1])
            axes.plot(
                *np.where(beside[:, None], path, np.nan).T, "--", lw=0.6 * width, label=f"{label} while lost", **style
            )
        axes.plot(path[:1, 0], path[:1, 1], "o", ms=5, **style)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(f"{AXIS_NAMES[horizontal]} [m]")
    axes.set_ylabel(f"{AXIS_NAMES[vertical]} [m]")
    axes.legend(loc="best", fontsize=8, framealpha=0.85)
    style_axes(axes)
    return horizontal, vertical, height
