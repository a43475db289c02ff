"""The page of the benchmark `consistency`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sigmaslam.slam.relative_poses import SPANS
from sigmaslam_benchmarks.tracking.page import header, missing_sequences, opening, row
from sigmaslam_evaluation.metrics.map_consistency import mean_with_error, ratio_with_error, root_mean_square_with_error


@dataclass(frozen=True, slots=True)
class Scale:
    """A kind of scene.

    Attributes:
        name: what it stands for.
        preset: of the renderer.
        width, height: pixels.
    """

    name: str
    preset: str
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class ConsistencyResult:
    """One method on one sequence; NaN where there is nothing to judge.

    Attributes:
        nees: of the absolute pose per degree of freedom, mean over frames.
        nees_last: at the last frame.
        inside: share of frames inside the 95 % ellipsoid.
        nis: per degree of freedom, over all tracked frames.
        ate: root mean square position error after alignment, metres.
        path_length: metres.
        offset_error: disparity offset at the end, estimated minus true, pixels.
        offset_z: the same over its sigma.
        lost: frames after the first without a pose from the images.
        filter_ms, total_ms: wall milliseconds a frame, median.
        points: of the map, judged.
        edges: of the map, left out.
        point_nees, point_median: of points per degree of freedom, mean and median.
        point_inside: share inside the 95 % ellipsoid.
        point_gross: share beyond 5 sigma.
        relative: of poses relative to earlier ones, by the name of the span: mean NEES per degree of freedom, and share
            of pairs inside the 95 % ellipsoid.
    """

    nees: float
    nees_last: float
    inside: float
    nis: float
    ate: float
    path_length: float
    offset_error: float
    offset_z: float
    lost: int
    filter_ms: float
    total_ms: float
    points: int
    edges: int
    point_nees: float
    point_median: float
    point_inside: float
    point_gross: float
    relative: Mapping[str, Sequence[float]]


Results: TypeAlias = Mapping[Scale, Mapping[str, Sequence[ConsistencyResult]]]
"""By scale and method, in the order of seeds; the last method has a calibration that is drawn."""


@dataclass(frozen=True, slots=True)
class Goal:
    """A range for one number; `name` is an attribute of `ConsistencyResult`."""

    label: str
    name: str
    low: float
    high: float
    percent: bool = False

    def holds(self, value: float) -> bool:
        """Whether the value is in range; NaN is not."""
        return self.low <= value <= self.high

    def write(self, value: float) -> str:
        """The value as the page has it."""
        return f"{100 * value:.0f} %" if self.percent else f"{value:.2f}"


GOALS = (
    Goal("NEES of poses per dof", "nees", 0.7, 1.5),
    Goal("poses inside 95 %", "inside", 0.90, 0.98, percent=True),
    Goal("NIS per dof", "nis", 0.9, 1.1),
    Goal("NEES of map points per dof", "point_nees", 0.7, 1.5),
    Goal("map points inside 95 %", "point_inside", 0.90, 0.98, percent=True),
)
_POSE_HEADER = (
    "method",
    "NEES",
    "NEES, last frame",
    "inside 95 %",
    "NIS",
    "ATE mm",
    "ATE, % of path",
    "ATE over ours",
    "offset error px",
    "offset z rms",
    "lost",
    "ms filter / all",
)
_MAP_HEADER = ("method", "points", "at edges", "NEES", "median", "inside 95 %", "beyond 5 sigma")


def format_page(
    results: Results, offset: float, frames: int, seeds: tuple[int, int], command: str, missing: Sequence[str] = ()
) -> str:
    """The page; the first method of each scale is the one that goals are for.

    Args:
        results: of the sequences that there are.
        offset: of all disparities, pixels.
        frames: of a sequence.
        seeds: the first one, and how many of a scale were asked for.
        command: that makes the page.
        missing: names of sequences that failed.
    """
    first, count = seeds
    lines = [
        *opening("Is it as sure as it says?", command, f". {count} rendered sequences a scale"),
        f"(seeds {first} to {first + count - 1}, used for nothing else), {frames} frames each, exact truth.",
        f"All disparities are {offset} px larger than the calibration says, and nobody tells the tracker. Images are",
        "reduced so that this can be afforded: "
        + ", ".join(f"{scale.name} ({scale.preset}) {scale.width}x{scale.height}" for scale in results)
        + ".",
        "The room stands for indoor flight and the organ for endoscopy because their images are written rectified:",
        "there the offset is the same in the whole image.",
        "The calibration is right but for that, and the tracker is told so (`sigmas: 0`). *Calibration drawn*: every",
        "number of it is off as the default sigmas say, anew for each sequence, and the tracker knows these sigmas.",
        *missing_sequences(missing),
        "",
        "Mean ± standard error over sequences. NEES and NIS per degree of freedom: 1 is right, more is overconfident.",
        "",
        "## Goals, for ours",
        "",
        *_goals(results, 0, GOALS),
        "",
        "## Goals, for ours with a calibration that is drawn",
        "",
        *_goals(results, -1, GOALS[:3]),
        "",
        "The tracker scales its noise by the NIS of earlier frames, so NIS near 1 proves little; NEES is the judge.",
        "",
    ]
    for scale, methods in results.items():
        lines += [f"## {scale.name}", "", *_tables(methods), ""]
    lines += _NOTES
    return "\n".join([*lines, ""])


_NOTES = [
    "## How it is measured",
    "",
    "- *NEES* of poses: of T_estimate^-1 T_truth, 6 dof, relative to the first frame; over all frames after the first,",
    "  lost ones too.",
    "- *NEES* and *inside* of poses relative to earlier ones: of T_i_j as known at frame j; i is a keyframe",
    "  about so far back on the path, or in time; over all pairs of a sequence.",
    "- *ATE*: root mean square position error after the best rigid alignment. *ATE over ours*: geometric mean of the",
    "  quotient on the same sequence.",
    "- *offset z rms*: root mean square of (estimated - true) / sigma at the last frame; 1 is right.",
    "- *lost*: frames after the first without a pose from the images, all sequences together.",
    "- *ms*: median frame, all cores busy with sequences, one thread each.",
    "- *points*: of the map, mean a sequence. The true point is where the ray of its pixel in the keyframe that hosts",
    "  it meets the scene from the true pose. *At edges*: left out because inverse depth bends by more than 2 % within",
    "  a pixel there (a slanted plane does not bend it). A right covariance has a median of 0.79 (3 dof), and next to",
    "  nothing beyond 5 sigma.",
]


def _goals(results: Results, method: int, goals: Sequence[Goal]) -> Iterator[str]:
    """Which goals the method of that position meets."""
    yield "| | goal | " + " | ".join(scale.name for scale in results) + " |"
    yield "|---|---|" + "---|" * len(results)
    missed = []
    for goal in goals:
        cells = []
        for scale, methods in results.items():
            judged = list(methods.values())[method]
            value, error = mean_with_error([getattr(result, goal.name) for result in judged])
            cells.append(f"{goal.write(value)} ± {goal.write(error)}" + ("" if goal.holds(value) else ", **missed**"))
            if not goal.holds(value):
                missed.append(f"{goal.label} in {scale.name} ({goal.write(value)})")
        yield row(goal.label, f"{goal.write(goal.low)} to {goal.write(goal.high)}", *cells)
    yield ""
    yield "Missed: " + "; ".join(missed) + "." if missed else "All goals are met."


def _tables(methods: Mapping[str, Sequence[ConsistencyResult]]) -> Iterator[str]:
    ours = next(iter(methods.values()))
    yield from header(*_POSE_HEADER, numbers_from=1)
    for method, trials in methods.items():
        ate = [result.ate for result in trials]
        cells = [
            _cell(trials, lambda r: r.nees),
            _cell(trials, lambda r: r.nees_last),
            _cell(trials, lambda r: 100 * r.inside, ".0f"),
            _cell(trials, lambda r: r.nis),
            _cell(trials, lambda r: 1e3 * r.ate, ".3g"),
            _cell(trials, lambda r: 100 * r.ate / r.path_length, ".3f"),
            "" if trials is ours else _spread(*ratio_with_error(ate, [result.ate for result in ours]), ".2f"),
            _cell(trials, lambda r: r.offset_error, "+.3f"),
            _spread(*root_mean_square_with_error([result.offset_z for result in trials]), ".2f"),
            f"{sum(result.lost for result in trials)}",
            f"{np.mean([r.filter_ms for r in trials]):.0f} / {np.mean([r.total_ms for r in trials]):.0f}",
        ]
        yield row(method, *cells)
    yield from _relative_table(methods)
    yield ""
    yield "Map points:"
    yield ""
    yield from header(*_MAP_HEADER, numbers_from=1)
    for method, trials in methods.items():
        points, edges = (sum(getattr(result, name) for result in trials) for name in ("points", "edges"))
        cells = [
            f"{points / len(trials):.0f}",
            f"{100 * edges / max(points + edges, 1):.1f} %",
            _cell(trials, lambda r: r.point_nees),
            _cell(trials, lambda r: r.point_median),
            _cell(trials, lambda r: 100 * r.point_inside, ".0f"),
            _cell(trials, lambda r: 100 * r.point_gross, ".1f") + " %",
        ]
        yield row(method, *cells)


def _relative_table(methods: Mapping[str, Sequence[ConsistencyResult]]) -> Iterator[str]:
    """Poses relative to earlier ones, over the spans that a scale has."""
    results = [result for trials in methods.values() for result in trials]
    spans = [span for span in SPANS if any(span in result.relative for result in results)]
    if not spans:
        return
    yield ""
    yield "Poses relative to earlier ones:"
    yield ""
    yield from header("method", *(f"{what} {span}" for span in spans for what in ("NEES", "inside")), numbers_from=1)
    for method, trials in methods.items():
        cells = []
        for span in spans:
            figures = [result.relative[span] for result in trials if span in result.relative]
            cells.append(_spread(*mean_with_error([nees for nees, _ in figures]), ".2f"))
            cells.append(_spread(*mean_with_error([100 * inside for _, inside in figures]), ".0f"))
        yield row(method, *cells)


def _cell(trials: Sequence[ConsistencyResult], value: Callable[[ConsistencyResult], float], form: str = ".2f") -> str:
    return _spread(*mean_with_error([value(result) for result in trials]), form)


def _spread(value: float, error: float, form: str) -> str:
    if np.isnan(value):
        return "-"
    return format(value, form) + ("" if np.isnan(error) else f" ± {format(error, form.replace('+', ''))}")
