"""Dark stretches on rendered and real recordings, without and with the inertial sensor, and faults of its table."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sigmaslam_benchmarks.inertial.dark_runs import METHODS, DarkCase, DarkResult, run_dark
from sigmaslam_benchmarks.inertial.inertial_page import InertialPage, format_page
from sigmaslam_benchmarks.inertial.table_faults import TABLE_FAULTS, FaultResult, TableFault, judge_table
from sigmaslam_benchmarks.live.recording_jobs import RecordingJob, hash_results, judge_recordings
from sigmaslam_benchmarks.live.recordings import GoodFrames, Recording, choose_recordings
from sigmaslam_benchmarks.tracking.page import check_names, write_page

SECONDS = (0.5, 1.0, 2.0, 5.0)
"""Of darkness."""
FAULTS = 40
"""Faulty tables that are drawn, of the kinds in turn."""
# Recordings that they are put into, at most: one and three of each kind.
_FAULTY = 7
FRAMES = {"room": 170, "street": 85, "mh01": 100}
"""Pairs of each world: 8.5 s of a render, of which the first third is light, and all of MH_01 that is there."""
_RATE = 200.0
# Of a render the dark begins once, where `live` covers lenses; in MH_01 wherever it leaves frames after it. A second of
# darkness, which goals are for, begins there at all of these frames, other stretches at every second one.
_STARTS = {"room": (56,), "street": (28,), "mh01": (20, 30, 40, 50, 60, 70)}
_LEAST_AFTER = 5
_JUDGING = tuple(Path(__file__).with_name(name) for name in ("dark_runs.py", "table_faults.py"))


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
    faults, code = deal_faults(chosen, first_seed), hash_results(_JUDGING)
    jobs = [
        RecordingJob(
            each,
            {task.name: task for task in (*dark_cases(each), *faults.get(each, ()))},
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


def deal_faults(recordings: Sequence[Recording], seed: int) -> dict[Recording, list[TableFault]]:
    """The shares of the first recordings in the faults, and a good table each."""
    kinds = list(TABLE_FAULTS)
    dealt = {each: [TableFault("", seed)] for each in recordings[:_FAULTY]}
    for number in range(FAULTS):
        # Every round of the kinds begins with the next recording.
        recording = recordings[(number + number // len(kinds)) % len(dealt)]
        dealt[recording].append(TableFault(kinds[number % len(kinds)], seed + number))
    return dealt


def dark_cases(recording: Recording) -> list[DarkCase]:
    """Without darkness, and with all that fits."""
    kind, rate = recording.kind, 10.0 if recording.kind == "street" else 20.0
    last = recording.frames - _LEAST_AFTER
    dark = [
        (seconds, first)
        for seconds in SECONDS
        for first in (_STARTS[kind] if seconds == 1.0 else _STARTS[kind][::2])
        if first + round(seconds * rate) <= last
    ]
    return [DarkCase(method, *each) for each in [(0.0, 0), *dark] for method in METHODS]


def _judge(job: RecordingJob, good: GoodFrames, task: DarkCase | TableFault) -> dict[str, Any]:
    if isinstance(task, DarkCase):
        return asdict(run_dark(good, task, job.recording.seed))
    return asdict(judge_table(good, task.kind, task.seed))


def _collect(jobs: Sequence[RecordingJob], command: str) -> InertialPage:
    runs: dict[tuple[Recording, DarkCase], DarkResult] = {}
    faults: list[tuple[Recording, FaultResult]] = []
    for job in jobs:
        for name, task in job.tasks.items():
            found: Mapping[str, Any] | None = job.read(name)
            if found is not None and isinstance(task, DarkCase):
                runs[job.recording, task] = DarkResult(**found)
            elif found is not None:
                faults.append((job.recording, FaultResult(**found)))
    return InertialPage(command, SECONDS, runs, faults, sum(len(job.missing) for job in jobs))
