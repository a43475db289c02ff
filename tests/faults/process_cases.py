"""Faults of weights, signals, disks and memory, and of calls from Python."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from unittest import mock

import numpy as np

import sigmaslam
from sigmaslam.readers import open_sequence
from sigmaslam.slam.tracker import StereoTracker
from tests.faults.case import DEMO, Case, Outcome, Runner, Verdict
from tests.faults.inputs import KLT, good, track
from tests.faults.running import call, one_line
from tests.support.commands import ROOT, command_line, environment
from tests.support.stopped_runs import end, start

# ---- weights


def _weights(change: Callable[[Path], object], *options: str) -> Callable[..., Outcome]:
    """Tracks with a package whose weights are changed."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        weights = _copy_weights(folder / "installed")
        change(weights)
        good(folder, 2)
        return run("track", folder / "sequence", "--out", folder / "run", *options, folder=folder / "installed")

    return attempt


def _copy_weights(folder: Path) -> Path:
    """The package of the weights, to be changed: Python finds it before the one that is installed."""
    return shutil.copytree(ROOT / "models" / "sigmaslam_weights", folder / "sigmaslam_weights")


def _flip(name: str, weights: Path) -> None:
    content = bytearray((weights / name).read_bytes())
    middle = len(content) // 2
    content[middle : middle + 100] = bytes(255 - value for value in content[middle : middle + 100])
    (weights / name).write_bytes(content)


def _flip_opened(weights: Path) -> None:
    """In an installation without a compiler: the compiled estimator opens no graph."""
    _flip("pose_predict.onnx", weights)
    script = 'import sys\nsys.modules["sigmaslam.estimation._estimator"] = None\n'
    (weights.parent / "sitecustomize.py").write_text(script)


def _swap(weights: Path) -> None:
    shutil.copy(weights / "verifier.onnx", weights / "features.onnx")


def _cut(weights: Path) -> None:
    (weights / "features.onnx").write_bytes((weights / "features.onnx").read_bytes()[:1000])


_WEIGHT_CASES = [
    Case("weights", name, _weights(change, *KLT), 2, (word, says), slow=name != "100 bytes changed", first=first)
    for name, change, word, says, first in (
        ("100 bytes changed", partial(_flip, "features.onnx"), "features.onnx", "SHA-256", Verdict.SILENT),
        (
            "100 bytes changed in the filter",
            _flip_opened,
            "pose_predict.onnx",
            "SHA-256",
            None,
        ),
        ("another graph under the name", _swap, "features.onnx", "SHA-256", Verdict.LOSS),
        ("cut off", _cut, "features.onnx", "reinstall", None),
        ("missing", lambda weights: (weights / "features.onnx").unlink(), "features.onnx", "reinstall", None),
        (
            "manifest is no JSON",
            lambda weights: (weights / "manifest.json").write_text("{"),
            "manifest.json",
            "reinstall",
            None,
        ),
    )
]

# ---- signals

_ROWS = 4


def _stopped(*numbers: signal.Signals, finish: bool = False) -> Callable[..., Outcome]:
    """Signals to a run in its fifth frame; where it is to be finished, what `sigmaslam report` makes of it."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        process = start(good(folder, 8), folder / "run", rows=_ROWS)
        for number in numbers:
            process.send_signal(number)
            time.sleep(0.1)
        code, output, errors = end(process)
        return run("report", folder / "run") if finish else Outcome(code, one_line(output, errors))

    return attempt


def _run_script(folder: Path, script: str, *arguments: str) -> Outcome:
    """`track` in a process in which a script ran first."""
    done = subprocess.run(
        [sys.executable, "-c", f"{script}\nfrom sigmaslam.cli import main\nmain()\n", "track"]
        + [str(folder / "sequence"), "--out", str(folder / "run"), *KLT, *arguments],
        env={**environment(), "COLUMNS": "4000"},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    return Outcome(done.returncode, one_line(done.stdout, done.stderr))


# What a run writes before its first frame fits.
_FULL_DISK = """
import resource
from sigmaslam.run_record.run_folder import RunWriter
begin = RunWriter.__init__
def fill(*arguments):
    begin(*arguments)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
RunWriter.__init__ = fill
"""
_NO_MEMORY = """
from sigmaslam.slam.tracker import StereoTracker
step, done = StereoTracker.step, []
def fail(*arguments):
    done.append(1)
    if len(done) > 4:
        raise MemoryError
    return step(*arguments)
StereoTracker.step = fail
"""
_SMALL_MEMORY = """
import resource
from sigmaslam.run_record.run_folder import RunWriter
begin = RunWriter.__init__
def fill(*arguments):
    begin(*arguments)
    used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 2_000_000, used + 2_000_000))
RunWriter.__init__ = fill
"""


def _full_disk(folder: Path, run: Runner) -> Outcome:
    good(folder)
    return _run_script(folder, _FULL_DISK)


def _finished_on_a_disk_with_room(folder: Path, run: Runner) -> Outcome:
    good(folder)
    _run_script(folder, _FULL_DISK)
    return run("report", folder / "run")


def _without_memory(script: str) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder)
        return _run_script(folder, script)

    return attempt


def _two_runs(folder: Path, run: Runner) -> Outcome:
    """A second run into the folder of one that goes on."""
    process = start(good(folder), folder / "run", rows=_ROWS)
    outcome = track(folder, run)
    process.terminate()
    end(process)
    return outcome


def _finish_while_it_runs(folder: Path, run: Runner) -> Outcome:
    process = start(good(folder), folder / "run", rows=_ROWS)
    outcome = run("report", folder / "run")
    process.terminate()
    end(process)
    return outcome


def _closed_pipe(folder: Path, run: Runner) -> Outcome:
    """As `sigmaslam track ... | true`."""
    good(folder)
    reader, writer = os.pipe()
    os.close(reader)
    command = command_line("track", folder / "sequence", "--out", folder / "run", *KLT)
    done = subprocess.run(
        command, env=environment(), stdout=writer, stderr=subprocess.PIPE, text=True, check=False, timeout=120
    )
    os.close(writer)
    return Outcome(done.returncode, one_line(done.stderr))


_SIGNAL_CASES = [
    Case("signals", "SIGTERM", _stopped(signal.SIGTERM), 143, ("Stopped",), poses=_ROWS, slow=True, first=Verdict.LOSS),
    Case("signals", "SIGHUP", _stopped(signal.SIGHUP), 129, ("Stopped",), poses=_ROWS, slow=True, first=Verdict.LOSS),
    Case(
        "signals",
        "Ctrl-C",
        _stopped(signal.SIGINT),
        130,
        ("Stopped",),
        poses=_ROWS,
        right=True,
        slow=True,
        first=Verdict.GOOD,
    ),
    Case(
        "signals",
        "Ctrl-C three times",
        _stopped(*[signal.SIGINT] * 3),
        130,
        ("Stopped",),
        poses=_ROWS,
        right=True,
        first=Verdict.LOSS,
        slow=True,
    ),
    Case(
        "signals",
        "SIGTERM, then SIGHUP",
        _stopped(signal.SIGTERM, signal.SIGHUP),
        143,
        ("Stopped",),
        poses=_ROWS,
        slow=True,
    ),
    Case(
        "signals",
        "kill -9, then finish",
        _stopped(signal.SIGKILL, finish=True),
        0,
        ("3 of 4 frames tracked",),
        poses=_ROWS,
        right=True,
        slow=True,
        first=Verdict.LOSS,
    ),
    Case("signals", "a second run into the folder", _two_runs, 2, ("run", "--out"), slow=True, first=Verdict.GOOD),
    Case("signals", "finish while the run goes on", _finish_while_it_runs, 2, ("still goes on",), slow=True),
    Case("signals", "output into a closed pipe", _closed_pipe, 1, poses=6, right=True, slow=True),
    Case(
        "disk",
        "full in the midst of a run",
        _full_disk,
        2,
        ("poses.partial", "make room", "sigmaslam report"),
        slow=True,
        first=Verdict.LOSS,
    ),
    Case(
        "disk",
        "full, then finish",
        _finished_on_a_disk_with_room,
        0,
        ("frames tracked",),
        poses=5,
        right=True,
        slow=True,
        first=Verdict.LOSS,
    ),
    Case(
        "memory",
        "none left in the midst of a run",
        _without_memory(_NO_MEMORY),
        2,
        ("memory",),
        poses=4,
        right=True,
        slow=True,
    ),
    Case("memory", "2 MB left when a run begins", _without_memory(_SMALL_MEMORY), 2, ("memory",), slow=True),
]

# ---- calls from Python


@cache
def _tracker() -> StereoTracker:
    return StereoTracker(open_sequence(DEMO).camera, "klt")


@cache
def _pair() -> tuple[np.ndarray, np.ndarray]:
    frame = next(iter(open_sequence(DEMO).frames()))
    return frame.left, frame.right


def _step(change: Callable[[np.ndarray], object], timestamp: object = 0.0) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        left, right = _pair()
        return call(lambda: _tracker().step(change(left), right, timestamp))  # type: ignore[arg-type]

    return attempt


def _call(action: Callable[[], object]) -> Callable[..., Outcome]:
    return lambda folder, run: call(action)


def _estimates(exchange: bool, dark: int) -> Callable[..., Outcome]:
    """What is said of the frames of a new tracker."""

    def action() -> str:
        sequence = open_sequence(DEMO)
        tracker = StereoTracker(sequence.camera, "klt")
        words = []
        for frame, k in zip(sequence.frames(), range(4), strict=False):
            pair = (frame.right, frame.left) if exchange else (frame.left, frame.right)
            estimate = tracker.step(*((0 * each if k < dark else each) for each in pair), frame.timestamp)
            sigma = "infinite" if np.isinf(np.diag(estimate.covariance)).all() else "finite"
            words.append(f"{estimate.status} {sigma} {estimate.belief:.0f}")
        return ", ".join(words)

    return _call(action)


def _read_only(folder: Path, run: Runner) -> Outcome:
    """Images that may not be written, and that lie scattered in memory."""
    frames = [frame for frame, _ in zip(open_sequence(DEMO).frames(), range(3), strict=False)]
    tracker = StereoTracker(open_sequence(DEMO).camera, "klt")

    def action() -> str:
        for frame in frames:
            left, right = (np.asfortranarray(each) for each in (frame.left, frame.right))
            left.flags.writeable = right.flags.writeable = False
            status = tracker.step(left, right, frame.timestamp).status
        return status

    return call(action)


_NO_POSE = "starting infinite 0"
_API_CASES = [
    *(
        Case("Python", name, attempt, 2, says, first=first)
        for name, attempt, says, first in (
            ("colour image", _step(lambda image: np.dstack([image] * 3)), ("left image", "BGR2GRAY"), Verdict.LOSS),
            ("float image", _step(lambda image: image / 255.0), ("float64", "uint8"), Verdict.LOSS),
            ("uint16 image", _step(lambda image: image.astype(np.uint16)), ("uint16", "uint8"), Verdict.LOSS),
            ("list as image", _step(lambda image: image[:2].tolist()), ("list",), Verdict.LOSS),
            ("no image", _step(lambda image: None), ("NoneType", "imread"), Verdict.LOSS),
            ("image of another size", _step(lambda image: image[:50]), ("320x50", "320x240"), None),
            ("time is not a number", _step(lambda image: image, float("nan")), ("timestamp", "nan"), Verdict.LOSS),
            ("time is text", _step(lambda image: image, "now"), ("timestamp", "now"), None),
            ("name of a file as camera", _call(lambda: StereoTracker("stereo.yaml")), ("from_yaml",), Verdict.LOSS),  # type: ignore[arg-type]
            (
                "unknown front-end",
                _call(lambda: StereoTracker(open_sequence(DEMO).camera, "best")),
                ("best", "klt"),
                None,
            ),
            ("match_images of nothing", _call(lambda: sigmaslam.match_images(None, None)), ("NoneType",), None),  # type: ignore[arg-type]
        )
    ),
    Case("Python", "eyes exchanged", _estimates(True, 0), 0, (", ".join([_NO_POSE] * 4),), first=Verdict.SILENT),
    Case("Python", "dark at first", _estimates(False, 3), 0, (", ".join([_NO_POSE] * 3),), first=Verdict.SILENT),
    Case("Python", "images that may not be written", _read_only, 0, ("tracking",)),
]


def _short_run(folder: Path, run: Runner) -> Outcome:
    """The verdict on the calibration from a few frames."""
    good(folder, 3)
    return track(folder, run)


def _camera(folder: Path, run: Runner) -> Outcome:
    """Cameras that are not there."""
    from tests.support.calibration_yaml import write_calibration

    write_calibration(open_sequence(DEMO).camera, folder / "stereo.yaml")
    with mock.patch.dict(os.environ, {"OPENCV_LOG_LEVEL": "SILENT"}):
        return run(
            "track",
            "--camera",
            "/dev/video97,/dev/video98",
            "--calibration",
            folder / "stereo.yaml",
            "--out",
            folder / "run",
        )


_OTHER_CASES = [
    Case(
        "verdict",
        "three frames",
        _short_run,
        0,
        ("too early to say",),
        ("calibrate again",),
        poses=3,
        right=True,
        first=Verdict.SILENT,
    ),
    Case("cameras", "no camera there", _camera, 2, ("/dev/video97",), first=Verdict.GOOD),
]

PROCESS_CASES = [*_WEIGHT_CASES, *_SIGNAL_CASES, *_API_CASES, *_OTHER_CASES]
