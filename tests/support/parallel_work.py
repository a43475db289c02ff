"""What workers do in tests of jobs: functions of a module, which processes and Ray can import."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path


def square(number: int) -> int:
    """Odd numbers are refused."""
    if number % 2:
        raise ValueError(f"{number} is odd")
    return number * number


def die_once(marks: Path) -> str:
    """Notes each attempt in a file; the process of the first one is killed. Gives the name of the file."""
    with marks.open("a") as file:
        file.write("x")
    if marks.read_text() == "x" and marks.name == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return marks.name


def die(marks: Path) -> str:
    """Notes each attempt in a file; the process is killed each time."""
    with marks.open("a") as file:
        file.write("x")
    os.kill(os.getpid(), signal.SIGKILL)
    return marks.name


def sleep_beside_another(folder: Path) -> tuple[float, float]:
    """Waits until two processes are at work, then sleeps; gives the times between which it slept, in seconds."""
    (folder / str(os.getpid())).touch()
    deadline = time.monotonic() + 100.0
    while len(list(folder.iterdir())) < 2:
        if time.monotonic() > deadline:
            raise TimeoutError("the second worker did not come")
        time.sleep(0.01)
    begin = time.monotonic()
    time.sleep(0.5)
    return begin, time.monotonic()


def sleep_under_own_number(path: Path) -> None:
    """Writes the number of its process, and sleeps for a minute."""
    path.with_suffix(".part").write_text(str(os.getpid()))
    path.with_suffix(".part").rename(path)
    time.sleep(60.0)
