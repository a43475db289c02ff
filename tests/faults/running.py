"""The command line on a fault, in this process or in one of its own, and calls from Python."""

from __future__ import annotations

import os
import subprocess
import traceback
from collections.abc import Callable
from pathlib import Path
from unittest import mock

from sigmaslam.errors import SigmaSlamError
from tests.faults.case import Case, Outcome, Runner
from tests.support.commands import command_line, environment, run_here
from tests.support.time_limit import HangError, limited_time

# A good run takes a second or two; other processes may take the cores.
_HERE_SECONDS, _PROCESS_SECONDS = 60.0, 120.0
# Address space, of which ONNX Runtime and OpenBLAS reserve more than they use.
_MEMORY_BYTES = 8 << 30
# Messages are not cut into lines.
_WIDE = {"COLUMNS": "4000"}


def one_line(*texts: str) -> str:
    """Texts without line ends."""
    return " ".join(" ".join(texts).split())


def run_in_process(*arguments: str | Path, folder: Path | None = None) -> Outcome:
    """`sigmaslam` in a process of its own, with bounded memory; `folder` holds a package to use instead of this one."""
    with mock.patch.dict(os.environ, _WIDE):
        variables = environment(*([] if folder is None else [folder]))
    try:
        done = subprocess.run(
            ["prlimit", f"--as={_MEMORY_BYTES}", *command_line(*arguments)],
            env=variables,
            # Not this checkout, whose package Python would find first.
            cwd=folder,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            timeout=_PROCESS_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return Outcome(-1, "", f"no end in {_PROCESS_SECONDS:g} s")
    return Outcome(done.returncode, one_line(done.stdout, done.stderr))


def run_in_this_process(*arguments: str | Path, folder: Path | None = None) -> Outcome:
    """`sigmaslam` here, which spares its start, without the pictures of a report."""
    if folder is not None:
        return run_in_process(*arguments, folder=folder)
    with (
        mock.patch.dict(os.environ, _WIDE),
        mock.patch("sigmaslam.report.report.write_report"),
        limited_time(_HERE_SECONDS),
    ):
        done = run_here(*arguments)
    return Outcome(done.returncode, one_line(done.stdout, done.stderr))


def call(action: Callable[[], object]) -> Outcome:
    """The outcome of a call from Python: an error of ours counts as exit code 2, what it returns as its text."""
    try:
        return Outcome(0, one_line(str(action())))
    except SigmaSlamError as error:
        return Outcome(2, one_line(f"error: {error}"))


def attempt(case: Case, folder: Path, runner: Runner) -> Outcome:
    """Runs the case; errors that nobody expects are part of the outcome."""
    try:
        return case.attempt(folder, runner)
    except (Exception, HangError) as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return Outcome(-1, "", f"{type(error).__name__} at {Path(where.filename).name}:{where.lineno}: {error}"[:300])
