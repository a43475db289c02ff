"""Faults of drivers and of calibrations on rendered and real recordings: what is silently wrong, and what is said."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam_benchmarks.live.calibration_faults import CALIBRATION_FAULTS, injected_errors
from sigmaslam_benchmarks.live.calibration_page import format_calibration_page
from sigmaslam_benchmarks.live.driven_runs import METHODS, DrivenRun
from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT, Fault
from sigmaslam_benchmarks.live.judge import Judgement, References, good_poses, judge
from sigmaslam_benchmarks.live.live_page import LivePage, format_page
from sigmaslam_benchmarks.live.recording_jobs import RecordingJob, hash_results, judge_recordings
from sigmaslam_benchmarks.live.recordings import SEQUENCES, GoodFrames, Recording, choose_recordings
from sigmaslam_benchmarks.tracking.page import check_names, write_page
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError

_NAMES = ("driver_faults.py", "calibration_faults.py", "driven_runs.py", "judge.py", "recordings.py")
_JUDGING = tuple(Path(__file__).with_name(name) for name in _NAMES)
_ALL = {**CALIBRATION_FAULTS, **FAULTS}


def write_live(
    path: Path,
    data: Path | None,
    runs: Path,
    command: str,
    first_seed: int,
    seeds: int,
    frames: int,
    cases: Sequence[str] | None = None,
    sequences: Sequence[str] | None = None,
    methods: Sequence[str] = ("ours",),
    workers: int = 1,
    note: Callable[[str], None] = lambda text: None,
    table: Mapping[str, Fault] = FAULTS,
    form_page: Callable[[LivePage], str] = format_page,
) -> str:
    """Tracks what is missing, writes the page, at first of what is there, and returns it; notes in it are kept.

    Args:
        first_seed, seeds: of the renders; the faults of real recordings have the first one.
        frames: of each recording.
        cases, sequences, methods: names of `table`, `SEQUENCES` and `METHODS`; all cases and sequences unless given.
        table: of faults.
        form_page: Markdown of what there is.
    Raises:
        InputError: a name is unknown, or the data are not there.
        OutputError: a recording failed; the page holds what there is.
    """
    for kind, names, known in (
        ("case", cases, table),
        ("method", methods, METHODS),
        ("sequence", sequences, SEQUENCES),
    ):
        check_names(kind, names or (), list(known))
    note(f"seeds {first_seed} to {first_seed + seeds - 1}")
    chosen = choose_recordings(sequences, data, first_seed, seeds, dict.fromkeys(SEQUENCES, frames))
    wanted = [name for name in table if not cases or name in cases]
    tasks = {f"{method}-{case}": (method, case) for method in methods for case in wanted}
    code = hash_results(_JUDGING)
    jobs = [RecordingJob(each, tasks, _judge, _JUDGING, runs.resolve(), data, code) for each in chosen]

    def form() -> str:
        asked = len(jobs) * len(tasks)
        return write_page(path, form_page(LivePage(command, wanted, list(methods), _collect(jobs), frames, asked)))

    if _collect(jobs):
        form()
    return judge_recordings(path, jobs, form, workers, note)


write_calibration = partial(write_live, table=CALIBRATION_FAULTS, form_page=format_calibration_page)
"""The same with faults of the calibration."""


def _judge(job: RecordingJob, good: GoodFrames, task: tuple[str, str]) -> dict[str, Any]:
    """A judgement, or why there is none, under `left_out`."""
    method, case = task
    if not _ALL[case].fits(good.frames):
        return {"left_out": "longer than the recording"}
    try:
        reference = None if job.recording.exact or case == NO_FAULT else _reference(job, good, method)
        run = _run(job, good, method, case)
    except MissingPeerError as error:
        return {"left_out": str(error)}
    judgement = judge(run.poses, good.truth, reference, run.said, run.refused, run.learned)
    return {**asdict(judgement), "true_errors": injected_errors(good.camera, case)}


def _run(job: RecordingJob, good: GoodFrames, method: str, case: str) -> DrivenRun:
    frames = _ALL[case].spoil(good.frames, np.random.default_rng(job.recording.seed))
    with tempfile.TemporaryDirectory() as scratch:
        return METHODS[method](frames, _ALL[case].miscalibrate(good.camera), Path(scratch) / "run")


def _reference(job: RecordingJob, good: GoodFrames, method: str) -> References:
    """The run with good frames, whose poses are kept beside the results."""
    path = job.path(f"{method}-poses").with_suffix(f".{job.code[:16]}.npy")
    if not path.is_file():
        np.save(path, good_poses(_run(job, good, method, NO_FAULT).poses, len(good.frames)).poses)
    return References(np.load(path))


def _collect(jobs: Sequence[RecordingJob]) -> dict[tuple[Recording, str, str], Judgement | str]:
    """What there is: a judgement, or why there is none, by recording, method and case."""
    found: dict[tuple[Recording, str, str], Judgement | str] = {}
    for job in jobs:
        for name, (method, case) in job.tasks.items():
            result = job.read(name)
            if result is not None:
                found[job.recording, method, case] = result.get("left_out") or Judgement(**result)
    return found
