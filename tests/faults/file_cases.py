"""Faults of maps, truths, sensors' tables, bags, settings, folders and names."""

from __future__ import annotations

import io
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from tempfile import mkdtemp

import cv2
import numpy as np

from sigmaslam.geometry.se3 import matrix_to_quaternion, se3_inverse
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam_evaluation.truth_conventions import R_BODY_CAMERA, TIME_UNITS
from tests.faults.case import DEMO, Case, Outcome, Runner, Verdict
from tests.faults.inputs import KLT, good, track
from tests.support import tracked
from tests.support.calibration_yaml import write_calibration
from tests.support.demo_parts import copy_frames
from tests.support.small_bags import write_bag
from tests.support.videos import write_video


@cache
def good_run() -> Path:
    """A run of some frames of the demo, with a map; removed when Python ends."""
    import atexit

    folder = Path(mkdtemp(prefix="sigmaslam-faults-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    tracked.track(copy_frames(DEMO, folder / "sequence", 14), folder / "run", "klt")
    return folder / "run"


# ---- maps


def _mapped(change: Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]) -> Callable[..., Outcome]:
    """Tracks in a map whose arrays are changed."""

    def write(path: Path) -> None:
        with np.load(good_run() / "map.npz") as arrays:
            np.savez_compressed(path, **change(dict(arrays)))

    return _in_map(write)


def _in_map(write: Callable[[Path], object]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, 3)
        write(folder / "map.npz")
        return track(folder, run, "--map", folder / "map.npz", *KLT)

    return attempt


def _set(name: str, change: Callable[[np.ndarray], np.ndarray], arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {**arrays, name: change(arrays[name])}


def _without(name: str, arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {key: value for key, value in arrays.items() if key != name}


def _save_array(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.zeros(3))


def _write_huge(path: Path) -> None:
    """An array whose header states 20 GB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (2_500_000_000,)})
    _write_with(path, "keyframe_poses.npy", header.getvalue())


def _write_bomb(path: Path) -> None:
    """An array of 1 GB that is packed into a MB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (1 << 30,)})
    _write_with(path, "keyframe_images.npy", header.getvalue() + bytes(1 << 30))


def _write_pickle(path: Path) -> None:
    packed = io.BytesIO()
    np.save(packed, np.array([pickle], dtype=object)[:0].astype(object), allow_pickle=True)
    _write_with(path, "keyframe_poses.npy", packed.getvalue())


def _write_with(path: Path, name: str, content: bytes) -> None:
    """The good map with another member."""
    with zipfile.ZipFile(good_run() / "map.npz") as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for member in source.namelist():
            archive.writestr(member, content if member == name else source.read(member))


def _cut_map(path: Path) -> None:
    path.write_bytes((good_run() / "map.npz").read_bytes()[:10_000])


def _another_place(folder: Path, run: Runner) -> Outcome:
    """Noise that moves from frame to frame: a place that no map has."""
    texture = np.random.default_rng(0).integers(0, 255, (60, 120)).astype(np.uint8)
    texture = cv2.resize(texture, (960, 480), interpolation=cv2.INTER_CUBIC)

    def change(k: int, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return texture[100:340, 3 * k + 20 : 3 * k + 340], texture[100:340, 3 * k + 30 : 3 * k + 350]

    good(folder, 4, change)
    return track(folder, run, "--map", good_run() / "map.npz", *KLT)


def _map_case(name: str, attempt: Callable[..., Outcome], says: str = "", first: Verdict | None = None) -> Case:
    return Case("map", name, attempt, 2, ("map.npz", says), poses=0, first=first, slow=name != "text")


def _nan_poses(poses: np.ndarray) -> np.ndarray:
    return np.full_like(poses, np.nan)


_MAP_CASES = [
    _map_case("text", _in_map(lambda path: path.write_text("a map")), first=Verdict.UNCLEAR),
    _map_case("a single array", _in_map(_save_array), "npz", Verdict.LOSS),
    _map_case("missing file", _in_map(lambda path: None), "no such file"),
    _map_case("cut off", _in_map(_cut_map)),
    _map_case(
        "poses that are no numbers", _mapped(partial(_set, "keyframe_poses", _nan_poses)), "poses", Verdict.UNCLEAR
    ),
    _map_case(
        "wrong counts", _mapped(partial(_set, "keyframe_counts", lambda counts: counts + 5)), "counts", Verdict.UNCLEAR
    ),
    _map_case(
        "short covariance",
        _mapped(partial(_set, "keyframe_covariance", lambda P: P[:4, :4])),
        "covariance",
        Verdict.LOSS,
    ),
    _map_case(
        "poses of text",
        _mapped(partial(_set, "keyframe_poses", lambda poses: poses.astype(str))),
        "poses",
        Verdict.LOSS,
    ),
    _map_case("negative covariance", _mapped(partial(_set, "keyframe_covariance", lambda P: -P)), "covariance"),
    _map_case("no descriptors", _mapped(partial(_without, "keyframe_descriptors")), "descriptors"),
    _map_case("a header of 20 GB", _in_map(_write_huge), "", Verdict.LOSS),
    _map_case("Python objects inside", _in_map(_write_pickle), "poses"),
    Case("map", "a GB packed into a MB", _in_map(_write_bomb), 2, ("map.npz",), poses=0, slow=True),
    _map_case("of another front-end", _mapped(partial(_set, "frontend", lambda name: np.array("learned"))), "learned"),
    _map_case("of another camera", _mapped(partial(_set, "intrinsics", lambda values: 1.5 * values)), "camera"),
    Case(
        "map",
        "of another place",
        _another_place,
        3,
        ("not found in the map",),
        poses=0,
        first=Verdict.UNCLEAR,
        slow=True,
    ),
]


# ---- truths


def _truth_lines(
    poses: np.ndarray, order: tuple[int, ...] = (0, 1, 2, 3), scale: float = 1.0, unit: float = 1.0
) -> str:
    times = np.loadtxt(good_run() / "times.txt")
    quaternions = matrix_to_quaternion(poses[:, :3, :3])[:, list(order)]
    rows = np.column_stack([times / unit, scale * poses[:, :3, 3], quaternions])
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in rows)


def _truth() -> np.ndarray:
    return read_kitti(DEMO / "poses.txt").poses[:14]


def _body() -> np.ndarray:
    poses = _truth().copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ R_BODY_CAMERA.T
    return poses


def _evaluated(make: Callable[[], str], name: str = "truth.tum") -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        (folder / name).write_text(make())
        return run("evaluate", good_run() / "trajectory.tum", "--truth", folder / name)

    return attempt


def _of_other_run(*files: str) -> Callable[..., Outcome]:
    """Evaluates a copy of the run with these files alone."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        (folder / "other").mkdir()
        for name in files:
            shutil.copy(good_run() / name, folder / "other")
        return run("evaluate", folder / "other", "--truth", DEMO / "poses.txt")

    return attempt


_TRUTH_CASES = [
    *(
        Case("truth", name, _evaluated(make), 0, says, first=first, slow=True)
        for name, make, says, first in (
            ("of a body with x ahead", lambda: _truth_lines(_body()), ("--truth-frame body",), Verdict.SILENT),
            ("T_camera_world", lambda: _truth_lines(se3_inverse(_truth())), ("--truth-inverse",), Verdict.SILENT),
            ("w first", lambda: _truth_lines(_truth(), (3, 0, 1, 2)), ("--truth-quaternion wxyz",), Verdict.SILENT),
            ("millimetres", lambda: _truth_lines(_truth(), scale=1e3), ("--truth-unit mm",), Verdict.SILENT),
            (
                "times in ns",
                lambda: _truth_lines(_truth(), unit=TIME_UNITS["nanoseconds"]),
                ("nanoseconds",),
                Verdict.UNCLEAR,
            ),
            ("times in ms", lambda: _truth_lines(_truth(), unit=TIME_UNITS["milliseconds"]), ("milliseconds",), None),
        )
    ),
    *(
        Case("truth", name, _evaluated(make), 2, ("truth.tum", *says), first=first)
        for name, make, says, first in (
            ("commas", lambda: _truth_lines(_truth()).replace(" ", ", "), ("comma",), Verdict.UNCLEAR),
            ("empty", lambda: "", (), None),
            ("of another time", lambda: _truth_lines(_truth()).replace("\n0.", "\n9."), (), None),
            ("one pose", lambda: _truth_lines(_truth()).splitlines()[0] + "\n", (), None),
            ("seven columns", lambda: "0 1 2 3 4 5 6\n" * 3, ("7",), None),
            ("not a number", lambda: _truth_lines(_truth()).replace("0.", "nan.", 1), (), None),
            ("quaternions of zero", lambda: "0 1 2 3 0 0 0 0\n1 2 3 4 0 0 0 0\n", ("quaternion",), None),
        )
    ),
    Case(
        "truth",
        "of a run without poses",
        _of_other_run("run.json", "frames.csv"),
        2,
        ("none of its frames has a pose",),
    ),
    Case("truth", "of a folder that is no run", _of_other_run(), 2, ("sigmaslam track",)),
    Case(
        "truth",
        "covariance is missing",
        _of_other_run("run.json", "frames.csv", "trajectory.tum"),
        0,
        ("no covariance",),
        slow=True,
    ),
]


# ---- tables of sensors, settings, bags, videos


def _located(text: str) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, 2)
        (folder / "gps.csv").write_text(text)
        return track(folder, run, "--location", folder / "gps.csv", *KLT)

    return attempt


def _configured(text: str) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        good(folder, 2)
        (folder / "settings.yaml").write_text(text)
        return track(folder, run, "--config", folder / "settings.yaml", *KLT)

    return attempt


def _bagged(kind: str, change: Callable[[bytes], bytes]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        path = write_bag(folder / "recorded", kind, (64, 48))
        path.write_bytes(change(path.read_bytes()))
        return track(folder, run, source=path)

    return attempt


def _flip(content: bytes) -> bytes:
    changed = bytearray(content)
    middle = len(changed) // 2
    changed[middle : middle + 50] = bytes(255 - value for value in changed[middle : middle + 50])
    return bytes(changed)


def _video(change: Callable[[bytes], bytes]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        source = folder / "videos"
        source.mkdir()
        for name in ("left", "right"):
            path = write_video(folder / f"{name}.avi", [np.full((240, 320), 90, np.uint8)] * 4, 20.0)
            (source / path.name).write_bytes(change(path.read_bytes()))
        write_calibration(open_sequence(DEMO).camera, folder / "stereo.yaml")
        return track(folder, run, "--calibration", folder / "stereo.yaml", *KLT, source=source)

    return attempt


_HEADER = "timestamp,x,y,z,sigma_position\n"
_TABLE_CASES = [
    *(
        Case("location", name, _located(text), 2, ("gps.csv", *says), first=first, slow=name != "semicolons")
        for name, text, says, first in (
            ("semicolons", _HEADER.replace(",", ";") + "0;0;0;0;1\n", ("comma",), Verdict.UNCLEAR),
            ("no header", "0,0,0,0,1\n0.1,0,0,0,1\n", ("timestamp",), None),
            ("a column is missing", "timestamp,x,y\n0,0,0\n", ("z",), None),
            ("not a number", _HEADER + "0,nan,0,0,1\n0.1,0,0,0,1\n", (), None),
            ("a sigma of zero", _HEADER + "0,0,0,0,0\n0.1,0,0,0,0\n", ("sigma",), None),
            ("backwards", _HEADER + "1,0,0,0,1\n0.1,0,0,0,1\n", (), None),
            ("empty", "", (), None),
        )
    ),
    Case(
        "location",
        "path too short to align",
        _located(_HEADER + "0,0,0,0,1\n0.05,0,0,0,1\n"),
        0,
        ("was not fused",),
        first=Verdict.UNCLEAR,
        slow=True,
    ),
    Case("settings", "unknown name", _configured("windows: 8\n"), 2, ("settings.yaml", "windows")),
    Case("settings", "negative", _configured("window: -1\n"), 2, ("settings.yaml", "window")),
    Case("settings", "text for a number", _configured("window: many\n"), 2, ("settings.yaml", "window", "many")),
    Case("settings", "no YAML", _configured("window: [1\n"), 2, ("settings.yaml",)),
    Case(
        "bags", "no bag", _bagged("bag", lambda content: b"no bag at all"), 2, ("recording.bag",), first=Verdict.UNCLEAR
    ),
    Case(
        "bags", "cut off (ROS 1)", _bagged("bag", lambda content: content[: len(content) // 2]), 2, ("recording.bag",)
    ),
    Case("bags", "cut off (mcap)", _bagged("mcap", lambda content: content[: len(content) // 2]), 2, (".mcap",)),
    Case("bags", "cut off (sqlite)", _bagged("db3", lambda content: content[:3000]), 2, (".db3",)),
    Case(
        "bags",
        "50 bytes changed (mcap)",
        _bagged("mcap", _flip),
        2,
        (".mcap",),
        first=Verdict.UNCLEAR,
        expected=Verdict.UNCLEAR,
        slow=True,
    ),
    Case("videos", "no video", _video(lambda content: b"no video"), 2, ("left.avi",)),
    Case("videos", "cut off", _video(lambda content: content[:300]), 2, ("left.avi",)),
]


# ---- folders and names


def _out(make: Callable[[Path], Path]) -> Callable[..., Outcome]:
    """Tracks into another folder than `run`."""

    def attempt(folder: Path, run: Runner) -> Outcome:
        sequence = good(folder, 2)
        return run("track", sequence, "--out", make(folder), *KLT)

    return attempt


def _full(folder: Path) -> Path:
    (folder / "full").mkdir()
    (folder / "full" / "thesis.tex").write_text("mine")
    return folder / "full"


def _file(folder: Path) -> Path:
    (folder / "file").write_text("mine")
    return folder / "file"


def _named(name: bytes) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        source = Path(os.fsdecode(os.fsencode(folder) + b"/" + name))
        good(folder, 3).rename(source)
        return track(folder, run, source=source)

    return attempt


def _source(make: Callable[[Path], Path]) -> Callable[..., Outcome]:
    def attempt(folder: Path, run: Runner) -> Outcome:
        return track(folder, run, source=make(folder))

    return attempt


def _link_to_itself(folder: Path) -> Path:
    (folder / "loop").symlink_to(folder / "loop")
    return folder / "loop"


_FOLDER_CASES = [
    Case("folders", "out holds something", _out(_full), 2, ("full", "--out")),
    Case("folders", "out is a file", _out(_file), 2, ("file", "--out")),
    Case("folders", "out is the input", _out(lambda folder: folder / "sequence"), 2, ("sequence", "--out")),
    Case("folders", "out below a file", _out(lambda folder: _file(folder) / "run"), 2, ("file", "--out"), slow=True),
    Case("folders", "out in /proc", _out(lambda folder: Path("/proc/run")), 2, ("/proc/run", "--out"), slow=True),
    Case("folders", "a name of 300 letters", _out(lambda folder: folder / ("a" * 300)), 2, ("aaa", "--out")),
    Case("folders", "input does not exist", _source(lambda folder: folder / "missing"), 2, ("missing",)),
    Case("folders", "input is a text file", _source(_file), 2, ("file",)),
    Case("folders", "input is empty", _source(lambda folder: folder), 2, ("no stereo sequence",)),
    Case("folders", "input links to itself", _source(_link_to_itself), 2, ("loop",)),
    Case(
        "folders",
        "spaces and brackets in names",
        _named(b"my [bold]drive[b] 1"),
        0,
        ("tracked",),
        poses=3,
        right=True,
        slow=True,
    ),
    Case("folders", "a line end in a name", _named(b"two\nlines"), 0, ("tracked",), poses=3, right=True, slow=True),
    Case(
        "folders",
        "bytes in a name that are no text",
        _named(b"in\xff"),
        0,
        ("tracked",),
        poses=3,
        right=True,
        first=Verdict.LOSS,
    ),
]

FILE_CASES = [*_MAP_CASES, *_TRUTH_CASES, *_TABLE_CASES, *_FOLDER_CASES]
