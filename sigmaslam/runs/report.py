"""The report of a run: one HTML file without links to anything outside it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from markupsafe import Markup

from sigmaslam.bounded_files import TABLE_BYTES, check_columns, load_arrays, read_text, shorten
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text, printable
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import (
    BLUE,
    GREEN,
    GREY,
    NO_MATPLOTLIB,
    PURPLE,
    SERIES,
    VERMILLION,
    has_matplotlib,
    style_axes,
)
from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.runs.figures import plot_trajectory, to_svg
from sigmaslam.runs.frame_table import FRAMES_NAME, STATUSES, FrameTable, predicted_poses, read_frames
from sigmaslam.runs.real_time import format_latency
from sigmaslam.runs.run_folder import FINAL_TRAJECTORY

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STATUS_COLOURS = {"lost": VERMILLION, "relocalised": PURPLE, "skipped": GREY}

MAX_VERTICES = 1000
"""With more frames, lines become pictures inside the SVG, which keeps the report small."""
MAX_COLUMNS = 250
"""Filled areas have at most so many steps; with more frames they show means, or a subset."""
MAX_CONFIGURATION = 20_000
"""The report shows at most so many characters of run.json."""


def write_report(run_dir: str | Path) -> Path:
    """Write `report.html` from the files of a run folder.

    Reads frames.csv, and trajectory.tum, trajectory_final.tum, map.npz and run.json if they exist. Without
    matplotlib the report says how to install it in place of the figures.

    Returns:
        The path of the report.
    Raises:
        InputError: frames.csv is missing, or a file is wrong.
    """
    run_dir = Path(run_dir)
    frames = read_frames(run_dir / FRAMES_NAME)
    trajectory = _read_trajectory(run_dir / "trajectory.tum")
    points = _read_points(run_dir / "map.npz")
    run = _read_run(run_dir / "run.json")
    configuration = json.dumps(run, indent=2, ensure_ascii=False)
    if len(configuration) > MAX_CONFIGURATION:
        configuration = configuration[:MAX_CONFIGURATION] + "\n… (run.json has more)"
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("sigmaslam.runs", "templates"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    summary = run.get("summary")
    summary = summary if isinstance(summary, dict) else {}
    draws = has_matplotlib()
    text = environment.get_template("report.html").render(
        name=printable(run_dir.resolve().name),
        facts=[*_facts(trajectory, frames, points), *_real_time_facts(run)],
        statuses=[(status, frames.status.count(status)) for status in STATUSES],
        failure=summary.get("failure"),
        verdict=summary.get("calibration_verdict"),
        figures=_figures(trajectory, _read_final(run_dir / FINAL_TRAJECTORY), frames, points) if draws else [],
        no_figures=None if draws else NO_MATPLOTLIB,
        configuration=configuration if run else None,
    )
    path = run_dir / "report.html"
    atomic_write_text(path, text)
    return path


def _read_trajectory(path: Path) -> Trajectory:
    """What was said live; empty where no frame has a pose."""
    return read_tum(path) if path.is_file() else Trajectory(np.zeros(0), np.zeros((0, 4, 4)))


def _read_final(path: Path) -> dict[str, Trajectory]:
    """The trajectory after the fact by its label, if the run has one."""
    return {"after the fact": read_tum(path)} if path.is_file() else {}


def _read_points(path: Path) -> np.ndarray | None:
    """Map points (M, 3), or None if the run has no map."""
    if not path.is_file():
        return None
    mend = "run `sigmaslam track` again"
    arrays = load_arrays(path, mend, ("points",))
    check_columns(path, arrays, {"points": ("M", 3)}, {}, mend)
    return arrays["points"].astype(np.float64)


def _read_run(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        run = json.loads(read_text(path, TABLE_BYTES, "the run"))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no JSON ({shorten(str(error))}); run `sigmaslam track` again") from error
    return run if isinstance(run, dict) else {}


def _facts(trajectory: Trajectory, frames: FrameTable, points: np.ndarray | None) -> list[tuple[str, str]]:
    """Label and value of the summary."""
    total = frames.total_milliseconds
    # The median is robust against the first frame, which includes the time of loading.
    speed = _median(total)
    ratio = _median(_nis_per_dof(frames))
    facts = [
        ("frames", f"{len(frames)}"),
        ("poses", f"{len(trajectory)}"),
        ("duration", f"{frames.seconds[-1]:.1f} s"),
        ("path length", f"{trajectory.path_length:.2f} m"),
        ("speed", f"{1000 / speed:.1f} frames/s" if speed else "–"),
        ("median inliers", _number(_median(frames.columns["inliers"]), ".0f")),
        ("median NIS per dof", _number(ratio, ".2f")),
    ]
    if points is not None:
        facts.append(("map points", f"{len(points)}"))
    return facts


def _real_time_facts(run: dict[str, Any]) -> list[tuple[str, str]]:
    """Label and value of what a run in real time adds to the summary."""
    timing = run.get("real_time")
    if not isinstance(timing, dict):
        return []
    return [("dropped", f"{timing['dropped']}"), ("latency", f"{format_latency(timing['latency_ms'])} ms")]


def _median(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else None


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _nis_per_dof(frames: FrameTable) -> np.ndarray:
    nis, dof = frames.columns["nis"], frames.columns["dof"]
    return np.where(dof > 0, nis / np.where(dof > 0, dof, 1.0), np.nan)


def _figures(
    trajectory: Trajectory, final: dict[str, Trajectory], frames: FrameTable, points: np.ndarray | None
) -> list[tuple[str, str, Markup]]:
    """Title, caption and SVG of each figure that has data."""
    from matplotlib.figure import Figure

    figures = []
    if len(trajectory):
        figure = Figure(figsize=(8, 5.5), layout="constrained")
        predicted = predicted_poses(frames, trajectory.timestamps)
        drawn = {"trajectory": trajectory, **final}
        guesses = {label: predicted for label, each in drawn.items() if len(each) == len(predicted)}
        plot_trajectory(figure.add_subplot(), drawn, points, guesses)
        caption = "From above; the dot marks the start."
        if predicted.any():
            caption += " Dashed where the camera was lost, and its way is a guess."
        if points is not None and len(points):
            caption += f" An even selection of the {len(points)} map points; far ones are cut off."
        figures.append(("Trajectory and map", caption, figure))
    series: list[tuple[str, str, Callable[[Axes, FrameTable], bool]]] = [
        ("Matches and inliers", "Inliers are the matches that the filter used.", _draw_inliers),
        (
            "Normalised innovation squared",
            "Per degree of freedom; about 1 where the claimed uncertainty is right, above the band where it is "
            "too small. The band holds 95 % of the frames of a consistent filter.",
            _draw_nis,
        ),
        ("Disparity offset", "Estimated error of the calibration, with its 2-sigma band.", _draw_offset),
        ("Belief", "How far the tracker believes each of its poses, 0 to 1.", _draw_belief),
        ("Time spent", "Milliseconds per stage, stacked.", _draw_milliseconds),
    ]
    for title, caption, draw in series:
        figure = Figure(figsize=(8, 2.6), layout="constrained")
        axes = figure.add_subplot()
        if not draw(axes, frames):
            continue
        _mark_statuses(axes, frames)
        axes.set_xlabel("time [s]")
        axes.margins(x=0.01)
        style_axes(axes)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        figures.append((title, caption, figure))
    return [
        (title, caption, Markup(to_svg(figure, f"figure{number}")))
        for number, (title, caption, figure) in enumerate(figures)
    ]


def _line(axes: Axes, frames: FrameTable, values: np.ndarray, label: str, colour: str, **style: Any) -> None:
    rasterised = len(frames) > MAX_VERTICES
    axes.plot(frames.seconds, values, color=colour, label=label, rasterized=rasterised, **{"lw": 1.2, **style})


def _draw_inliers(axes: Axes, frames: FrameTable) -> bool:
    matches, inliers = frames.columns["matches"], frames.columns["inliers"]
    _line(axes, frames, matches, "matches", BLUE)
    _line(axes, frames, inliers, "inliers", VERMILLION)
    axes.set_ylabel("count")
    axes.set_ylim(bottom=0)
    return bool(np.isfinite(matches).any() or np.isfinite(inliers).any())


def _draw_nis(axes: Axes, frames: FrameTable) -> bool:
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    ratio = _nis_per_dof(frames)
    ratio = np.where(ratio > 0, ratio, np.nan)
    if not np.isfinite(ratio).any():
        return False
    # (chi2 / dof)^(1/3) is nearly normal (Wilson and Hilferty).
    every = -(-len(frames) // MAX_COLUMNS)
    dof = frames.columns["dof"][::every]
    dof = np.where(dof > 0, dof, np.nan)
    spread = np.sqrt(2 / (9 * dof))
    low, high = (np.maximum(1 - 2 / (9 * dof) + sign * 1.96 * spread, 1e-3) ** 3 for sign in (-1, 1))
    axes.fill_between(frames.seconds[::every], low, high, color=GREEN, alpha=0.25, lw=0, label="95 %")
    _line(axes, frames, ratio, "NIS / dof", BLUE, ls="", marker=".", ms=3)
    axes.axhline(1.0, color=GREEN, lw=1)
    axes.set_yscale("log")
    axes.set_ylim(min(0.5, 0.9 * float(np.nanmin(ratio))), max(2.0, 1.1 * float(np.nanmax(ratio))))
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylabel("NIS / dof")
    return True


def _draw_offset(axes: Axes, frames: FrameTable) -> bool:
    offset, sigma = frames.columns["disparity_offset"], frames.columns["disparity_offset_sigma"]
    axes.fill_between(
        frames.seconds,
        offset - 2 * sigma,
        offset + 2 * sigma,
        color=BLUE,
        alpha=0.25,
        lw=0,
        label="2 sigma",
        rasterized=len(frames) > MAX_VERTICES,
    )
    _line(axes, frames, offset, "offset", BLUE)
    axes.axhline(0.0, color=GREY, lw=1)
    axes.set_ylabel("disparity offset [px]")
    return bool(np.isfinite(offset).any())


def _draw_belief(axes: Axes, frames: FrameTable) -> bool:
    belief = frames.columns["belief"]
    _line(axes, frames, belief, "belief", BLUE)
    axes.set_ylabel("belief")
    axes.set_ylim(-0.03, 1.03)
    return bool(np.isfinite(belief).any())


def _draw_milliseconds(axes: Axes, frames: FrameTable) -> bool:
    measured = np.isfinite(frames.total_milliseconds)
    if not measured.any():
        return False
    seconds = frames.seconds[measured]
    stages = np.nan_to_num(np.array([values[measured] for values in frames.milliseconds.values()]))
    every = -(-len(seconds) // MAX_COLUMNS)
    starts = np.arange(0, len(seconds), every)
    means = np.add.reduceat(stages, starts, axis=1) / np.diff(np.append(starts, len(seconds)))
    colours = [SERIES[number % len(SERIES)] for number in range(len(means))]
    names = [name.replace("_", " ") for name in frames.milliseconds]
    axes.stackplot(seconds[starts], means, labels=names, colors=colours, lw=0)
    axes.set_ylabel("ms per frame" if every == 1 else f"ms per frame,\nmeans of {every}")
    axes.set_ylim(bottom=0)
    return True


def _mark_statuses(axes: Axes, frames: FrameTable) -> None:
    """Shades the frames that were not tracked."""
    seconds = frames.seconds
    half = 0.5 * float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.5
    first = 0
    for index in range(1, len(frames) + 1):
        status = frames.status[first]
        if index < len(frames) and frames.status[index] == status:
            continue
        if status in STATUS_COLOURS:
            shown = axes.get_legend_handles_labels()[1]
            axes.axvspan(
                seconds[first] - half,
                seconds[index - 1] + half,
                color=STATUS_COLOURS[status],
                alpha=0.3,
                lw=0,
                label=status if status not in shown else None,
                zorder=0,
            )
        first = index
