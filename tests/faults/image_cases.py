"""Faults of the rig and of image files."""

from __future__ import annotations

import os
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from tests.faults.case import Case, Outcome, Runner, Verdict
from tests.faults.inputs import FRAMES, good, track, track_injected
from tests.support.injected_faults import (
    FAULTS,
    RECTIFIED_FAULTS,
    WIDE_FAULTS,
    Fault,
    of_both,
    of_images,
    scaled_baseline,
)

LEFT, RIGHT = "image_0", "image_1"
_KITTI = "kitti_raw_0926_0039_a"

# Of the faults of the rig: those with which a run goes on, and is right but for what the warning says.
_GOES_ON = {
    "right eye late",
    "right eye early",
    "baseline in mm",
    "baseline in cm",
    "baseline of a micrometre",
    "intrinsics of twice the size",
    "intrinsics of half the size",
    "focal length in mm",
    "distortion of rectified images",
    "eyes exchanged in mid-run",
}
# Those that rows of matches between the eyes show, and correct.
_CORRECTED = {
    *("rows off by 3", "rows off by -3", "turned by pitch 2", "turned by roll 1", "zoomed by 3 %"),
    *("turned by yaw 5", "turned by yaw -5"),
}
_FIRST = {
    **dict.fromkeys(
        (
            *("eyes exchanged", "rows off by 3", "turned by yaw 5", "both eyes mirrored", "baseline in mm"),
            *("baseline in cm", "baseline of a micrometre", "intrinsics of twice the size", "times in ms"),
            *("times in us", "right eye late"),
        ),
        Verdict.SILENT,
    ),
    **dict.fromkeys(
        ("one image for both eyes", "vertical rig", "distortion of rectified images", "cx and cy exchanged"),
        Verdict.UNCLEAR,
    ),
    "times in ns": Verdict.LOSS,
}
# Checked by default; the checks themselves are tested with all of them.
_QUICK = {
    *("times in us", "times in ns"),
    "an image that is cut off",
}


def _rig_case(name: str, fault: Fault) -> Case:
    refused = name in ("times in ms", "times in us", "times in ns")
    return Case(
        "rig",
        name,
        track_injected(fault),
        2 if refused else 0 if name in _GOES_ON | _CORRECTED else 3,
        ("times.txt", fault.word) if refused else (fault.word,),
        right=name in _CORRECTED,
        slow=name not in _QUICK,
        first=_FIRST.get(name),
    )


def _of_kitti(name: str, fault: Fault) -> Case:
    def attempt(folder: Path, run: Runner) -> Outcome:
        data = Path(os.environ["SIGMASLAM_DATA"]).resolve()
        return track_injected(fault, source=lambda: data / _KITTI, long=True)(folder, run)

    code = 0 if name in _CORRECTED else 3
    return Case("rig", f"{name} (KITTI)", attempt, code, (fault.word,), slow=True, data=_KITTI)


# No image shows the first and the last: known limits. Turns of the camera show the focal length.
_HARD_TO_SEE = {
    "half of the baseline": (Fault("", "", camera=scaled_baseline(0.5)), Verdict.SILENT),
    "focal length off by 20 %": (
        Fault("", "", camera=of_both(lambda model: {"fx": 1.2 * model.fx, "fy": 1.2 * model.fy})),
        Verdict.GOOD,
    ),
    "both eyes upside down": (
        Fault("", "", of_images(lambda left, right: (right[::-1, ::-1], left[::-1, ::-1]))),
        Verdict.SILENT,
    ),
}


def _black(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return 0 * left, 0 * right


def _dark_until(count: int, k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (0 * left, 0 * right) if k < count else (left, right)


def _dark_between(first: int, last: int, k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return (0 * left, 0 * right) if first <= k <= last else (left, right)


def _changed(change: Callable[..., tuple[np.ndarray, np.ndarray]], count: int = FRAMES) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, count, change)
        return track(folder, run)

    return attempt


def _fields(number: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Even and odd rows of two moments: every other row is moved as the next frame moves."""
    odd = np.arange(len(left))[:, None] % 2
    return np.where(odd, np.roll(left, 3, axis=1), left), np.where(odd, np.roll(right, 3, axis=1), right)


def _panel(number: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Text below the image of an endoscope."""
    panel = np.full_like(left[200:], 30)
    cv2.putText(panel, "Name: DOE  12 mm  f 30  10:31", (4, 25), cv2.FONT_HERSHEY_SIMPLEX, 0.6, 200)
    return np.vstack([left[:200], panel]), np.vstack([right[:200], panel])


def _with_file(break_file: Callable[[Path], object], number: int = 3, eye: str = LEFT) -> Callable[..., Outcome]:
    """One image of the sequence is replaced."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder)
        break_file(folder / "sequence" / eye / f"{number:06d}.png")
        return track(folder, run)

    return attempt


def _with_folder(break_folder: Callable[[Path], object], count: int = FRAMES) -> Callable[..., Outcome]:
    """The folder of the sequence is changed."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        break_folder(good(folder, count))
        return track(folder, run)

    return attempt


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:5000])


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    for place in range(len(content) // 2, len(content) // 2 + 200):
        content[place] ^= 0xFF
    path.write_bytes(content)


def _replace_by(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def replace(path: Path) -> None:
        path.unlink()
        make(path)

    return replace


def _write_header(width: int, height: int, path: Path) -> None:
    """A PNG of this size in a few bytes."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 10)) + chunk(b"IEND", b""))


def _resize(path: Path) -> None:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    cv2.imwrite(str(path), cv2.resize(image, (160, 120)))


def _recode(change: Callable[[np.ndarray], np.ndarray], folder: Path) -> None:
    for path in [*folder.glob("image_0/*.png"), *folder.glob("image_1/*.png")]:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        cv2.imwrite(str(path), change(image))


def _every(pattern: str, break_file: Callable[[Path], object], folder: Path) -> None:
    for path in sorted(folder.glob(pattern)):
        break_file(path)


def _rename(pattern: str, offset: int, folder: Path) -> None:
    for path in sorted(folder.glob(pattern), reverse=True):
        path.rename(path.with_stem(f"{int(path.stem) + offset:06d}"))


def _empty(folder: Path) -> None:
    _every("image_?/*.png", Path.unlink, folder)


def _same_folder(folder: Path) -> None:
    shutil.rmtree(folder / RIGHT)
    shutil.copytree(folder / LEFT, folder / RIGHT)


_FILES = [
    ("an image that is cut off", _with_file(_cut), 0, ("000003.png", "1 skipped"), 5),
    ("200 bytes changed in an image", _with_file(_flip), 0, ("000003.png", "1 skipped"), 5),
    ("an empty image", _with_file(lambda path: path.write_bytes(b"")), 0, ("000003.png", "1 skipped"), 5),
    ("text in place of an image", _with_file(lambda path: path.write_text("no image")), 0, ("000003.png",), 5),
    ("an unreadable right image", _with_file(_cut, eye=RIGHT), 0, ("000003.png", "1 skipped"), 5),
    ("a header of 30,000 x 30,000", _with_file(partial(_write_header, 30_000, 30_000)), 0, ("000003.png",), 5),
    ("a header of 2^31 - 1 pixels' width", _with_file(partial(_write_header, 2**31 - 1, 9)), 0, ("000003.png",), 5),
    ("a named pipe as image", _with_file(_replace_by(os.mkfifo)), 0, ("000003.png", "1 skipped"), 5),
    ("/dev/zero as image", _with_file(_replace_by(lambda path: path.symlink_to("/dev/zero"))), 0, ("000003.png",), 5),
    ("a link to itself as image", _with_file(_replace_by(lambda path: path.symlink_to(path))), 0, ("000003.png",), 5),
    ("a folder as image", _with_file(_replace_by(Path.mkdir)), 0, ("000003.png",), 5),
    ("one image of another size", _with_file(_resize), 0, ("000003.png", "160x120", "1 skipped"), 5),
    ("first image unreadable", _with_file(_cut, number=0), 0, ("000000.png", "1 skipped"), 5),
]

IMAGE_CASES = [
    *(_rig_case(name, fault) for name, fault in {**FAULTS, **RECTIFIED_FAULTS}.items()),
    Case(
        "rig",
        "eyes exchanged (learned features)",
        track_injected(FAULTS["eyes exchanged"], "--frontend", "learned"),
        3,
        (FAULTS["eyes exchanged"].word,),
        poses=0,
        slow=True,
        first=Verdict.SILENT,
    ),
    *(
        _of_kitti(name, {**FAULTS, **WIDE_FAULTS}[name])
        for name in ("eyes exchanged", "cx and cy exchanged", "right eye late", "rows off by 3")
    ),
    *(
        Case(
            "rig",
            name,
            track_injected(fault, long=True),
            0,
            ("calibrate again",),
            slow=True,
            first=Verdict.SILENT,
            expected=expected,
        )
        for name, (fault, expected) in _HARD_TO_SEE.items()
    ),
    Case("images", "all black", _changed(_black), 3, ("lens cap",), poses=0, first=Verdict.SILENT),
    Case(
        "images",
        "dark at first",
        _changed(partial(_dark_until, 3), 8),
        0,
        ("The world is the left camera of frame 3",),
        poses=5,
        right=True,
        first=Verdict.SILENT,
    ),
    Case(
        "images",
        "dark for two frames",
        _changed(partial(_dark_between, 3, 4), 8),
        0,
        ("2 lost",),
        poses=8,
        right=True,
        slow=True,
    ),
    Case(
        "images",
        "one pair alone",
        _with_folder(lambda folder: None, 1),
        3,
        ("give two or more",),
        poses=0,
        first=Verdict.UNCLEAR,
    ),
    *(
        Case("images", name, attempt, code, says, poses=poses, right=True, slow=name not in _QUICK)
        for name, attempt, code, says, poses in _FILES
    ),
    Case(
        "images",
        "every image unreadable",
        _with_folder(partial(_every, "image_0/*.png", _cut)),
        2,
        ("image_0",),
    ),
    Case("images", "folders without images", _with_folder(_empty), 2, ("image_0",)),
    Case("images", "no right folder", _with_folder(lambda folder: shutil.rmtree(folder / RIGHT)), 2, ("image_1",)),
    Case(
        "images",
        "one left image too few",
        _with_folder(lambda folder: (folder / LEFT / "000002.png").unlink()),
        2,
        ("5", "6"),
    ),
    Case(
        "images",
        "right images of other numbers",
        _with_folder(partial(_rename, "image_1/*.png", 1)),
        2,
        ("000000", "000006"),
    ),
    Case(
        "images",
        "left folder copied as right",
        _with_folder(_same_folder),
        3,
        ("both cameras",),
        poses=0,
        slow=True,
        first=Verdict.UNCLEAR,
    ),
    Case(
        "images",
        "16 bits a pixel",
        _with_folder(partial(_recode, lambda image: image.astype(np.uint16) * 256)),
        0,
        ("16",),
        poses=6,
        right=True,
    ),
    Case(
        "images",
        "colour",
        _with_folder(partial(_recode, lambda image: cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))),
        0,
        ("grey",),
        poses=6,
        right=True,
        slow=True,
    ),
    Case("images", "interlaced", _changed(_fields), 0, ("deinterlace",)),
    Case("images", "a panel of text below all", _changed(_panel), 0, ("0 skipped",), poses=6, right=True),
    Case(
        "images",
        "every image of half the size",
        _with_folder(partial(_recode, lambda image: image[::2, ::2])),
        0,
        ("multiply fx, fy, cx, cy by 0.5",),
        slow=True,
    ),
]
