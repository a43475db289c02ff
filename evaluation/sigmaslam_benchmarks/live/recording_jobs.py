"""Recordings that are judged in workers, each result kept at once and used again while the code is the same."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

from sigmaslam import errors
from sigmaslam.errors import InputError, OutputError
from sigmaslam.files import make_folder
from sigmaslam_benchmarks.code_hash import hash_code
from sigmaslam_benchmarks.live.recordings import GoodFrames, Recording
from sigmaslam_benchmarks.trial import read_figures, write_figures
from sigmaslam_synthetic.parallel_jobs import list_failures, run_jobs


@dataclass(frozen=True, slots=True)
class RecordingJob:
    """One recording with all that is judged of it, in a worker.

    Attributes:
        recording: what is tracked.
        tasks: what `judge` is given, by the name of the result.
        judge: figures of a task, from the good frames; a function of a module: workers receive it.
        judging: files of the code that judges; a page may change without a new run.
        runs: folder of renders and results.
        data: of real recordings.
        code: hash of everything between the images and the results.
    """

    recording: Recording
    tasks: Mapping[str, Any]
    judge: Callable[[Self, GoodFrames, Any], dict[str, Any]]
    judging: tuple[Path, ...]
    runs: Path
    data: Path | None
    code: str

    @property
    def missing(self) -> list[str]:
        """Names of results that are not there."""
        return [name for name in self.tasks if self.read(name) is None]

    def read(self, name: str) -> dict[str, Any] | None:
        """The figures; None where they are missing or of something else."""
        return read_figures(self.path(name), self._made_from())

    def make(self) -> str:
        """Judges what is missing; each result is kept at once."""
        if hash_results(self.judging) != self.code:
            raise InputError("this worker has another state of SigmaSLAM: install the same commit wherever jobs run")
        began, missing = time.perf_counter(), self.missing
        good = self.recording.open(self.runs, self.data)
        for name in missing:
            write_figures(self.path(name), self._made_from(), self.judge(self, good, self.tasks[name]))
        return f"{len(missing)} runs in {time.perf_counter() - began:.0f} s"

    def path(self, name: str) -> Path:
        """Of a result."""
        return self.runs / f"{self.recording.name}-{name}.json"

    def _made_from(self) -> dict[str, Any]:
        return {"recording": asdict(self.recording), "code": self.code}


@cache
def hash_results(judging: tuple[Path, ...]) -> str:
    """Hash of everything between the images and what is said, and the simulator."""
    return hash_code(*Path(errors.__file__).parent.rglob("*.py"), *judging)


def judge_recordings(
    path: Path,
    jobs: Sequence[RecordingJob],
    form: Callable[[], str],
    workers: int,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Does what is missing, a recording at a time in each worker; writes the page after each, and returns it.

    Args:
        path: of the page, for messages.
        jobs: of the recordings.
        form: writes the page of what there is.
    Raises:
        OutputError: a recording failed; the page holds what there is.
    """
    failed: dict[str, Exception] = {}

    def ended(job: RecordingJob, outcome: str | Exception) -> None:
        if isinstance(outcome, Exception):
            failed[job.recording.name] = outcome
        note(f"{job.recording.name}: {outcome}")
        form()

    for folder in {job.runs for job in jobs}:
        make_folder(folder)
    run_jobs(RecordingJob.make, [job for job in jobs if job.missing], workers, ended)
    page = form()
    if failed:
        raise OutputError(f"{path} lacks {list_failures(failed)}: the same command tries what is missing again")
    return page
