"""Runs in processes of their own that wait, so that they can be stopped in the midst of a frame."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

from tests.support.commands import environment


def statuses(run: Path) -> list[str]:
    """Of the rows of frames.csv that are there whole."""
    table = run / "frames.csv"
    return [line.split(b",")[1].decode() for line in table.read_bytes().split(b"\n")[1:-1]] if table.exists() else []


def start(source: Path, run: Path, *options: str, rows: int = 4) -> subprocess.Popen[str]:
    """A run with so many rows of frames.csv; it takes ages for each more, so that signals come in the midst of it."""
    script = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from sigmaslam.cli import main\n"
        "from sigmaslam.slam.tracker import StereoTracker\n"
        "step, table = StereoTracker.step, Path(sys.argv[sys.argv.index('--out') + 1]) / 'frames.csv'\n"
        "def slow(*arguments):\n"
        f"    time.sleep(60 if table.read_bytes().count(b'\\n') > {rows} else 0)\n"
        "    return step(*arguments)\n"
        "StereoTracker.step = slow\n"
        "main()\n"
    )
    command = [sys.executable, "-c", script, "track", str(source), "--out", str(run), "--frontend", "klt", *options]
    process = subprocess.Popen(
        command,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=hear_signals,
    )
    deadline = time.monotonic() + 60
    while len(statuses(run)) < rows:
        assert time.monotonic() < deadline, "no frame came"
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    return process


def hear_signals() -> None:
    """Under nohup, and in the background of a shell, signals are ignored, and so by the program."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def end(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    try:
        output, errors = process.communicate(timeout=60)
    except subprocess.TimeoutExpired:
        process.kill()
        raise
    return process.returncode, output, errors
