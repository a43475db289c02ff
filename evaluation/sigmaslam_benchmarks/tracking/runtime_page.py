"""The page of the benchmark `runtime`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.tracking.page import number, opening, table
from sigmaslam_benchmarks.tracking.sequences_page import Omission, method_label
from sigmaslam_benchmarks.tracking.stereo_peers import RECTIFIED
from sigmaslam_benchmarks.tracking.time_method import METHODS, WARM_UP, MethodTiming

SEQUENCE, SIZE = "sequence", "size"
"""Sections of the page."""
_COLUMNS = (
    "method",
    "tracked",
    "ATE m",
    "CPU ms, 1 thread",
    "p95",
    "times cuVSLAM's",
    "wall ms, 2 threads",
    "p95",
    "frames/s",
    "peak MiB",
    "first pose s",
)
_WORDS = """\
Every method runs in a process of its own, once held on one core and once on two; every library has as many threads. The
methods take turns, {rounds}. Figures are medians over the rounds, with the lowest and highest round in brackets.

- *CPU ms*: CPU time of all threads of the process from one frame to the next. *Wall ms*: time until the pose of a frame
  is there. Means over the frames but the first {warm_up}, keyframes in them; *p95*: 95 % of the frames take less.
  Images are decoded before, and reading them is not counted.
- *times cuVSLAM's*: ratio of the CPU times of the same round.
- *frames/s*: frames by the sum of their wall times, two threads.
- *peak MiB*: largest resident memory of the process, two threads, with Python and all libraries.
- *first pose*: from the start of the process to the pose of the second frame, two threads.
- *tracked*: frames with a pose. *ATE*: root mean square error of their positions after the best rigid alignment.
- *ours*: learned features; *ours with*: other features under the same filter. *KLT + PnP*, *SIFT + PnP*: from OpenCV
  alone (`sigmaslam_benchmarks.tracking.pnp_baselines`).
- *cuVSLAM*: on the CPU, by the package dim-odom. *ORB-SLAM3*: by the package pyorbslam3, the threads of its
  mapping included, with the vocabulary that `PYORBSLAM3_VOCAB` names. Both are given rectified images: to rectify is
  in the time of the others, not in theirs. ORB-SLAM3 is under the GPL: a peer of the development, no part of SigmaSLAM.
"""


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


def runtime_label(method: str) -> str:
    """A method as the page calls it."""
    return method_label(method)


def progress(run: TimedRun) -> str:
    """A run in a line."""
    threads = "1 thread" if run.threads == 1 else f"{run.threads} threads"
    cpu, wall = np.mean(run.timing.cpu_ms), np.mean(run.timing.wall_ms)
    return (
        f"{run.sequence}, {run.variant}: {runtime_label(run.method)}, {threads}, {cpu:.1f} ms CPU, {wall:.1f} ms wall, "
        f"{run.timing.peak_mib:.0f} MiB, ATE {number(run.ate, '.4f')} m"
    )


def format_runtime(results: Sequence[TimedRun | Omission], command: str, rounds: int, complete: bool = True) -> str:
    """The results as a Markdown page."""
    turns = "one round" if rounds == 1 else f"{rounds} rounds"
    lines = [*opening("Runtime", command, "."), "", _WORDS.format(rounds=turns, warm_up=WARM_UP)]
    if not complete:
        lines += ["**Stopped before the end: what is missing was not run.**", ""]
    for missing in (result for result in results if isinstance(result, Omission)):
        what = f" ({runtime_label(missing.method)})" if missing.sequence and missing.method else ""
        lines += [f"{missing.sequence or runtime_label(missing.method)}{what} is left out: {missing.reason}", ""]
    runs = [result for result in results if isinstance(result, TimedRun)]
    versions = {run.method: run.timing.version for run in runs if run.timing.version}
    if versions:
        lines += [f"Peers: {', '.join(versions[method] for method in RECTIFIED if method in versions)}.", ""]
    for sequence in dict.fromkeys(run.sequence for run in runs if run.section == SEQUENCE):
        lines += _sequence_lines(sequence, [run for run in runs if (run.section, run.sequence) == (SEQUENCE, sequence)])
    sized = [run for run in runs if run.section == SIZE]
    if sized:
        lines += _size_lines(sized)
    return "\n".join(lines)


def _sequence_lines(sequence: str, runs: list[TimedRun]) -> list[str]:
    frames = runs[0].timing.frames
    methods = [method for method in METHODS if any(run.method == method for run in runs)]
    lines = [f"## {sequence}, {runs[0].variant}, {frames} frames", ""]
    lines += [*table(_COLUMNS, (_row(method, runs) for method in methods)), ""]
    return lines


def _row(method: str, runs: Sequence[TimedRun]) -> list[str]:
    of_method = [run for run in runs if run.method == method]
    one, two = ([run for run in of_method if run.threads == threads] for threads in (1, 2))
    tracked = int(np.median([len(run.timing.poses) for run in of_method]))
    cuvslam = {run.round: np.mean(run.timing.cpu_ms) for run in runs if (run.method, run.threads) == ("cuvslam", 1)}
    ratios = [np.mean(run.timing.cpu_ms) / cuvslam[run.round] for run in one if run.round in cuvslam]
    return [
        runtime_label(method),
        f"{tracked} of {of_method[0].timing.frames}",
        number(float(np.median([run.ate for run in of_method])), ".4f"),
        _spread(one, _mean_cpu, ".1f"),
        _middle(one, lambda run: float(np.percentile(run.timing.cpu_ms, 95)), ".1f"),
        number(float(np.median(ratios)) if ratios else np.nan, ".2f"),
        _spread(two, lambda run: float(np.mean(run.timing.wall_ms)), ".1f"),
        _middle(two, lambda run: float(np.percentile(run.timing.wall_ms, 95)), ".1f"),
        _middle(two, lambda run: 1e3 / float(np.mean(run.timing.wall_ms)), ".1f"),
        _middle(two, lambda run: run.timing.peak_mib, ".0f"),
        _middle(two, lambda run: run.timing.first_pose_s, ".2f"),
    ]


def _size_lines(runs: list[TimedRun]) -> list[str]:
    sizes = list(dict.fromkeys(run.variant for run in runs))
    rows = []
    for method in METHODS:
        of_method = [run for run in runs if run.method == method]
        if of_method:
            cells = [_spread([run for run in of_method if run.variant == size], _mean_cpu, ".1f") for size in sizes]
            rows.append([runtime_label(method), *cells])
    return [
        "## Cost and image size",
        "",
        f"CPU ms of a frame, one thread, on the images of {runs[0].sequence}, resized.",
        "",
        *table(("method", *sizes), rows),
        "",
    ]


def _mean_cpu(run: TimedRun) -> float:
    return float(np.mean(run.timing.cpu_ms))


def _middle(runs: Sequence[TimedRun], measure: Callable[[TimedRun], float], form: str) -> str:
    """Median over the rounds."""
    return number(float(np.median([measure(run) for run in runs])) if runs else np.nan, form)


def _spread(runs: Sequence[TimedRun], measure: Callable[[TimedRun], float], form: str) -> str:
    """Median over the rounds, lowest and highest."""
    figures = [measure(run) for run in runs]
    middle = _middle(runs, measure, form)
    return middle if len(figures) < 2 else f"{middle} ({min(figures):{form}} - {max(figures):{form}})"
