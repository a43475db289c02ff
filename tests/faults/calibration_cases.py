"""Faults of calibrations and time stamps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from sigmaslam.readers import open_sequence
from tests.faults.case import DEMO, Case, Outcome, Runner, Verdict
from tests.faults.inputs import KLT, edit, good, track
from tests.support.calibration_forms import raw_rig, write_kalibr
from tests.support.calibration_yaml import write_calibration

_BOMB = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{after}: &{after} [{','.join(['*' + before] * 9)}]\n"
    for before, after in zip("abcdefgh", "bcdefghi", strict=True)
)


def _calibrated(change: Callable[[str], str] | bytes, count: int = 2) -> Callable[..., Outcome]:
    """Tracks with a changed calibration YAML."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, count)
        path = folder / "stereo.yaml"
        write_calibration(open_sequence(DEMO).camera, path)
        if isinstance(change, bytes):
            path.write_bytes(change)
        else:
            edit(path, change)
        return track(folder, run, "--calibration", path, *KLT)

    return attempt


def _replaced(old: str, new: str, text: str) -> str:
    assert old in text
    return text.replace(old, new)


def _lines(text: str) -> str:
    """The second definition of the pose."""
    return text + "T_left_right:\n- [1, 0, 0, 0.2]\n- [0, 1, 0, 0]\n- [0, 0, 1, 0]\n- [0, 0, 0, 1]\n"


def _bomb(key: str, text: str) -> str:
    return f"{_BOMB}{text.replace(key, key + ' *i #', 1)}"


def _other_form(write: Callable[[Path], Path]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, 2)
        return track(folder, run, "--calibration", write(folder), *KLT)

    return attempt


def _write(name: str, text: str, folder: Path) -> Path:
    (folder / name).write_text(text)
    return folder / name


def _kitti(change: Callable[[str], str]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        edit(good(folder, 2) / "calib.txt", change)
        return track(folder, run)

    return attempt


def _kalibr_of_a_fisheye(folder: Path) -> Path:
    path = write_kalibr(raw_rig("radtan"), folder)
    edit(path, lambda text: text.replace("camera_model: pinhole", "camera_model: omni"))
    return path


_EYES = "opencv_matrix_in_other_form: !!opencv-matrix\n   rows: 1\n   cols: 1\n   dt: d\n   data: [ 1. ]\n"
_GOOD_LINE = "T_left_right:"

_YAML = [
    ("a key twice", _lines, ("stereo.yaml", "T_left_right", "twice"), Verdict.SILENT),
    ("a key is missing", lambda text: text.replace("fx: ", "f: "), ("stereo.yaml", "fx"), None),
    ("a negative focal length", partial(_replaced, "fx: 230.0", "fx: -230.0"), ("stereo.yaml", "fx", "-230"), None),
    (
        "a focal length that is no number",
        partial(_replaced, "fx: 230.0", "fx: .nan"),
        ("stereo.yaml", "fx", "nan"),
        None,
    ),
    ("a decimal comma", partial(_replaced, "fx: 230.0", "fx: '230,0'"), ("stereo.yaml", "fx", "230,0"), None),
    (
        "another lens model",
        partial(_replaced, "distortion_model: none", "distortion_model: omni"),
        ("omni", "radtan"),
        None,
    ),
    (
        "a matrix that is no rotation",
        partial(_replaced, "[0.0, 1.0, 0.0, 0.0]", "[0.0, 2.0, 0.0, 0.0]"),
        ("T_left_right",),
        None,
    ),
    ("eyes in one place", partial(_replaced, "0.11", "0.0"), ("stereo.yaml", "baseline"), Verdict.UNCLEAR),
    ("exchanged pose of the right eye", partial(_replaced, "0.11", "-0.11"), ("stereo.yaml", "-0.11"), None),
    ("another image size", partial(_replaced, "width: 320", "width: 640"), ("640x240", "320x240"), None),
    ("20,000 brackets", lambda text: "a: " + "[" * 20_000, ("stereo.yaml",), Verdict.LOSS),
    (
        "an integer of 5,000 digits",
        partial(_replaced, "width: 320", "width: " + "9" * 5_000),
        ("stereo.yaml",),
        Verdict.LOSS,
    ),
    ("a date that does not exist", partial(_replaced, "fx: 230.0", "fx: 2001-02-31"), ("stereo.yaml",), Verdict.LOSS),
    ("a bomb of references in T_left_right", partial(_bomb, "T_left_right:"), ("stereo.yaml",), Verdict.LOSS),
    ("a bomb of references in left", partial(_bomb, "left:"), ("stereo.yaml",), Verdict.LOSS),
    (
        "a Python object",
        partial(_replaced, "fx: 230.0", "fx: !!python/object/apply:os.system ['true']"),
        ("stereo.yaml",),
        None,
    ),
    ("tabs", partial(_replaced, "left:", "left:\n\t"), ("stereo.yaml",), None),
    ("an empty file", lambda text: "", ("stereo.yaml",), None),
    ("a list", lambda text: "- 1\n- 2\n", ("stereo.yaml",), None),
]


def _timed(change: Callable[[np.ndarray], np.ndarray | str], count: int = 6) -> Callable[..., Outcome]:
    """Tracks with changed time stamps."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        path = good(folder, count) / "times.txt"
        times = change(np.loadtxt(path))
        path.write_text(times if isinstance(times, str) else "".join(f"{time:.9f}\n" for time in times))
        return track(folder, run)

    return attempt


def _put(value: float, times: np.ndarray) -> np.ndarray:
    times[3] = value
    return times


CALIBRATION_CASES = [
    *(
        Case("calibration", name, _calibrated(change), 2, says, poses=0, first=first)
        for name, change, says, first in _YAML
    ),
    Case(
        "calibration",
        "principal point outside of the image",
        _calibrated(partial(_replaced, "cx: 159.5", "cx: 900.0")),
        0,
        ("principal point", "900.0"),
        first=Verdict.UNCLEAR,
        slow=True,
    ),
    Case("calibration", "bytes that are no text", _calibrated(bytes(range(256))), 2, ("stereo.yaml",)),
    Case(
        "calibration",
        "file does not exist",
        _other_form(lambda folder: folder / "missing.yaml"),
        2,
        ("missing.yaml",),
    ),
    Case(
        "calibration",
        "Kalibr's of an omnidirectional camera",
        _other_form(_kalibr_of_a_fisheye),
        2,
        ("camchain.yaml", "omni"),
        first=Verdict.UNCLEAR,
    ),
    Case(
        "calibration",
        "OpenCV's of something else",
        _other_form(partial(_write, "stereo.yml", f"%YAML:1.0\n---\n{_EYES}")),
        2,
        ("stereo.yml",),
        first=Verdict.UNCLEAR,
    ),
    Case(
        "calibration",
        "one of two files",
        _other_form(partial(_write, "left.yaml", "image_width: 320\nimage_height: 240\ncamera_name: left\n")),
        2,
        ("left.yaml",),
    ),
    Case(
        "calibration",
        "calib.txt with a number too few",
        _kitti(lambda text: text.replace(" -2.530000000000e+01", "")),
        2,
        ("calib.txt", "P1"),
    ),
    Case(
        "calibration",
        "calib.txt with one camera",
        _kitti(lambda text: text.splitlines()[0] + "\n"),
        2,
        ("calib.txt", "P1"),
    ),
    Case(
        "calibration",
        "calib.txt with text",
        _kitti(lambda text: text.replace("2.300000000000e+02", "wide")),
        2,
        ("calib.txt", "wide"),
    ),
    Case(
        "calibration",
        "calib.txt with exchanged cameras",
        _kitti(lambda text: text.replace("-2.53", "2.53")),
        2,
        ("calib.txt", "swapped"),
    ),
    Case("time stamps", "backwards", _timed(lambda times: times[::-1].copy()), 2, ("times.txt",)),
    Case("time stamps", "one twice", _timed(lambda times: _put(times[2], times)), 2, ("times.txt",)),
    Case("time stamps", "not a number", _timed(lambda times: _put(np.nan, times)), 2, ("times.txt",)),
    Case("time stamps", "infinite", _timed(lambda times: _put(np.inf, times)), 2, ("times.txt",)),
    Case("time stamps", "one too few", _timed(lambda times: times[:-1]), 2, ("times.txt", "5", "6")),
    Case("time stamps", "one too many", _timed(lambda times: np.r_[times, 1.0]), 0, poses=6, right=True, slow=True),
    Case("time stamps", "text", _timed(lambda times: "now\n" * 6), 2, ("times.txt", "now")),
    Case("time stamps", "none", _timed(lambda times: ""), 2, ("times.txt",)),
    Case(
        "time stamps",
        "a pause of 1,000 s",
        _timed(lambda times: np.r_[times[:3], times[3:] + 1000.0]),
        0,
        ("tracked",),
        poses=6,
        slow=True,
    ),
]
