"""Faults of drivers on rendered and real recordings: how many poses are silently wrong, and what is said."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam_benchmarks.live.driven_runs import METHODS, DrivenRun
from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT, spoil
from sigmaslam_benchmarks.live.judge import Judgement, References, good_poses, judge
from sigmaslam_benchmarks.live.live_page import LivePage, format_page
from sigmaslam_benchmarks.live.recording_jobs import RecordingJob, hash_results, judge_recordings
from sigmaslam_benchmarks.live.recordings import SEQUENCES, GoodFrames, Recording, choose_recordings
from sigmaslam_benchmarks.tracking.page import check_names, write_page
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError

_NAMES = ("driver_faults.py", "driven_runs.py", "judge.py", "recordings.py")
_JUDGING = tuple(Path(__file__).with_name(name) for name in _NAMES)


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
) -> str:
    """Tracks what is missing, writes the page, at first of what is there, and returns it; notes in it are kept.

    Args:
        first_seed, seeds: of the renders; the faults of real recordings have the first one.
        frames: of each recording.
        cases, sequences, methods: names of `FAULTS`, `SEQUENCES` and `METHODS`; all cases and sequences unless given.
    Raises:
        InputError: a name is unknown, or the data are not there.
        OutputError: a recording failed; the page holds what there is.
    """
    for kind, names, known in (
        ("case", cases, FAULTS),
        ("method", methods, METHODS),
        ("sequence", sequences, SEQUENCES),
    ):
        check_names(kind, names or (), list(known))
    note(f"seeds {first_seed} to {first_seed + seeds - 1}")
    chosen = choose_recordings(sequences, data, first_seed, seeds, dict.fromkeys(SEQUENCES, frames))
    wanted = [name for name in FAULTS if not cases or name in cases]
    tasks = {f"{method}-{case}": (method, case) for method in methods for case in wanted}
    code = hash_results(_JUDGING)
    jobs = [RecordingJob(each, tasks, _judge, _JUDGING, runs.resolve(), data, code) for each in chosen]

    def form() -> str:
        asked = len(jobs) * len(tasks)
        return write_page(path, format_page(LivePage(command, wanted, list(methods), _collect(jobs), frames, asked)))

    if _collect(jobs):
        form()
    return judge_recordings(path, jobs, form, workers, note)


def _judge(job: RecordingJob, good: GoodFrames, task: tuple[str, str]) -> dict[str, Any]:
    """A judgement, or why there is none, under `left_out`."""
    method, case = task
    if not FAULTS[case].fits(good.frames):
        return {"left_out": "longer than the recording"}
    try:
        reference = None if job.recording.exact or case == NO_FAULT else _reference(job, good, method)
        run = _run(job, good, method, case)
    except MissingPeerError as error:
        return {"left_out": str(error)}
    return asdict(judge(run.poses, good.truth, reference, run.said, run.refused))


def _run(job: RecordingJob, good: GoodFrames, method: str, case: str) -> DrivenRun:
    with tempfile.TemporaryDirectory() as scratch:
        return METHODS[method](spoil(case, good.frames, job.recording.seed), good.camera, Path(scratch) / "run")


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
