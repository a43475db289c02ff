"""The tracker on every stereo sequence there is, with every front-end, side by side in one run."""

from __future__ import annotations

import os
import platform
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks.page import write_page
from sigmaslam.evaluation.evaluate import Evaluation, evaluate_run
from sigmaslam.readers import open_sequence
from sigmaslam.report import FrameTable, read_frames
from sigmaslam.run import track_sequence

REAL = (
    ("kitti_raw_0926_0039_a", "poses.txt"),
    ("kitti_odometry_01_f000_050", "poses.txt"),
    ("euroc_v1_01_keyframes_a", "groundtruth.csv"),
    ("euroc_v1_01_static", "groundtruth.csv"),
)
"""Folder and its truth; the demo comes first and needs no data."""
_STAGES = ("features", "match", "filter", "map")


@dataclass(frozen=True, slots=True)
class SequenceResult:
    """One front-end on one sequence."""

    sequence: str
    frontend: str
    evaluation: Evaluation
    frames: FrameTable


def run_sequences(data: Path | None, frontends: Sequence[str]) -> list[SequenceResult]:
    """Tracks and evaluates everything.

    Args:
        data: folder with the real sequences, or None for the demo alone.
        frontends: names of front-ends.
    Raises:
        InputError: `data` does not hold the sequences.
    """
    if data is not None:
        missing = [name for name, _ in REAL if not (data / name).is_dir()]
        if missing:
            raise InputError(f"{data} does not hold {', '.join(missing)}: give the folder of the data sets with --data")
    results = []
    with as_file(files("sigmaslam.synthetic") / "demo") as demo, tempfile.TemporaryDirectory() as scratch:
        inputs = [("demo (rendered)", demo, demo / "poses.txt")]
        if data is not None:
            inputs += [(name, data / name, data / name / truth) for name, truth in REAL]
        for name, source, truth in inputs:
            for frontend in frontends:
                run = Path(scratch) / f"{name}-{frontend}"
                track_sequence(open_sequence(source), run, frontend)
                evaluation = evaluate_run(run, truth, plot=False)
                results.append(SequenceResult(name, frontend, evaluation, read_frames(run / "frames.csv")))
    return results


def format_results(results: Sequence[SequenceResult], command: str) -> str:
    """The results as a Markdown page."""
    lines = [
        "# Results",
        "",
        f"Made by `{command}` on {platform.machine()}, {os.cpu_count()} cores, one run, front-ends in turn. Accuracy",
        "is the same in every run on one machine; times are wall milliseconds. No setting differs between sequences.",
        "",
        "- *tracked*: frames with a pose from the images; the first frame of a run is its origin.",
        "- *ATE*: root mean square position error after the best rigid alignment, metres.",
        "- *t_rel*, *r_rel*: KITTI segments, of 100 m where the path allows, else of 10 to 50 m.",
        "- *step*: median error from frame to frame over tracked frames.",
        "- *NIS*, *NEES*: per degree of freedom, 1 is right; NEES against exact truth means something on renders only.",
        "",
    ]
    for sequence in dict.fromkeys(result.sequence for result in results):
        rows = [result for result in results if result.sequence == sequence]
        lines += [f"## {sequence}", "", _ACCURACY_HEADER, "|---|" + "---|" * (_ACCURACY_HEADER.count("|") - 2)]
        lines += [_accuracy_row(row) for row in rows]
        lines += ["", _TIME_HEADER, "|---|" + "---|" * (_TIME_HEADER.count("|") - 2)]
        lines += [_time_row(row) for row in rows]
        lines.append("")
    return "\n".join(lines)


def write_results(path: Path, data: Path | None, frontends: Sequence[str], command: str) -> str:
    """Runs everything, writes the page and returns it; what is below a line `<!-- notes -->` in the page is kept."""
    return write_page(path, format_results(run_sequences(data, frontends), command))


_ACCURACY_COLUMNS = ("front-end", "tracked", "ATE m", "t_rel %", "r_rel deg/100 m", "step mm", "step deg", "inliers")
_ACCURACY_HEADER = "| " + " | ".join((*_ACCURACY_COLUMNS, "NIS", "NEES", "offset px")) + " |"
_TIME_HEADER = "| front-end | features | matching | filter | map | total, median (p10 - p90) | frames/s |"


def _accuracy_row(result: SequenceResult) -> str:
    evaluation, frames = result.evaluation, result.frames
    tracked = np.array(frames.status) == "tracking"
    dof = frames.columns["dof"]
    nis = np.median(frames.columns["nis"][tracked] / dof[tracked]) if tracked.any() else np.nan
    # Frame k ends step k - 1; frames that were skipped have no pose and no step.
    ends_tracked = tracked[np.array(frames.status) != "skipped"][1:]
    translations, rotations = evaluation.rpe.translations, evaluation.rpe.rotations_deg
    if len(ends_tracked) != len(translations):
        ends_tracked = np.ones(len(translations), bool)
    offset, sigma = frames.columns["disparity_offset"][-1], frames.columns["disparity_offset_sigma"][-1]
    nees = evaluation.nees.mean if evaluation.nees is not None else np.nan
    cells = [
        result.frontend,
        f"{tracked.sum()} of {len(frames) - 1}",
        f"{evaluation.ate.rmse:.4f}",
        _number(evaluation.kitti.mean_translation_percent, ".2f"),
        _number(evaluation.kitti.mean_rotation_deg_per_100m, ".2f"),
        _number(1e3 * float(np.median(translations[ends_tracked])) if ends_tracked.any() else np.nan, ".2f"),
        _number(float(np.median(rotations[ends_tracked])) if ends_tracked.any() else np.nan, ".3f"),
        _number(float(np.median(frames.columns["inliers"][tracked])) if tracked.any() else np.nan, ".0f"),
        _number(float(nis), ".2f"),
        _number(nees, ".2f"),
        f"{offset:+.2f} ± {sigma:.2f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _time_row(result: SequenceResult) -> str:
    frames = result.frames
    stages = [frames.milliseconds[stage] for stage in _STAGES]
    total = np.nansum(stages, axis=0)[np.isfinite(stages[0])]
    low, middle, high = np.percentile(total, [10, 50, 90])
    cells = [
        result.frontend,
        *(f"{np.nanmedian(stage):.1f}" for stage in stages),
        f"{middle:.0f} ({low:.0f} - {high:.0f})",
        f"{1e3 / middle:.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def _number(value: float, form: str) -> str:
    return "-" if not np.isfinite(value) else format(value, form)
