"""Faults of drivers and of calibrations on rendered and real recordings: what is silently wrong, and what is said."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam import errors
from sigmaslam.errors import InputError, OutputError
from sigmaslam.files import atomic_write_text, make_folder
from sigmaslam_benchmarks.code_hash import hash_code
from sigmaslam_benchmarks.live.calibration_faults import CALIBRATION_FAULTS, injected_errors
from sigmaslam_benchmarks.live.calibration_page import format_calibration_page
from sigmaslam_benchmarks.live.driven_runs import METHODS, DrivenRun
from sigmaslam_benchmarks.live.driver_faults import FAULTS, NO_FAULT, Fault
from sigmaslam_benchmarks.live.judge import Judgement, References, good_poses, judge
from sigmaslam_benchmarks.live.live_page import LivePage, format_page
from sigmaslam_benchmarks.live.recordings import GoodFrames, Recording, choose_recordings
from sigmaslam_benchmarks.tracking.page import check_names, write_page
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError
from sigmaslam_synthetic.parallel_jobs import list_failures, run_jobs

# The page may change without a new run.
_JUDGING = ("driver_faults.py", "calibration_faults.py", "driven_runs.py", "judge.py", "recordings.py")

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
        path: Markdown page.
        data: folder of the real data sets; None: renders alone.
        runs: folder for renders and results; a result is used again when it comes from the same code.
        command: what the page says it was made by.
        first_seed, seeds: of the renders; the faults of real recordings have the first one.
        frames: of each recording.
        cases, sequences, methods: names of `table`, `SEQUENCES` and `METHODS`; all cases and sequences unless given.
        workers: processes; each takes a recording at a time.
        note: is told of progress.
        table: of faults.
        form_page: Markdown of what there is.
    Raises:
        InputError: a name is unknown, or the data are not there.
        OutputError: a recording failed; the page holds what there is.
    """
    check_names("case", cases or (), list(table))
    check_names("method", methods, list(METHODS))
    note(f"seeds {first_seed} to {first_seed + seeds - 1}")
    chosen = choose_recordings(sequences, data, first_seed, seeds, frames)
    make_folder(runs)
    wanted = [name for name in table if not cases or name in cases]
    jobs = [
        LiveJob(recording, tuple(wanted), tuple(methods), runs.resolve(), data, _hash_code()) for recording in chosen
    ]
    asked = sum(len(job.pairs) for job in jobs)
    failed: dict[str, Exception] = {}

    def form() -> str:
        return write_page(path, form_page(LivePage(command, wanted, list(methods), _collect(jobs), frames, asked)))

    def ended(job: LiveJob, outcome: str | Exception) -> None:
        if isinstance(outcome, Exception):
            failed[job.recording.name] = outcome
        note(f"{job.recording.name}: {outcome}")
        form()

    if _collect(jobs):
        form()
    run_jobs(LiveJob.make, [job for job in jobs if job.missing], workers, ended)
    page = form()
    if failed:
        raise OutputError(f"{path} lacks {list_failures(failed)}: the same command tries what is missing again")
    return page


write_calibration = partial(write_live, table=CALIBRATION_FAULTS, form_page=format_calibration_page)
"""The same with faults of the calibration."""


@cache
def _hash_code() -> str:
    """Everything between the images and what is said, and the simulator."""
    return hash_code(
        *Path(errors.__file__).parent.rglob("*.py"), *(Path(__file__).with_name(name) for name in _JUDGING)
    )


@dataclass(frozen=True, slots=True)
class LiveJob:
    """One recording with all its cases and methods, in a worker."""

    recording: Recording
    cases: tuple[str, ...]
    methods: tuple[str, ...]
    runs: Path
    data: Path | None
    code: str

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """Method and case in the order in which they run."""
        return [(method, case) for method in self.methods for case in self.cases]

    @property
    def missing(self) -> list[tuple[str, str]]:
        """Of `pairs`, those without a result."""
        return [pair for pair in self.pairs if self.read(*pair) is None]

    def read(self, method: str, case: str) -> dict[str, Any] | None:
        """A judgement, or why there is none, under `left_out`; None where it is missing or of something else."""
        path = self._path(method, case)
        if not path.is_file():
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
        return dict(content["result"]) if content.get("made_from") == self._made_from() else None

    def make(self) -> str:
        """Judges what is missing; each result is kept at once."""
        if _hash_code() != self.code:
            raise InputError("this worker has another state of SigmaSLAM: install the same commit wherever jobs run")
        began, missing = time.perf_counter(), self.missing
        good = self.recording.open(self.runs, self.data)
        for method, case in missing:
            self._write(method, case, self._judge(good, method, case))
        return f"{len(missing)} runs in {time.perf_counter() - began:.0f} s"

    def _judge(self, good: GoodFrames, method: str, case: str) -> dict[str, Any]:
        if not _ALL[case].fits(good.frames):
            return {"left_out": "longer than the recording"}
        try:
            reference = None if self.recording.exact or case == NO_FAULT else self._reference(good, method)
            run = self._run(good, method, case)
        except MissingPeerError as error:
            return {"left_out": str(error)}
        judgement = judge(run.poses, good.truth, reference, run.said, run.refused, run.learned)
        return {**asdict(judgement), "true_errors": injected_errors(good.camera, case)}

    def _run(self, good: GoodFrames, method: str, case: str) -> DrivenRun:
        frames = _ALL[case].spoil(good.frames, np.random.default_rng(self.recording.seed))
        with tempfile.TemporaryDirectory() as scratch:
            return METHODS[method](frames, _ALL[case].miscalibrate(good.camera), Path(scratch) / "run")

    def _reference(self, good: GoodFrames, method: str) -> References:
        """The run with good frames, whose poses are kept beside the results."""
        path = self._path(method, "poses").with_suffix(f".{self.code[:16]}.npy")
        if not path.is_file():
            np.save(path, good_poses(self._run(good, method, NO_FAULT).poses, len(good.frames)).poses)
        return References(np.load(path))

    def _write(self, method: str, case: str, result: dict[str, Any]) -> None:
        content = {"made_from": self._made_from(), "result": result}
        atomic_write_text(self._path(method, case), json.dumps(content, indent=1) + "\n")

    def _path(self, method: str, case: str) -> Path:
        return self.runs / f"{self.recording.name}-{method}-{case}.json"

    def _made_from(self) -> dict[str, Any]:
        return {"recording": asdict(self.recording), "code": self.code}


def _collect(jobs: Sequence[LiveJob]) -> dict[tuple[Recording, str, str], Judgement | str]:
    """What there is: a judgement, or why there is none, by recording, method and case."""
    found: dict[tuple[Recording, str, str], Judgement | str] = {}
    for job in jobs:
        for method, case in job.pairs:
            result = job.read(method, case)
            if result is not None:
                found[job.recording, method, case] = result.get("left_out") or Judgement(**result)
    return found
