"""Every reader with small real files, for the fuzz tests and for `python -m tests.fuzz`."""

from __future__ import annotations

import io
import json
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from random import Random

import cv2
import numpy as np

from sigmaslam.bodies.object_region import read_region
from sigmaslam.bundle_adjustment.track_file import read_tracks
from sigmaslam.calibration_files.euroc_calibration import read_sensors
from sigmaslam.calibration_files.kitti_calibration import read_kitti_calibration
from sigmaslam.errors import SigmaSlamError
from sigmaslam.estimation.marginalised_poses import PastPoses
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.files import save_arrays
from sigmaslam.frontend import Features, StereoView
from sigmaslam.fusion.readings import read_locations
from sigmaslam.geometry.camera import RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.inference.weight_manifest import read_manifest
from sigmaslam.readers import open_sequence
from sigmaslam.readers.images import read_grey
from sigmaslam.readers.pairing import read_times
from sigmaslam.readers.trajectory_files import read_covariances, read_trajectory
from sigmaslam.run_record.frame_table import COLUMNS, read_frames
from sigmaslam.run_record.relative_pose_file import FramePairs, read_frame_pairs
from sigmaslam.slam.config import read_config
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.map_file import pack_keyframes, read_keyframes
from tests.support.mutation import mutate, mutate_archive, mutate_array
from tests.support.time_limit import HangError, limited_time

HANG_SECONDS = 5.0
LONGEST_MESSAGE = 2_000
WIDTH, HEIGHT = 64, 48
CAMERA = RectifiedStereo(fx=50.0, fy=50.0, cx=32.0, cy=24.0, baseline=0.1, width=WIDTH, height=HEIGHT)
Mutator = Callable[[bytes, list[bytes], Random], bytes]


@dataclass(frozen=True)
class FuzzTarget:
    """A reader, and files that it reads.

    Attributes:
        name: of the target.
        file_name: that the reader is given.
        seeds: contents of good files.
        read: takes the file; its errors are SigmaSlamErrors alone.
        mutator: how contents are changed.
    """

    name: str
    file_name: str
    seeds: list[bytes]
    read: Callable[[Path], object]
    mutator: Mutator = mutate

    def changed(self, random: Random, content: bytes | None = None) -> bytes:
        """A content, or else one of the seeds, changed."""
        if content is None:
            content = random.choice(self.seeds)
        try:
            return self.mutator(content, self.seeds, random)
        except Exception:  # a content that is no archive any more
            return mutate(content, self.seeds, random)


@dataclass
class Crash:
    """A content that a reader did not refuse as it should.

    Attributes:
        kind: type of the error and where it was raised.
        content: of the file.
        count: how often it was seen.
    """

    kind: str
    content: bytes
    count: int = 1


@dataclass
class Tally:
    """What became of the executions of a target."""

    executions: int = 0
    read: int = 0
    refused: int = 0
    slowest: float = 0.0
    crashes: dict[str, Crash] = field(default_factory=dict)

    def run(self, target: FuzzTarget, content: bytes, folder: Path) -> None:
        """Gives the content to the reader and counts what becomes of it."""
        path = folder / target.file_name
        path.write_bytes(content)
        self.executions += 1
        begin = time.perf_counter()
        try:
            with limited_time(HANG_SECONDS), np.errstate(all="ignore"):
                target.read(path)
            self.read += 1
        except SigmaSlamError as error:
            self.refused += 1
            if len(str(error)) > LONGEST_MESSAGE:
                self._note(f"message of {type(error).__name__} longer than {LONGEST_MESSAGE}", error, content)
            elif path.name not in str(error):
                self._note(f"message of {type(error).__name__} does not name the file", error, content)
        except (Exception, HangError) as error:
            self._note(f"{type(error).__name__}: {str(error)[:80]}", error, content)
        self.slowest = max(self.slowest, time.perf_counter() - begin)

    def _note(self, what: str, error: BaseException, content: bytes) -> None:
        ours = [frame for frame in traceback.extract_tb(error.__traceback__) if "sigmaslam" in frame.filename]
        kind = f"{what.split(':')[0]} at {Path(ours[-1].filename).name}:{ours[-1].lineno}" if ours else what
        if kind in self.crashes:
            self.crashes[kind].count += 1
        else:
            self.crashes[kind] = Crash(f"{kind} ({what})", content)


def make_targets(folder: Path) -> dict[str, FuzzTarget]:
    """All targets by name.

    Args:
        folder: new; gets the files that readers expect beside the one that is changed.
    """
    sensor = folder / "right_sensor.yaml"
    sensor.write_text(_sensor(0.1))
    (folder / "sequence").mkdir()
    truth = folder / "cam0_sensor.yaml"
    truth.write_text(_sensor(0.0))
    targets = [
        FuzzTarget("calibration", "stereo.yaml", _calibrations(), _rectify),
        FuzzTarget("EuRoC sensor", "sensor.yaml", [_sensor(0.0).encode()], lambda path: read_sensors(path, sensor)),
        FuzzTarget(
            "KITTI calibration", "calib.txt", _kitti(), lambda path: read_kitti_calibration(path, (64, 48), (0, 1))
        ),
        FuzzTarget("settings", "settings.yaml", [b"window: 8\nkeyframe_ratio: 0.7\nestimate: [focal]\n"], read_config),
        FuzzTarget("map", "map.npz", [_map()], lambda path: read_keyframes(path, "klt", CAMERA), mutate_archive),
        FuzzTarget(
            "relative poses",
            "relative.npz",
            [_relative(folder)],
            lambda path: read_frame_pairs(path, 9),
            mutate_archive,
        ),
        FuzzTarget("tracks", "tracks.npz", [_tracks()], lambda path: read_tracks(path, 5), mutate_archive),
        FuzzTarget("covariance", "covariance.npy", [_array()], lambda path: read_covariances(path, 4), mutate_array),
        FuzzTarget("trajectory", "poses.txt", _trajectories(), read_trajectory),
        FuzzTarget("times", "stamps.txt", _times(), lambda path: read_times(path, 3, [0, 1, 2])),
        FuzzTarget("locations", "location.csv", _locations(), read_locations),
        FuzzTarget("frames", "frames.csv", [_frames()], read_frames),
        FuzzTarget("image", "image.png", _images(), read_grey),
        FuzzTarget("region", "mask.png", _images(), lambda path: read_region(str(path), WIDTH, HEIGHT)),
        FuzzTarget("box", "box.txt", [b"1,2,30,20", b" 1.5,2,3,4.0"], _read_box),
        FuzzTarget("manifest", "manifest.json", [b'{"a.onnx": "00"}'], read_manifest),
        _time_table(folder / "euroc"),
        *_bags(folder),
    ]
    return {target.name: target for target in targets}


def _rectify(path: Path) -> None:
    camera = StereoCamera.from_yaml(path)
    # A file may state a size whose maps take a GB.
    if camera.left.width * camera.left.height < 10_000:
        _named(lambda _: StereoRectifier(camera))(path)


def _read_box(path: Path) -> None:
    text = path.read_bytes().decode(errors="replace")
    try:
        read_region(text, WIDTH, HEIGHT)
    except SigmaSlamError as error:
        raise type(error)(f"{path.name}: {error}") from error


_POSE = "1 0 0 {x} 0 1 0 0 0 0 1 0"


def _calibrations() -> list[bytes]:
    eye = "{width: 64, height: 48, fx: 50.0, fy: 50, cx: 32, cy: 24.5"
    T = "T_left_right: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    return [
        f"left: {eye}}}\nright: {eye}}}\n{T}sigmas: {{focal: 0.003}}\n".encode(),
        f"left: &eye {eye}, distortion_model: radtan, distortion: [-0.1, 1e-2, 0, 0]}}\nright: *eye\n{T}".encode(),
        f"%YAML:1.0\nleft: {eye}, distortion_model: equidistant, distortion: [0.1, 0, 0, 0]}}\n"
        f"right:\n  {eye[1:].replace(', ', chr(10) + '  ')}\n{T}sigmas: 0\n".encode(),
    ]


def _sensor(x: float) -> str:
    return (
        f"%YAML:1.0\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, {x}, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
        "resolution: [64, 48]\ncamera_model: pinhole\nintrinsics: [50.0, 50.0, 32.0, 24.0]\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [-0.1, 0.01, 0.0, 0.0]\n"
    )


def _kitti() -> list[bytes]:
    lines = [f"50 0 32 {t} 0 50 24 0 0 0 1 0" for t in (0, -5)]
    raw = "".join(
        f"S_0{k}: 64 48\nK_0{k}: 50 0 32 0 50 24 0 0 1\nD_0{k}: -0.3 0.2 0 0 0\nR_0{k}: 1 0 0 0 1 0 0 0 1\n"
        f"T_0{k}: {-0.1 * k} 0 0\nS_rect_0{k}: 60 40\nR_rect_0{k}: 1 0 0 0 1 0 0 0 1\nP_rect_0{k}: {lines[k]}\n"
        for k in (0, 1)
    )
    return ["\n".join(lines).encode(), f"P0: {lines[0]}\nP1: {lines[1]}\n".encode(), raw.encode()]


def _packed(**arrays: np.ndarray) -> bytes:
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    return packed.getvalue()


def _map() -> bytes:
    rng = np.random.default_rng(0)
    keyframes = []
    for number, count in enumerate((6, 0, 4)):
        image = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
        places = rng.uniform(0, 48, (count, 2)).astype(np.float32)
        ones = np.ones(count, np.float32)
        disparity = np.where(np.arange(count) % 4 == 0, np.nan, 3.0)
        view = StereoView(
            image, image, Features(places, np.ones((count, 8), np.float32), ones, ones), disparity, disparity
        )
        keyframes.append(Keyframe(number, float(number), view))
    none = np.zeros((18, CALIBRATION_SIZE))
    past = PastPoses(np.tile(np.eye(4), (3, 1, 1)), np.eye(18), none, none)
    return _packed(**pack_keyframes(keyframes, past, "klt", CAMERA))


def _relative(folder: Path) -> bytes:
    frames = np.arange(3)
    poses, covariances = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(6), (3, 1, 1))
    path = folder / "seed.npz"
    save_arrays(path, **FramePairs(np.array(["1 m"] * 3), frames, frames + 1, poses, covariances).arrays())
    return path.read_bytes()


def _tracks() -> bytes:
    count = 8
    return _packed(
        frame=np.arange(count) % 4,
        landmark=np.arange(count) // 2,
        measurement=np.full((count, 3), 5.0),
        covariance=np.tile(np.eye(3), (count, 1, 1)),
        intrinsics=np.array([50.0, 50.0, 32.0, 24.0, 0.1]),
        R_rectified_left=np.eye(3),
        disparity_offset=np.array([0.0, 0.1]),
    )


def _array() -> bytes:
    packed = io.BytesIO()
    np.save(packed, np.tile(np.eye(6), (4, 1, 1)))
    return packed.getvalue()


def _trajectories() -> list[bytes]:
    return [
        b"# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n0.1 0.5 0 1e-3 0 0 0.6 0.8\n0.2 1 0 0 0 0 0 1\n",
        "".join(f"{_POSE.format(x=0.1 * k)}\n" for k in range(3)).encode(),
        b"#timestamp [ns],p\n1403715273262142976,0,0,0,1,0,0,0\n1403715273312143104,1,0,0,0.6,0.8,0,0\n",
        b"1403715273262142976,1403715273262142976,0,0,0,1,0,0,0\n1403715273312143104,1403715273312143104,1,0,0,1,0,0,0\n",
        b"0.0, 0, 0, 0, 0, 0, 0, 1\n0.1, 0, 0, 0, 0, 0, 0, 1\n",
    ]


def _times() -> list[bytes]:
    return [b"0.0\n0.1\n0.2\n", b"2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.1\n2011-09-26 13:02:27\n"]


def _locations() -> list[bytes]:
    return [
        b"timestamp,x,y,z,sigma_position\n0,0,0,0,0.1\n0.1,1,0,0,0.1\n",
        b"timestamp,x,y,z,qx,qy,qz,qw,sigma_x,sigma_y,sigma_z,sigma_rotation\n0,0,0,0,0,0,0,1,1,1,1,0.1\n",
        b"timestamp,x,y,z,cxx,cxy,cxz,cyy,cyz,czz\n0,0,0,0,1,0,0,1,0,1\n1,0,0,0,1,0.5,0,1,0,1\n",
        b"timestamp;x;y;z;sigma_position\n0;0;0;0;0,1\n",
    ]


def _frames() -> bytes:
    names = ("status", *COLUMNS, "ms_read")
    rows = [",".join(["tracking", *(str(k) for k in range(len(COLUMNS) + 1))]) for _ in range(3)]
    return "\n".join([",".join(names), *rows, ""]).encode()


def _images() -> list[bytes]:
    rng = np.random.default_rng(0)
    grey = rng.integers(0, 200, (HEIGHT, WIDTH), dtype=np.uint8)
    seeds = [cv2.imencode(suffix, grey)[1].tobytes() for suffix in (".png", ".jpg", ".bmp", ".tiff", ".pgm")]
    colour = cv2.merge([grey] * 4)
    return [*seeds, *(cv2.imencode(".png", each)[1].tobytes() for each in (colour, grey.astype(np.uint16) * 16))]


def _time_table(root: Path) -> FuzzTarget:
    """data.csv of a EuRoC folder whose images have other names than times."""
    image = _images()[0]
    for eye in (0, 1):
        camera = root / f"cam{eye}"
        (camera / "data").mkdir(parents=True)
        (camera / "sensor.yaml").write_text(_sensor(0.1 * eye))
        for k in range(2):
            (camera / "data" / f"a{k}.png").write_bytes(image)
        (camera / "data.csv").write_text("1403715273262142976,a0.png\n1403715273312142976,a1.png\n")
    seed = (root / "cam0" / "data.csv").read_bytes()

    def read(path: Path) -> None:
        (root / "cam0" / "data.csv").write_bytes(path.read_bytes())
        open_sequence(root)

    return FuzzTarget("EuRoC time table", "data.csv", [b"#ns,name\n" + seed, seed], _named(read))


def _named(read: Callable[[Path], object]) -> Callable[[Path], object]:
    """A reader of a folder, or of a copy: its messages name another file."""

    def named(path: Path) -> None:
        try:
            read(path)
        except SigmaSlamError as error:
            raise type(error)(f"{path.name}: {error}") from error

    return named


def _bags(folder: Path) -> list[FuzzTarget]:
    """One of each kind, where rosbags is installed."""
    try:
        from tests.support.small_bags import write_bag
    except ImportError:
        return []
    targets = []
    for kind in ("bag", "db3", "mcap"):
        written = write_bag(folder / f"recording {kind}", kind, (WIDTH, HEIGHT))

        def read(path: Path) -> None:
            for _ in open_sequence(path, "bag").frames():
                pass

        targets.append(FuzzTarget(kind, f"bag.{kind}", [written.read_bytes()], _named(read)))
    return targets


def as_json(content: bytes) -> str:
    """A content for a report, short."""
    return json.dumps(content[:200].decode("latin-1"))
