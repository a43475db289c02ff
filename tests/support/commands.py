"""The command line: in a process of its own, as a shell runs it, or in this one, which starts at once."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from sigmaslam.cli import main

ROOT = Path(__file__).resolve().parents[2]
Finished = subprocess.CompletedProcess[str]


def command_line(*arguments: str | Path) -> list[str]:
    """To be run with `environment`."""
    return [sys.executable, "-m", "sigmaslam", *map(str, arguments)]


def environment(*folders: str | Path) -> dict[str, str]:
    """In which processes import from these folders first, then this checkout, whatever is installed."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (*folders, ROOT)))}


def run_process(*arguments: str | Path) -> Finished:
    """`sigmaslam` with these arguments, as a shell runs it."""
    command = command_line(*arguments)
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, env=environment())


def run_here(*arguments: str | Path) -> Finished:
    """`sigmaslam` with these arguments in this process; exceptions that it does not expect come through."""
    output, errors, code = io.StringIO(), io.StringIO(), 0
    before = sys.argv
    sys.argv = ["sigmaslam", *map(str, arguments)]
    try:
        with _fresh_logging(), contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
            main()
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    finally:
        sys.argv = before
    return subprocess.CompletedProcess(sys.argv, code, output.getvalue(), errors.getvalue())


def assert_refused(result: Finished, *words: str) -> None:
    """One line of error with these words, exit code 2, no traceback."""
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    for word in words:
        assert word in result.stderr


@contextlib.contextmanager
def _fresh_logging() -> Iterator[None]:
    """The root logger without handlers, as in a new process."""
    root = logging.getLogger()
    handlers, level = root.handlers, root.level
    root.handlers = []
    try:
        yield
    finally:
        root.handlers = handlers
        root.setLevel(level)
