"""Several runs in one page: paths, errors, sigmas and figures side by side."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import printable
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.plot_style import SERIES
from sigmaslam.report.report import write_page
from sigmaslam.report.report_facts import Facts, judge, list_calibration, list_evaluation, list_facts
from sigmaslam.report.report_plots import build_plots
from sigmaslam.report.report_scene import MAX_POSES, build_scene
from sigmaslam.run_record.recorded_run import RecordedRun, read_run
from sigmaslam.two_view.absolute_orientation import absolute_orientation
from sigmaslam_evaluation.metrics.trajectory_errors import associate

# Poses at common times that an alignment needs.
_MIN_COMMON = 3
# Length of the cameras' axes, which are aligned together with the path, as a share of its size: they settle the
# rotation about a straight path, and little else.
_AXIS = 0.01
_OTHER = 0.1  # and more: distance of two recordings over the extent of one
# Entries of run.json that are no settings.
_RESULTS = ("summary", "checks", "started", "ended", "dropped", "real_time")


@dataclass(frozen=True, slots=True)
class _Placed:
    """A run in the world and clock of the first one, or in its own where the two have no common times.

    Attributes:
        start: time stamp that is 0 s in the page.
        note: how it was aligned, in words.
        distance: (F,) to the first run at the same time, metres; NaN where there is none.
    """

    run: RecordedRun
    start: float
    note: str
    distance: np.ndarray


def write_comparison(folders: Sequence[Path], path: Path) -> Path:
    """Write a page of several runs; those with times of the first run are moved into its world.

    Raises:
        InputError: a folder is given twice or holds no run, there are more than six, or a file is wrong.
    """
    names = [printable(folder.resolve().name) for folder in folders]
    if len(set(names)) < len(names):
        names = [printable(folder) for folder in folders]
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise InputError(f"{', '.join(names)}: a run is given twice; give different ones")
    if len(folders) > len(SERIES):
        raise InputError(f"{len(folders)} runs are more than the {len(SERIES)} colours of the page; give fewer")
    runs = [read_run(folder) for folder in folders]
    placed = [_place(run, runs[0]) for run in runs]
    scenes = []
    for name, colour, each in zip(names, SERIES, placed, strict=False):
        scene = build_scene(each.run, MAX_POSES // len(runs), each.start)
        scenes += [] if scene is None else [scene | {"name": name, "colour": colour}]
    if scenes:
        ends = [np.add(each["centre"], np.multiply(half, each["extent"])) for each in scenes for half in (-0.5, 0.5)]
        low, high = np.min(ends, axis=0), np.max(ends, axis=0)
        scenes[0] |= {"centre": 0.5 * (low + high), "extent": high - low, "size": float(np.linalg.norm(high - low))}
    settings = _side_by_side([_settings(run.entries) for run in runs])
    return write_page(
        path,
        "comparison.html",
        [each.run.frames.columns["timestamp"] - each.start for each in placed],
        _plots(names, placed),
        scenes,
        {"intervals": [], "pictures": []},
        kind="",
        runs=[
            {"name": name, "colour": colour, "note": each.note, "state": judge(each.run)}
            for name, colour, each in zip(names, SERIES, placed, strict=False)
        ],
        figures=_side_by_side([_figures(run) for run in runs]),
        settings=[(label, values) for label, values in settings if len(set(values)) > 1],
    )


def _place(run: RecordedRun, first: RecordedRun) -> _Placed:
    """Aligns a run to the first one: by the truth where both have the same, else by their paths."""
    start, apart = float(run.frames.columns["timestamp"][0]), np.full(len(run.frames), np.nan)
    if run is first:
        return _Placed(replace(run, dense=None, final=None, refined=None), start, "gives world and clock", apart)
    run = replace(run, map=None, dense=None, final=None, refined=None)
    try:
        rows, others = associate(run.trajectory, first.trajectory)
    except InputError:
        rows = others = np.zeros(0, np.int64)
    if len(rows) < _MIN_COMMON:
        return _Placed(run, start, "has no times of the first run: it has its own world, and starts at 0 s", apart)
    source, target = _true_positions(run)[rows], _true_positions(first)[others]
    known = np.isfinite(source + target).all(axis=1)
    by_truth = run.evaluation.get("truth") == first.evaluation.get("truth") and known.sum() >= _MIN_COMMON
    if not by_truth:
        source, target = run.trajectory.positions[rows], first.trajectory.positions[others]
        known[:] = True
    length = max(_AXIS * float(np.linalg.norm(np.ptp(target[known], axis=0))), 1e-3)
    best = absolute_orientation(
        _with_axes(source[known], run.trajectory.rotations[rows[known]], length),
        _with_axes(target[known], first.trajectory.rotations[others[known]], length),
    )
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = best.R, best.translation
    moved = Trajectory(run.trajectory.timestamps, T @ run.trajectory.poses)
    distance = np.linalg.norm(moved.positions[rows] - first.trajectory.positions[others], axis=1)
    evaluated = None if run.evaluated is None else replace(run.evaluated, truth=best.apply(run.evaluated.truth))
    note = f"is aligned to the first run by {'the truth' if by_truth else 'the paths'} at {known.sum()} common times"
    extent, variances = np.ptp(first.trajectory.positions[others], axis=0), run.covariances[rows, :3, :3]
    sigma = np.sqrt(np.median(np.trace(variances, axis1=1, axis2=2)))
    if not by_truth and np.sqrt(np.mean(distance**2)) > max(_OTHER * float(np.linalg.norm(extent)), 4.0 * sigma):
        note += ", but hardly follows it, as one of another recording"
    run = replace(run, trajectory=moved, evaluated=evaluated)
    return _Placed(run, float(first.frames.columns["timestamp"][0]), note, run.of_frames(distance, rows))


def _true_positions(run: RecordedRun) -> np.ndarray:
    """(N, 3) true positions of all poses in the world of the run, metres; NaN where they are not known."""
    positions = np.full((len(run.trajectory), 3), np.nan)
    if run.evaluated is not None:
        positions[run.evaluated.row] = run.evaluated.truth
    return positions


def _with_axes(points: np.ndarray, rotations: np.ndarray, length: float) -> np.ndarray:
    return np.concatenate([points, *(points + length * rotations[:, :, axis] for axis in range(3))])


def _plots(names: Sequence[str], placed: Sequence[_Placed]) -> list[dict[str, Any]]:
    """Plots of all runs with the same title become one, with what `build_plots` marks as compared."""
    title, caption = f"Distance to {names[0]} [m]", "Between the positions at the same time."
    merged: dict[str, dict[str, Any]] = {title: {"title": title, "caption": caption, "series": []}}
    for k, (name, each) in enumerate(zip(names, placed, strict=True)):
        distance = {"values": each.distance, "compared": ""} if np.isfinite(each.distance).any() else {}
        for plot in [{"title": title, "series": [distance]}, *build_plots(each.run)]:
            kept = merged.setdefault(plot["title"], plot | {"series": [], "bands": None})
            kept["log"] = kept.get("log") or plot.get("log")
            for series in plot["series"]:
                if "compared" in series:
                    style = {"dash": [6, 4] if series["compared"] == "3 sigma" else None, "fill": None}
                    label = f"{name} {series['compared']}".strip()
                    kept["series"].append(series | style | {"label": label, "colour": SERIES[k], "run": k})
    return [plot for plot in merged.values() if plot["series"]]


def _figures(run: RecordedRun) -> Facts:
    """Label and value of all that is compared in numbers."""
    head, rows = list_evaluation(run)
    return [
        *list_facts(run),
        *((f"{label}, {row[0]}", value) for row in rows for label, value in zip(head[1:], row[1:], strict=True)),
        *((name, f"{value} ± {sigma}") for name, value, sigma in list_calibration(run)),
    ]


def _settings(entries: dict[str, Any], above: str = "") -> Facts:
    """Name and value of what run.json says of how a run was made."""
    found: Facts = []
    for name, value in entries.items():
        if isinstance(value, dict) and name not in _RESULTS:
            found += _settings(value, f"{above}{name}: ")
        elif name not in _RESULTS:
            found.append((above + name, json.dumps(value, ensure_ascii=False)))
    return found


def _side_by_side(columns: Sequence[Facts]) -> list[tuple[str, list[str]]]:
    """A row for each label of any run."""
    labels = dict.fromkeys(label for column in columns for label, _ in column)
    return [(label, [dict(column).get(label, "–") for column in columns]) for label in labels]
