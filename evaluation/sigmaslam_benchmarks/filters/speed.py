"""Speed of the filters beside other people's: the same work, interleaved, one thread, in process CPU time."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sigmaslam.progress import open_progress
from sigmaslam_benchmarks.filters import extended, sequences
from sigmaslam_benchmarks.filters import ours as filter_ours
from sigmaslam_benchmarks.filters import work as filter_work
from sigmaslam_benchmarks.filters.peer_filters import Peer, available, single_thread_environment
from sigmaslam_benchmarks.filters.work import BatchedWork, StereoWork
from sigmaslam_benchmarks.tracking.page import fill_page, write_page

Table = tuple[list[str], list[list[str]]]
"""Columns and rows."""

POINTS = (10, 50, 100, 200, 500)
MANY_POINTS = (1000, 2000, 5000)
BATCHES = (1, 100, 10_000, 100_000)
KINDS = ("localisation", "position", "landmark", "linear")
_SEED = 0
# A round times each contender for about this long, and at least once; what takes longer than the limit gets one round.
_ROUND_SECONDS = 0.1
_SLOW_SECONDS = 2.0
_LOOP_LIMIT = 1000  # filters in a Python loop; the rate of such a loop does not depend on their number


@dataclass(frozen=True, slots=True)
class Contender:
    """A row of a table: its name, and the function that does one step of all filters of a work."""

    name: str
    step: Callable[[], object]


@dataclass(frozen=True, slots=True)
class Timing:
    """Seconds of CPU time a step, one figure a round."""

    seconds: list[float]

    @property
    def median(self) -> float:
        """The middle round."""
        return statistics.median(self.seconds)

    def ratio(self, other: Timing) -> tuple[float, float, float]:
        """How many times longer this takes than the other: median, lowest and highest over the rounds they share."""
        ratios = [a / b for a, b in zip(self.seconds, other.seconds, strict=False)]
        return statistics.median(ratios), min(ratios), max(ratios)


def time_interleaved(contenders: Sequence[Contender], rounds: int) -> dict[str, Timing]:
    """Times all contenders in turn, round after round, so that a busy moment hits them alike."""
    counts = {}
    for contender in contenders:
        contender.step()  # compiles, allocates
        start = time.process_time()
        contender.step()
        counts[contender.name] = time.process_time() - start
    seconds: dict[str, list[float]] = {contender.name: [] for contender in contenders}
    for k in range(rounds):
        for contender in contenders:
            once = max(counts[contender.name], 1e-6)
            if k > 0 and once > _SLOW_SECONDS:
                continue
            repeats = max(1, int(_ROUND_SECONDS / once))
            start = time.process_time()
            for _ in range(repeats):
                contender.step()
            seconds[contender.name].append((time.process_time() - start) / repeats)
    return {name: Timing(values) for name, values in seconds.items()}


def stereo_contenders(work: StereoWork, peers: Sequence[Peer], compiled: bool) -> list[Contender]:
    """Everyone who does the 12-state stereo problem in float64; the plain numpy reference comes first."""
    contenders = [Contender(_REFERENCE, lambda: filter_work.step_stereo_low_rank(work))]
    contenders.append(Contender(_EAGER, filter_ours.make(work)))
    if compiled:
        contenders.append(Contender(_COMPILED, filter_ours.make(work, compiled=True)))
    contenders += [Contender(peer.name, peer.make(work, "float64")) for peer in peers if StereoWork in peer.works]
    return contenders


def batch_contenders(kind: str, batch: int, peers: Sequence[Peer], compiled: bool) -> list[tuple[Contender, int]]:
    """Everyone who does a kind of small filter, with the number of filters in a step; in float32 where there is one."""
    work: BatchedWork = getattr(filter_work, kind)(batch, _SEED)
    looped: BatchedWork = work if batch <= _LOOP_LIMIT else getattr(filter_work, kind)(_LOOP_LIMIT, _SEED)
    size = min(batch, _LOOP_LIMIT)
    contenders = [(Contender(_REFERENCE, lambda: filter_work.step_loop(looped)), size)]
    contenders.append((Contender(_EAGER, filter_ours.make(work, "float32")), batch))
    if compiled:
        contenders.append((Contender(_COMPILED, filter_ours.make(work, "float32", compiled=True)), batch))
    for peer in peers:
        if type(work) in peer.works:
            step = peer.make(work if peer.batched else looped, peer.dtypes[-1])
            contenders.append((Contender(peer.name, step), batch if peer.batched else size))
    return contenders


_REFERENCE = "plain numpy"
_EAGER = "SigmaSLAM"
_COMPILED = "SigmaSLAM, compiled"


def format_page(rounds: int, compiled: bool, command: str) -> str:
    """Runs the benchmark and makes the page."""
    peers = available()
    tables = len(POINTS) + 2 + len(KINDS) * len(BATCHES)
    with open_progress() as progress:
        task = progress.add_task("timing", total=tables, note="")

        def advance() -> None:
            progress.advance(task)

        values = {
            **_time_stereo(peers, rounds, compiled, advance),
            "linear_cost": _time_many_points(rounds, compiled, advance),
            "batches": [(_TITLES[kind], *_time_batches(kind, peers, rounds, compiled, advance)) for kind in KINDS],
            "extended": time_extended(rounds),
            "sequences": time_sequences(rounds) if compiled else None,
        }
        advance()
    versions = ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    return fill_page("filters", command, rounds=rounds, versions=versions, steps=sequences.STEPS, **values)


def _time_stereo(peers: Sequence[Peer], rounds: int, compiled: bool, advance: Callable[[], None]) -> dict[str, Any]:
    results = []
    for points in POINTS:
        results.append(time_interleaved(stereo_contenders(filter_work.stereo(points, _SEED), peers, compiled), rounds))
        advance()

    def cells(name: str) -> list[str]:
        if name == _REFERENCE:
            return [f"{1e3 * result[name].median:.3g} ms" for result in results]
        return [_ratio(*result[name].ratio(result[_REFERENCE])) for result in results]

    best = _COMPILED if compiled else _EAGER
    beside = results[-1]["filterpy"].ratio(results[-1][best]) if "filterpy" in results[-1] else ()
    return {
        "stereo": (["", *(f"m = {points}" for points in POINTS)], [[name, *cells(name)] for name in results[0]]),
        "most_points": POINTS[-1],
        "best": best,
        "beside_filterpy": [f"{each:.0f}" for each in beside],
    }


def _time_many_points(rounds: int, compiled: bool, advance: Callable[[], None]) -> Table:
    """Microseconds a point."""
    counts, cells = (POINTS[-1], *MANY_POINTS), []
    for points in counts:
        results = time_interleaved(stereo_contenders(filter_work.stereo(points, _SEED), [], compiled), rounds)
        cells.append([1e6 * timing.median / points for timing in results.values()])
    advance()
    rows = [[name, *(f"{column[i]:.2f}" for column in cells)] for i, name in enumerate(results)]
    return ["", *(f"m = {count}" for count in counts)], rows


def _time_batches(kind: str, peers: Sequence[Peer], rounds: int, compiled: bool, advance: Callable[[], None]) -> Table:
    columns = []
    for batch in BATCHES:
        contenders = batch_contenders(kind, batch, peers, compiled)
        timings = time_interleaved([contender for contender, _ in contenders], rounds)
        columns.append({c.name: [size / s for s in timings[c.name].seconds] for c, size in contenders})
        advance()
    rows = [[name, *(_rate(column[name]) for column in columns)] for name in columns[0]]
    return _batch_names(BATCHES), rows


def time_extended(rounds: int) -> Table:
    """The extended filter's time over the unscented one's, for models without derivatives of their own."""
    rows = []
    for name, make in extended.KINDS.items():
        cells = []
        for batch in extended.BATCHES:
            contenders = [Contender(each, step) for each, step in make(batch).items()]
            timings = time_interleaved(contenders, rounds)
            milliseconds = ", ".join(f"{1e3 * timings[each.name].median:.3g} ms" for each in contenders)
            cells.append(f"{_ratio(*timings['EKF'].ratio(timings['UKF']))}: {milliseconds}")
        rows.append([name, *cells])
    return _batch_names(extended.BATCHES), rows


def time_sequences(rounds: int) -> Table:
    """Whole sequences, compiled and not."""
    columns = []
    for batch in sequences.BATCHES:
        contenders = [Contender(each, step) for each, step in sequences.make(batch).items()]
        timings = time_interleaved(contenders, rounds)
        columns.append({name: [batch * sequences.STEPS / s for s in timings[name].seconds] for name in timings})
    return _batch_names(sequences.BATCHES), [[name, *(_rate(each[name]) for each in columns)] for name in columns[0]]


def _batch_names(batches: Sequence[int]) -> list[str]:
    return ["", *(f"B = {batch:,}" for batch in batches)]


_TITLES = {
    "localisation": "Localisation in the plane: 3 states, unicycle, range and bearing of a landmark",
    "position": "Localisation in the plane: 3 states, unicycle, position fix",
    "landmark": "Landmarks: 3 states, stereo measurement of 3 rows",
    "linear": "Linear: 4 states, constant velocity, Kalman filter",
}
_PACKAGES = ("torch", "numpy", "filterpy", "stonesoup", "dynamax", "jax", "pypose", "torch-kf")


def _ratio(middle: float, low: float, high: float) -> str:
    return f"x{middle:.3g} ({low:.3g} - {high:.3g})"


def _rate(rates: list[float]) -> str:
    value = statistics.median(rates)
    return f"{value / 1e6:.2f} M" if value >= 1e6 else f"{value / 1e3:.3g} k"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def write_filters(path: Path, rounds: int, eager: bool, command: str) -> str:
    """Runs the benchmark in a process of one thread, writes the page and returns it.

    What is below a line `<!-- notes -->` in the page is kept.
    """
    job = json.dumps({"path": str(path), "rounds": rounds, "eager": eager, "command": command})
    # BLAS reads its number of threads when it is loaded: hence another process.
    words = [sys.executable, "-m", "sigmaslam_benchmarks.filters.speed", job]
    subprocess.run(words, env={**os.environ, **single_thread_environment()}, check=True)
    return path.read_text(encoding="utf-8")


def main() -> None:
    """Does the job of `write_filters` in this process."""
    job = json.loads(sys.argv[1])
    torch.set_num_threads(1)
    np.seterr(all="ignore")
    path = Path(job["path"])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_page(path, format_page(job["rounds"], not job["eager"], job["command"]))


if __name__ == "__main__":
    main()
