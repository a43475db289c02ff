"""The page of the benchmark `runtime`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sigmaslam_benchmarks.tracking.page import fill_page, number
from sigmaslam_benchmarks.tracking.sequences_page import Omission, method_label
from sigmaslam_benchmarks.tracking.stereo_peers import RECTIFIED
from sigmaslam_benchmarks.tracking.time_method import METHODS, WARM_UP, MethodTiming

SEQUENCE, SIZE = "sequence", "size"
"""Sections of the page."""


@dataclass(frozen=True, slots=True)
class TimedRun:
    """One process.

    Attributes:
        section: of the page.
        sequence: name.
        variant: size of the images.
        method, threads: what was run.
        round: in which.
        timing: what it took.
        ate: metres; NaN without poses.
    """

    section: str
    sequence: str
    variant: str
    method: str
    threads: int
    round: int
    timing: MethodTiming
    ate: float


def progress(run: TimedRun) -> str:
    """A run in a line."""
    threads = "1 thread" if run.threads == 1 else f"{run.threads} threads"
    cpu, wall = np.mean(run.timing.cpu_ms), np.mean(run.timing.wall_ms)
    return (
        f"{run.sequence}, {run.variant}: {method_label(run.method)}, {threads}, {cpu:.1f} ms CPU, {wall:.1f} ms wall, "
        f"{run.timing.peak_mib:.0f} MiB, ATE {number(run.ate, '.4f')} m"
    )


def format_runtime(results: Sequence[TimedRun | Omission], command: str, rounds: int, complete: bool = True) -> str:
    """The results as a Markdown page."""
    runs = [result for result in results if isinstance(result, TimedRun)]
    versions = {run.method: run.timing.version for run in runs if run.timing.version}
    sections = {section: [run for run in runs if run.section == section] for section in (SEQUENCE, SIZE)}
    names = dict.fromkeys(run.sequence for run in sections[SEQUENCE])
    return fill_page(
        "runtime",
        command,
        rounds="one round" if rounds == 1 else f"{rounds} rounds",
        warm_up=WARM_UP,
        complete=complete,
        left_out=[(_what(each), each.reason) for each in results if isinstance(each, Omission)],
        versions=[versions[method] for method in RECTIFIED if method in versions],
        sequences=[_sequence([run for run in sections[SEQUENCE] if run.sequence == name]) for name in names],
        sizes=list(dict.fromkeys(run.variant for run in sections[SIZE])),
        size_rows=list(_size_rows(sections[SIZE])),
        varied=" and ".join(dict.fromkeys(run.sequence for run in sections[SIZE])),
    )


def _what(missing: Omission) -> str:
    """The sequence, the method, or both."""
    method = method_label(missing.method) if missing.method else ""
    return f"{missing.sequence} ({method})" if missing.sequence and method else missing.sequence or method


def _sequence(runs: Sequence[TimedRun]) -> dict[str, Any]:
    """What the page says of one sequence."""
    methods = [method for method in METHODS if any(run.method == method for run in runs)]
    return {
        "title": f"{runs[0].sequence}, {runs[0].variant}, {runs[0].timing.frames} frames",
        "rows": [_row(method, runs) for method in methods],
        "keyframes": [row for method in methods for row in _keyframes(method, runs)],
    }


def _marked(method: str, runs: Sequence[TimedRun]) -> list[TimedRun]:
    """Runs of a method on one thread that say which frames became keyframes."""
    return [run for run in runs if (run.method, run.threads) == (method, 1) and any(run.timing.keyframes)]


def _keyframes(method: str, runs: Sequence[TimedRun]) -> list[list[str]]:
    """What keyframes took, and other frames: rows of a table."""
    marked, rows = _marked(method, runs), []
    for name, kind in (("keyframes", True), ("others", False)):
        chosen = [np.array(run.timing.cpu_ms)[np.array(run.timing.keyframes) == kind] for run in marked]
        if chosen and all(map(len, chosen)):
            mean = number(float(np.median([each.mean() for each in chosen])), ".1f")
            rows.append([f"{method_label(method)}, {name}", f"{len(chosen[0])}", mean, _percentiles(chosen)])
    return rows


def _row(method: str, runs: Sequence[TimedRun]) -> list[str]:
    of_method = [run for run in runs if run.method == method]
    one, two = ([run for run in of_method if run.threads == threads] for threads in (1, 2))
    tracked = int(np.median([len(run.timing.poses) for run in of_method]))
    cuvslam = {run.round: np.mean(run.timing.cpu_ms) for run in runs if (run.method, run.threads) == ("cuvslam", 1)}
    ratios = [np.mean(run.timing.cpu_ms) / cuvslam[run.round] for run in one if run.round in cuvslam]
    return [
        method_label(method),
        f"{tracked} of {of_method[0].timing.frames}",
        number(float(np.median([run.ate for run in of_method])), ".4f"),
        _spread(one, _mean_cpu, ".1f"),
        _percentiles([np.array(run.timing.cpu_ms) for run in one]),
        number(float(np.median(ratios)) if ratios else np.nan, ".2f"),
        _spread(two, lambda run: float(np.mean(run.timing.wall_ms)), ".1f"),
        _middle(two, lambda run: float(np.percentile(run.timing.wall_ms, 95)), ".1f"),
        _middle(two, lambda run: 1e3 / float(np.mean(run.timing.wall_ms)), ".1f"),
        _middle(two, lambda run: run.timing.peak_mib, ".0f"),
        _middle(two, lambda run: run.timing.first_pose_s, ".2f"),
        _middle(one, lambda run: 1e3 * run.timing.joules / run.timing.frames, ".0f"),
    ]


def _size_rows(runs: Sequence[TimedRun]) -> Iterator[list[str]]:
    sizes = dict.fromkeys(run.variant for run in runs)
    for method in METHODS:
        of_method = [run for run in runs if run.method == method]
        if of_method:
            cells = [_spread([run for run in of_method if run.variant == size], _mean_cpu, ".1f") for size in sizes]
            yield [method_label(method), *cells]


def _mean_cpu(run: TimedRun) -> float:
    return float(np.mean(run.timing.cpu_ms))


def _middle(runs: Sequence[TimedRun], measure: Callable[[TimedRun], float], form: str) -> str:
    """Median over the rounds."""
    return number(float(np.median([measure(run) for run in runs])) if runs else np.nan, form)


def _percentiles(times: Sequence[np.ndarray]) -> str:
    """Median, and what 95 % and 99 % of the frames stay below; medians over the rounds."""
    shares = np.array([np.percentile(each, (50, 95, 99)) for each in times]).reshape(-1, 3)
    return ", ".join(f"{each:.1f}" for each in np.median(shares, axis=0)) if len(shares) else "-"


def _spread(runs: Sequence[TimedRun], measure: Callable[[TimedRun], float], form: str) -> str:
    """Median over the rounds, lowest and highest."""
    figures = [measure(run) for run in runs]
    middle = _middle(runs, measure, form)
    return middle if len(figures) < 2 else f"{middle} ({min(figures):{form}} - {max(figures):{form}})"
