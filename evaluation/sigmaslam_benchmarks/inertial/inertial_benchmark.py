"""Dark stretches on rendered and real recordings, without an inertial sensor, with its gyro, and with all of it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sigmaslam_benchmarks.inertial.dark_runs import METHODS, DarkCase, DarkResult, run_dark
from sigmaslam_benchmarks.inertial.inertial_page import InertialPage, format_page
from sigmaslam_benchmarks.live.recording_jobs import RecordingJob, hash_results, judge_recordings
from sigmaslam_benchmarks.live.recordings import GoodFrames, Recording, choose_recordings
from sigmaslam_benchmarks.tracking.page import check_names, write_page

FRAMES = {"room": 170, "street": 85, "mh01": 100}
"""Pairs of each world: 8.5 s of a render, of which the first third is light, and all of MH_01 that is there."""
_RATE = 200.0
# What happens in the dark does not depend on how long it stays: one run is judged after each of these seconds.
_STRETCHES: tuple[tuple[float, ...], ...] = ((0.0,), (0.5, 1.0, 2.0), (5.0,))
# A second of darkness, which goals are for, begins in MH_01 at all of these frames, a longer one at every second one.
_STARTS = {"room": (56,), "street": (28,), "mh01": (10, 20, 30, 40, 50, 60, 70)}
_MH01_STRETCHES: tuple[tuple[float, ...], ...] = ((0.0,), (0.5, 1.0), (2.0,))
_LEAST_AFTER = 5
_JUDGING = (Path(__file__).with_name("dark_runs.py"),)


def write_inertial(
    path: Path,
    data: Path | None,
    runs: Path,
    command: str,
    first_seed: int,
    seeds: int,
    worlds: Sequence[str] | None = None,
    workers: int = 1,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Tracks what is missing, writes the page, at first of what is there, and returns it; notes in it are kept.

    Args:
        path, data, runs, command, first_seed, seeds, workers, note: as of `write_live`, and what it raises.
        worlds: names of `FRAMES`; all that there are unless given.
    """
    check_names("world", worlds or (), list(FRAMES))
    note(f"seeds {first_seed} to {first_seed + seeds - 1}")
    # The real ones first.
    chosen = sorted(choose_recordings(worlds, data, first_seed, seeds, FRAMES, _RATE), key=lambda each: each.exact)
    code = hash_results(_JUDGING)
    jobs = [
        RecordingJob(
            each,
            {case.name: case for case in dark_cases(each, METHODS if each.seed == first_seed else METHODS[-1:])},
            _judge,
            _JUDGING,
            runs.resolve(),
            data,
            code,
        )
        for each in chosen
    ]

    def form() -> str:
        return write_page(path, format_page(_collect(jobs, command)))

    return judge_recordings(path, jobs, form, workers, note)


def dark_cases(recording: Recording, methods: Sequence[str]) -> list[DarkCase]:
    """Without darkness, and with all that fits; of methods that are compared the first start alone."""
    kind, rate = recording.kind, 10.0 if recording.kind == "street" else 20.0
    last = recording.frames - _LEAST_AFTER
    dark = [
        (marks, first)
        for marks in (_MH01_STRETCHES if kind == "mh01" else _STRETCHES)
        for first in (_STARTS[kind] if marks[-1] == 1.0 else _STARTS[kind][::2] if marks[-1] else (0,))
        if first + round(marks[-1] * rate) <= last
    ]
    compared = dict(reversed(dark))
    return [
        DarkCase(method, marks, first)
        for marks, first in dark
        for method in methods
        if method == METHODS[-1] or first == compared[marks]
    ]


def _judge(job: RecordingJob, good: GoodFrames, case: DarkCase) -> dict[str, Any]:
    return {"marks": [asdict(each) for each in run_dark(good, case, job.recording.seed)]}


def _collect(jobs: Sequence[RecordingJob], command: str) -> InertialPage:
    runs: dict[tuple[Recording, str, int, float], DarkResult] = {}
    for job in jobs:
        for name, case in job.tasks.items():
            for mark, found in zip(case.marks, (job.read(name) or {}).get("marks", ()), strict=False):
                runs[job.recording, case.method, case.first, mark] = DarkResult(**found)
    return InertialPage(command, runs, sum(len(job.missing) for job in jobs))
