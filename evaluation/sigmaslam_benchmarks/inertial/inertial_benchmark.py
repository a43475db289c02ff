"""Dark stretches on rendered and real recordings, without and with the inertial sensor."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from sigmaslam import errors
from sigmaslam.errors import InputError, OutputError
from sigmaslam.files import atomic_write_text, make_folder
from sigmaslam_benchmarks.code_hash import hash_code
from sigmaslam_benchmarks.inertial.dark_runs import METHODS, DarkCase, DarkResult, run_dark
from sigmaslam_benchmarks.inertial.inertial_page import InertialPage, format_page
from sigmaslam_benchmarks.live.recordings import REAL, RENDERED, Recording
from sigmaslam_benchmarks.tracking.page import check_names, write_page
from sigmaslam_synthetic.parallel_jobs import list_failures, run_jobs

SECONDS = (0.5, 1.0, 2.0, 5.0)
"""Of darkness."""
WORLDS = (*RENDERED, "mh01")
# Pairs of each recording: 8.5 s of a render, of which the first third is light, and all of MH_01 that is there.
_FRAMES = {"room": 170, "street": 85, "mh01": 100}
_RATE = 200.0
# Of a render the dark begins once, where `live` covers lenses; in MH_01 wherever it leaves frames after it. A second of
# darkness, which goals are for, begins there at all of these frames, other stretches at every second one.
_STARTS = {"room": (56,), "street": (28,), "mh01": (20, 30, 40, 50, 60, 70)}
_LEAST_AFTER = 5


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
        path: Markdown page.
        data: folder of the real data sets; None: renders alone.
        runs: folder for renders and results; a result is used again when it comes from the same code.
        command: what the page says it was made by.
        first_seed, seeds: of the renders; dark images have the first one.
        worlds: names of `WORLDS`; all that there are unless given.
        workers: processes; each takes a recording at a time.
        note: is told of progress.
    Raises:
        InputError: a name is unknown, or the data are not there.
        OutputError: a recording failed; the page holds what there is.
    """
    check_names("world", worlds or (), WORLDS)
    wanted = worlds or [name for name in WORLDS if name in RENDERED or data is not None]
    if "mh01" in wanted and (data is None or not (data / REAL["mh01"][0]).is_dir()):
        raise InputError(f"{data or 'no folder'} does not hold {REAL['mh01'][0]}: give the folder with --data")
    note(f"seeds {first_seed} to {first_seed + seeds - 1}")
    make_folder(runs)
    jobs = [InertialJob(each, runs.resolve(), data, _hash_code()) for each in _recordings(wanted, first_seed, seeds)]
    failed: dict[str, Exception] = {}

    def form() -> str:
        return write_page(path, format_page(_collect(jobs, command, SECONDS)))

    def ended(job: InertialJob, outcome: str | Exception) -> None:
        if isinstance(outcome, Exception):
            failed[job.recording.name] = outcome
        note(f"{job.recording.name}: {outcome}")
        form()

    run_jobs(InertialJob.make, [job for job in jobs if job.missing], workers, ended)
    page = form()
    if failed:
        raise OutputError(f"{path} lacks {list_failures(failed)}: the same command tries what is missing again")
    return page


def _recordings(worlds: Sequence[str], first_seed: int, seeds: int) -> list[Recording]:
    real = [Recording(name, name, _FRAMES[name], first_seed) for name in worlds if name in REAL]
    rendered = [
        Recording(f"{name}{seed}", name, _FRAMES[name], seed, _RATE)
        for seed in range(first_seed, first_seed + seeds)
        for name in worlds
        if name in RENDERED
    ]
    return real + rendered


@cache
def _hash_code() -> str:
    """Everything between the images and what is said, and the simulator."""
    return hash_code(*Path(errors.__file__).parent.rglob("*.py"), Path(__file__).with_name("dark_runs.py"))


class InertialJob:
    """One recording with all its cases, in a worker.

    Args:
        recording: what is tracked.
        runs: folder of renders and results.
        data: of real recordings.
        code: hash of all code that results depend on.
    """

    def __init__(self, recording: Recording, runs: Path, data: Path | None, code: str) -> None:
        self.recording, self.runs, self.data, self.code = recording, runs, data, code

    @property
    def cases(self) -> list[DarkCase]:
        """Without darkness, and with all that fits."""
        kind, rate = self.recording.kind, 10.0 if self.recording.kind == "street" else 20.0
        last = self.recording.frames - _LEAST_AFTER
        dark = [
            (seconds, first)
            for seconds in SECONDS
            for first in (_STARTS[kind] if seconds == 1.0 else _STARTS[kind][::2])
            if first + round(seconds * rate) <= last
        ]
        return [DarkCase(method, *each) for each in [(0.0, 0), *dark] for method in METHODS]

    @property
    def missing(self) -> list[str]:
        """Names of results that are not there."""
        return [case.name for case in self.cases if self.read(case.name) is None]

    def read(self, name: str) -> dict[str, Any] | None:
        """The figures; None where they are missing or of something else."""
        path = self._path(name)
        if not path.is_file():
            return None
        content = json.loads(path.read_text(encoding="utf-8"))
        return dict(content["result"]) if content.get("made_from") == self._made_from() else None

    def make(self) -> str:
        """Judges what is missing; each result is kept at once."""
        if _hash_code() != self.code:
            raise InputError("this worker has another state of SigmaSLAM: install the same commit wherever jobs run")
        began, missing = time.perf_counter(), set(self.missing)
        good = self.recording.open(self.runs, self.data)
        for case in self.cases:
            if case.name in missing:
                self._write(case.name, asdict(run_dark(good, case, self.recording.seed)))
        return f"{len(missing)} runs in {time.perf_counter() - began:.0f} s"

    def _write(self, name: str, result: Mapping[str, Any]) -> None:
        content = {"made_from": self._made_from(), "result": result}
        atomic_write_text(self._path(name), json.dumps(content, indent=1) + "\n")

    def _path(self, name: str) -> Path:
        return self.runs / f"{self.recording.name}-{name}.json"

    def _made_from(self) -> dict[str, Any]:
        return {"recording": asdict(self.recording), "code": self.code}


def _collect(jobs: Sequence[InertialJob], command: str, seconds: Sequence[float]) -> InertialPage:
    runs: dict[tuple[Recording, DarkCase], DarkResult] = {}
    for job in jobs:
        for case in job.cases:
            if (found := job.read(case.name)) is not None:
                runs[job.recording, case] = DarkResult(**found)
    return InertialPage(command, seconds, runs, sum(len(job.missing) for job in jobs))
