"""Sequences with faults on disk: parts of the demo and of real data."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers import StereoFrame, open_sequence
from tests.faults.case import DEMO, Outcome, Runner
from tests.support.calibration_yaml import write_calibration
from tests.support.demo_parts import Pair, copy_frames
from tests.support.injected_faults import Fault

FRAMES = 6
# Where the demo moves fast enough for a delay to show; the delay costs a frame.
_FAST, _LONG = slice(14, 14 + FRAMES + 1), slice(5, 25)
KLT = ("--frontend", "klt")


def good(
    folder: Path, count: int = FRAMES, change: Callable[[int, np.ndarray, np.ndarray], Pair] | None = None
) -> Path:
    """The first frames of the demo, or of what a change makes of them."""
    return copy_frames(DEMO, folder / "sequence", count, change)


def track(folder: Path, run: Runner, *options: str | Path, source: Path | None = None) -> Outcome:
    """`sigmaslam track` of the sequence in the folder."""
    return run("track", source or folder / "sequence", "--out", folder / "run", *(options or KLT))


@cache
def _read(source: Path) -> tuple[StereoCamera, list[StereoFrame]]:
    sequence = open_sequence(source)
    return sequence.camera, [frame for frame, _ in zip(sequence.frames(), range(_LONG.stop), strict=False)]


def inject(fault: Fault, folder: Path, source: Path = DEMO, long: bool = False) -> tuple[Path, Path]:
    """Writes a sequence with a fault, of seven frames, or twenty.

    Returns:
        Its folder, and its calibration.
    """
    camera, frames = _read(source)
    changed = fault.frames(frames[_LONG if long else _FAST], camera)
    sequence = folder / "sequence"
    for name, eye in (("left", "left"), ("right", "right")):
        (sequence / name).mkdir(parents=True)
        for k, frame in enumerate(changed):
            cv2.imwrite(str(sequence / name / f"{k:06d}.png"), getattr(frame, eye))
    np.savetxt(sequence / "times.txt", [frame.timestamp for frame in changed], "%.9f")
    write_calibration(fault.camera(camera), folder / "stereo.yaml")
    return sequence, folder / "stereo.yaml"


def track_injected(
    fault: Fault, *options: str, source: Callable[[], Path] = lambda: DEMO, long: bool = False
) -> Callable[..., Outcome]:
    """An attempt that tracks a sequence with a fault."""

    def run_case(folder: Path, run: Runner) -> Outcome:
        sequence, calibration = inject(fault, folder, source(), long)
        return track(folder, run, "--calibration", calibration, *(options or KLT), source=sequence)

    return run_case


def edit(path: Path, change: Callable[[str], str]) -> None:
    """Changes a text file."""
    path.write_text(change(path.read_text()))
