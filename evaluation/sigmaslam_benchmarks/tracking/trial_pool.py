"""Rendered sequences of a benchmark, each with all its methods in a worker, and the page of those that are there."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sigmaslam.errors import InputError, OutputError
from sigmaslam.files import make_folder
from sigmaslam_benchmarks.tracking.page import write_page
from sigmaslam_benchmarks.trial import read_figures, render, write_figures
from sigmaslam_synthetic.parallel_jobs import list_failures, run_jobs
from sigmaslam_synthetic.simulation import Recipe

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True, slots=True)
class TrialKind:
    """What a benchmark does with every sequence. Its functions are functions of a module: workers receive them.

    Attributes:
        methods: their names.
        judge: figures of a method, from the rendered folder and its recipe.
        hash_code: hash of all code that figures depend on.
    """

    methods: Collection[str]
    judge: Callable[[Path, Recipe, str], DataclassInstance]
    hash_code: Callable[[], str]


@dataclass(frozen=True, slots=True)
class SequenceTrials:
    """One sequence, with all methods.

    Attributes:
        kind: what is done with it.
        recipe: of the sequence.
        folder: of renders and figures.
        code: hash of all code that figures depend on.
    """

    kind: TrialKind
    recipe: Recipe
    folder: Path
    code: str

    def read(self, method: str) -> dict[str, Any] | None:
        """The figures that are kept, unless they are of something else."""
        return read_figures(self._path(method), self._made_from())

    @property
    def missing(self) -> list[str]:
        """Methods without figures."""
        return [method for method in self.kind.methods if self.read(method) is None]

    def make(self) -> str:
        """Renders and judges what is missing; says how long both took.

        Raises:
            InputError: the code here is not that of the process that reads the cache.
        """
        if self.kind.hash_code() != self.code:
            raise InputError("this worker has another state of SigmaSLAM: install the same commit wherever jobs run")
        began = time.perf_counter()
        source = render(self.folder, self.recipe, 1)
        rendered = time.perf_counter()
        missing = self.missing
        for method in missing:
            figures = asdict(self.kind.judge(source, self.recipe, method))
            write_figures(self._path(method), self._made_from(), figures)
        tracked = time.perf_counter() - rendered
        return f"{source.name}, rendered in {rendered - began:.0f} s, {len(missing)} methods in {tracked:.0f} s"

    def _path(self, method: str) -> Path:
        slug = "".join(letter if letter.isalnum() else "_" for letter in method)
        return self.folder / f"{self.recipe.name}-{slug}.json"

    def _made_from(self) -> dict[str, Any]:
        return {"recipe": asdict(self.recipe), "code": self.code}


def write_trials(
    path: Path,
    runs: Path,
    kind: TrialKind,
    recipes: Sequence[Recipe],
    form: Callable[[list[SequenceTrials], list[str]], str],
    workers: int,
    ray: str | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Does what is missing, writes the page and returns it; notes in it are kept.

    Args:
        path: Markdown page.
        runs: folder for renders and figures; the machines of a Ray cluster must share it.
        kind: what is done.
        recipes: of the sequences, in the order in which they are begun.
        form: the page, of the sequences that are complete and the names of those that failed.
        workers, ray: as `run_jobs` takes them.
    Raises:
        OutputError: a sequence failed, of which the page says that it is missing; or all did, and there is no page.
    """
    make_folder(runs)
    code = kind.hash_code()
    jobs = [SequenceTrials(kind, recipe, runs.resolve(), code) for recipe in recipes]
    missing = [job for job in jobs if job.missing]
    note(f"{len(jobs) - len(missing)} of {len(jobs)} sequences are there")
    failed: dict[str, Exception] = {}
    count = 0

    def ended(job: SequenceTrials, outcome: str | Exception) -> None:
        nonlocal count
        count += 1
        if isinstance(outcome, Exception):
            failed[job.recipe.name] = outcome
            outcome = f"failed: {list_failures({job.recipe.name: outcome})}"
        note(f"{count} of {len(missing)}: {outcome}")

    run_jobs(SequenceTrials.make, missing, workers, ended, ray)
    complete = [job for job in jobs if job.recipe.name not in failed]
    page = write_page(path, form(complete, sorted(failed))) if complete else ""
    if failed:
        state = "lacks" if complete else "is not written, for want of"
        raise OutputError(f"{path} {state} {list_failures(failed)}: the same command tries what is missing again")
    return page
