"""Bags written with rosbags' own writers and read back; faults are put into the recording."""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.cli.commands import app
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers import open_sequence
from sigmaslam.readers.pairing import MAX_WAITING, Stamped, pair_streams
from sigmaslam.readers.ros_messages import image_array
from sigmaslam.readers.trajectory_files import read_tum

START = 1_700_000_000_123_456_789
STEP = 50_000_000
COUNT = 4
LEFT, RIGHT = "/stereo/left/image_rect", "/stereo/right/image_rect"
ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.LATEST)
KINDS = ("bag", "sqlite", "mcap", "db3 file", "mcap file")


def stamp_of(index: int) -> int:
    return START + index * STEP


def header(store, stamp: int):
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    fields = {"stamp": time, "frame_id": "eye"} | ({"seq": 0} if store is ROS1 else {})
    return store.types["std_msgs/msg/Header"](**fields)


def image(store, stamp: int, pixels: np.ndarray, encoding: str = "mono8", padding: int = 0, big: bool = False):
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels.astype(pixels.dtype.newbyteorder(">") if big else pixels.dtype))
    rows = np.pad(rows.view(np.uint8).reshape(height, -1), ((0, 0), (0, padding)))
    return store.types["sensor_msgs/msg/Image"](
        header=header(store, stamp),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(big),
        step=rows.shape[1],
        data=rows.ravel(),
    )


def compressed(store, stamp: int, pixels: np.ndarray, suffix: str):
    _, content = cv2.imencode(suffix, pixels)
    kind = store.types["sensor_msgs/msg/CompressedImage"]
    return kind(header=header(store, stamp), format=f"mono8; {suffix[1:]} compressed", data=content.ravel())


def info(store, size: tuple[int, int], K, D=(), R=None, P=None, model: str = "plumb_bob"):
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    arrays = {"d": D, "k": K, "r": np.eye(3) if R is None else R, "p": P}
    arrays = {key.upper() if store is ROS1 else key: np.array(a, np.float64).ravel() for key, a in arrays.items()}
    return store.types["sensor_msgs/msg/CameraInfo"](
        header=header(store, START),
        width=size[0],
        height=size[1],
        distortion_model=model,
        binning_x=0,
        binning_y=0,
        roi=roi,
        **arrays,
    )


def projection(K: np.ndarray, baseline: float) -> np.ndarray:
    return np.hstack([K, [[-K[0, 0] * baseline], [0], [0]]])


@dataclass
class Recording:
    """What is written: (topic, time of recording, message)."""

    kind: str
    messages: list = field(default_factory=list)

    @property
    def store(self):
        return ROS1 if self.kind == "bag" else ROS2

    def add(self, topic: str, stamp: int, message) -> None:
        self.messages.append((topic, stamp, message))

    def write(self, folder: Path) -> Path:
        path = folder / ("recording.bag" if self.kind == "bag" else "recording")
        if self.kind == "bag":
            writer = rosbag1.Writer(path)
            serialize = ROS1.serialize_ros1
        else:
            plugin = rosbag2.StoragePlugin.MCAP if "mcap" in self.kind else rosbag2.StoragePlugin.SQLITE3
            writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
            serialize = ROS2.serialize_cdr
        with writer:
            connections = {}
            for topic, stamp, message in sorted(self.messages, key=lambda entry: entry[1]):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self.store)
                writer.write(connections[topic], stamp, serialize(message, kind))
        return next(path.glob(f"*.{self.kind.split()[0]}")) if self.kind.endswith(" file") else path


@pytest.fixture(scope="session")
def pictures(demo_sequence: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """The first pairs of the demo."""
    folders = [sorted((demo_sequence / name).iterdir())[:COUNT] for name in ("image_0", "image_1")]
    return [tuple(cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in pair) for pair in zip(*folders, strict=True)]


@pytest.fixture(scope="session")
def demo_camera(demo_sequence: Path) -> StereoCamera:
    return open_sequence(demo_sequence).camera


def add_infos(recording: Recording, camera: StereoCamera, left: str = LEFT, right: str = RIGHT) -> None:
    """CameraInfo of a rectified pair."""
    K, size = camera.left.matrix, (camera.left.width, camera.left.height)
    for topic, baseline in ((left, 0.0), (right, camera.baseline)):
        message = info(recording.store, size, K, np.zeros(5), P=projection(K, baseline))
        recording.add(topic.rpartition("/")[0] + "/camera_info", START, message)


def record(kind: str, pictures, camera: StereoCamera | None, left: str = LEFT, right: str = RIGHT) -> Recording:
    """The pictures; right ones are stamped 1 ms later and written to disk first."""
    recording = Recording(kind)
    if camera is not None:
        add_infos(recording, camera, left, right)
    for index, pair in enumerate(pictures):
        stamp = stamp_of(index)
        recording.add(left, stamp + 4_000_000, image(recording.store, stamp, pair[0]))
        recording.add(right, stamp + 3_000_000, image(recording.store, stamp + 1_000_000, pair[1]))
    return recording


@pytest.mark.parametrize("kind", KINDS)
def test_pixels_times_and_calibration_come_back(tmp_path: Path, pictures, demo_camera: StereoCamera, kind: str):
    path = record(kind, pictures, demo_camera).write(tmp_path)
    sequence = open_sequence(path)
    assert (sequence.format, sequence.source, sequence.length) == ("bag", path, COUNT)
    assert (sequence.camera.left, sequence.camera.right) == (demo_camera.left, demo_camera.right)
    np.testing.assert_allclose(sequence.camera.T_left_right, demo_camera.T_left_right, atol=1e-12)
    for _ in range(2):
        frames = list(sequence.frames())
        assert [frame.timestamp for frame in frames] == [stamp_of(index) / 10**9 for index in range(COUNT)]
        assert sequence.skipped == []
        for frame, (left, right) in zip(frames, pictures, strict=True):
            np.testing.assert_array_equal(frame.left, left)
            np.testing.assert_array_equal(frame.right, right)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kind", ["bag", "sqlite"])
def test_compressed_images(tmp_path: Path, pictures, demo_camera: StereoCamera, kind: str, suffix: str):
    recording = Recording(kind)
    add_infos(recording, demo_camera)
    for index, pair in enumerate(pictures):
        for topic, pixels in zip((LEFT, RIGHT), pair, strict=True):
            message = compressed(recording.store, stamp_of(index), pixels, suffix)
            recording.add(f"{topic}/compressed", stamp_of(index), message)
    frames = list(open_sequence(recording.write(tmp_path)).frames())
    assert len(frames) == COUNT
    for frame, (left, _) in zip(frames, pictures, strict=True):
        expected = left if suffix == ".png" else cv2.imdecode(cv2.imencode(suffix, left)[1], cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(frame.left, expected)


# Images


RNG = np.random.default_rng(0)
GREY = RNG.integers(0, 256, (6, 8), np.uint8)
COLOUR = RNG.integers(0, 256, (6, 8, 3), np.uint8)
ALPHA = RNG.integers(0, 256, (6, 8, 4), np.uint8)
DEEP = RNG.integers(0, 65536, (6, 8), np.uint16)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GREY, GREY),
        ("8UC1", GREY, GREY),
        ("mono16", DEEP, DEEP),
        ("bgr8", COLOUR, COLOUR),
        ("rgb8", COLOUR, COLOUR[..., ::-1]),
        ("bgra8", ALPHA, ALPHA),
        ("rgba8", ALPHA, ALPHA[..., [2, 1, 0, 3]]),
        ("yuv422_yuy2", np.dstack([GREY, 128 + 0 * GREY]), GREY),
        ("yuv422", np.dstack([128 + 0 * GREY, GREY]), GREY),
    ],
)
def test_encodings(encoding: str, pixels: np.ndarray, expected: np.ndarray, padding: int):
    """Rows may be padded; colours come in OpenCV's order, brightness alone of YUV."""
    np.testing.assert_array_equal(image_array(image(ROS2, START, pixels, encoding, padding), "topic"), expected)


def test_big_endian_images():
    result = image_array(image(ROS1, START, DEEP, "16UC1", padding=2, big=True), "topic")
    np.testing.assert_array_equal(result, DEEP)
    assert result.dtype == np.uint16
    assert result.dtype.isnative


@pytest.mark.parametrize(("order", "red"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))])
def test_bayer_order_is_that_of_the_first_pixels(order: str, red: tuple[int, int]):
    """A red surface is 0.299 of its brightness in grey, a blue one 0.114."""
    mosaic = np.zeros((8, 8), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    grey = image_array(image(ROS2, START, mosaic, f"bayer_{order}8"), "topic")
    np.testing.assert_allclose(grey[2:-2, 2:-2], 0.299 * 200, atol=1)


def test_a_pair_that_cannot_be_decoded_is_skipped(tmp_path: Path, pictures, demo_camera: StereoCamera):
    recording = record("mcap", pictures, demo_camera)
    broken = next(message for topic, stamp, message in recording.messages if topic == LEFT and stamp > stamp_of(1))
    broken.data = broken.data[:1000]
    sequence = open_sequence(recording.write(tmp_path))
    assert [frame.index for frame in sequence.frames()] == [0, 2, 3]
    assert [skipped.timestamp for skipped in sequence.skipped] == [stamp_of(1) / 10**9]
    assert (
        f"{LEFT} at 1700000000.173457 s: 1000 bytes for a 320x240 image of mono8, 76800" in sequence.skipped[0].reason
    )


def test_an_unknown_encoding_is_named(tmp_path: Path, pictures, demo_camera: StereoCamera):
    recording = record("sqlite", pictures, demo_camera)
    for topic, _, message in recording.messages:
        if topic == RIGHT:
            message.encoding = "32FC1"
    with pytest.raises(
        InputError, match=r"none of the first 4 pairs can be read; .*'32FC1' is not known; known are mono8"
    ):
        list(open_sequence(recording.write(tmp_path)).frames())


# Pairing


def drop(recording: Recording, topic: str, index: int) -> None:
    recording.messages = [
        entry for entry in recording.messages if entry[0] != topic or not 0 <= entry[1] - stamp_of(index) < STEP
    ]


def test_a_missing_image_costs_its_pair_and_no_other(tmp_path: Path, pictures, demo_camera: StereoCamera):
    recording = record("bag", pictures, demo_camera)
    drop(recording, RIGHT, 1)
    sequence = open_sequence(recording.write(tmp_path))
    frames = list(sequence.frames())
    assert [frame.timestamp for frame in frames] == [stamp_of(index) / 10**9 for index in (0, 2, 3)]
    np.testing.assert_array_equal(frames[1].right, pictures[2][1])
    assert [(skipped.index, skipped.timestamp) for skipped in sequence.skipped] == [(1, stamp_of(1) / 10**9)]
    assert "1 images without a partner within 5 ms" in sequence.skipped[0].reason


def test_an_eye_that_starts_late_is_no_failure(tmp_path: Path, pictures, demo_camera: StereoCamera, caplog):
    recording = record("mcap", pictures, demo_camera)
    drop(recording, RIGHT, 0)
    sequence = open_sequence(recording.write(tmp_path))
    assert len(list(sequence.frames())) == COUNT - 1
    assert sequence.skipped == []
    assert "1 images without a partner within 5 ms at the beginning are left out" in caplog.text


def test_eyes_that_are_never_together_are_refused(tmp_path: Path, pictures, demo_camera: StereoCamera):
    recording = record("bag", pictures, demo_camera)
    for topic, _, message in recording.messages:
        if topic == RIGHT:
            message.header = header(ROS1, START + 20_000_000 + message.header.stamp.nanosec)
    with pytest.raises(InputError, match=r"8 images without a partner within 5 ms .* and no pair: .* synchronised\?"):
        open_sequence(recording.write(tmp_path))


def test_headers_without_time_stamps_fall_back_to_the_times_of_recording(
    tmp_path: Path, pictures, demo_camera: StereoCamera, caplog
):
    recording = record("bag", pictures, demo_camera)
    for _, _, message in recording.messages:
        message.header = header(ROS1, 0)
    frames = list(open_sequence(recording.write(tmp_path)).frames())
    assert [frame.timestamp for frame in frames] == [(stamp_of(index) + 4_000_000) / 10**9 for index in range(COUNT)]
    assert "no time stamps" in caplog.text


def stamps_of_pairs(left: list[int], right: list[int]) -> list[tuple[int | None, int | None]]:
    """As the streams come: sorted by time, stamps in ms."""
    images = [(0, ms) for ms in left] + [(1, ms) for ms in right]
    images = [(eye, Stamped(ms * 1_000_000, None)) for eye, ms in sorted(images, key=lambda entry: entry[1])]
    pairs = pair_streams(images)
    return [tuple(None if one is None else one.stamp // 1_000_000 for one in pair) for pair in pairs]


def test_fast_cameras_are_paired_with_the_nearest_after_a_lost_image():
    """At 250 Hz the image after a lost one is within 5 ms too; taking it would shift all that follow."""
    left = list(range(0, 80, 4))
    right = [ms + 1 for ms in left if ms != 20]
    expected = [(ms, None if ms == 20 else ms + 1) for ms in left]
    assert stamps_of_pairs(left, right) == expected


def test_streams_hold_no_more_than_a_few_images():
    """The right eye never comes: left images are given up one by one, not kept to the end."""
    taken = 0

    def images():
        nonlocal taken
        for taken in range(10 * MAX_WAITING):
            yield 0, Stamped(taken * STEP, None)

    for given_up, (left, right) in enumerate(pair_streams(images()), start=1):
        assert right is None
        assert left is not None
        assert taken - given_up <= MAX_WAITING


def test_stamps_that_go_back_are_left_alone():
    images = [(0, 10), (1, 10), (0, 20), (1, 20), (0, 15), (1, 20), (0, 30), (1, 30)]
    pairs = list(pair_streams([(eye, Stamped(ms * 1_000_000, None)) for eye, ms in images]))
    assert [(left.stamp, right.stamp) for left, right in pairs if left and right] == [
        (10**7, 10**7),
        (2 * 10**7,) * 2,
        (3 * 10**7,) * 2,
    ]
    assert len(pairs) == 5


# Topics


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("/cam0/image_raw", "/cam1/image_raw"),
        ("/camera/infra1/image_rect_raw", "/camera/infra2/image_rect_raw"),
        ("/zed/Left/color/rect/image", "/zed/Right/color/rect/image"),
    ],
)
def test_topics_of_common_cameras_are_found(tmp_path: Path, pictures, demo_camera, left: str, right: str):
    path = record("sqlite", pictures, demo_camera, left, right).write(tmp_path)
    sequence = open_sequence(path)
    assert sequence.camera.left == demo_camera.left
    assert len(list(sequence.frames())) == COUNT


def test_a_realsense_bag_is_read_with_a_calibration(tmp_path: Path, pictures, demo_camera: StereoCamera):
    sensor = "/device_0/sensor_0"
    topics = (f"{sensor}/Infrared_1/image/data", f"{sensor}/Infrared_2/image/data")
    path = record("bag", pictures, None, *topics).write(tmp_path)
    with pytest.raises(CalibrationError, match=r"no CameraInfo that belongs to .* give --calibration"):
        open_sequence(path)
    write_calibration(tmp_path / "stereo.yaml", demo_camera)
    sequence = open_sequence(path, calibration=tmp_path / "stereo.yaml")
    np.testing.assert_array_equal(next(sequence.frames()).right, pictures[0][1])


def test_unclear_topics_are_listed_and_can_be_chosen(tmp_path: Path, pictures, demo_camera: StereoCamera):
    recording = record("mcap", pictures, demo_camera)
    other = record("mcap", pictures[::-1], None, "/other/left/image_raw", "/other/right/image_raw")
    recording.messages += other.messages
    path = recording.write(tmp_path)
    with pytest.raises(InputError, match="2 image topics are left by their name; choose with --topic-left") as caught:
        open_sequence(path)
    for topic in (LEFT, RIGHT, "/other/left/image_raw", "/other/right/image_raw"):
        assert f"\n  {topic}: sensor_msgs/msg/Image, {COUNT}" in str(caught.value)
    sequence = open_sequence(path, topics=(LEFT, RIGHT.strip("/")))
    np.testing.assert_array_equal(next(sequence.frames()).left, pictures[0][0])
    with pytest.raises(InputError, match="no image topic /nothing"):
        open_sequence(path, topics=("/nothing", RIGHT))
    with pytest.raises(InputError, match=f"{LEFT} is given for both eyes"):
        open_sequence(path, topics=(LEFT, LEFT))


def test_a_rectified_and_a_raw_topic_are_refused(tmp_path: Path, pictures, demo_camera: StereoCamera):
    path = record("mcap", pictures, demo_camera, LEFT, "/stereo/right/image_raw").write(tmp_path)
    with pytest.raises(InputError, match=r"one of .* is rectified by its name, the other is not"):
        open_sequence(path)


@pytest.mark.long
def test_track_takes_topics(tmp_path: Path, pictures, demo_camera: StereoCamera):
    path = record("mcap file", pictures, demo_camera, "/a/image_rect", "/b/image_rect").write(tmp_path)
    out = tmp_path / "run"
    command = ["track", str(path), "--out", str(out), "--frontend", "klt"]
    assert "choose with --topic-left" in str(CliRunner().invoke(app, command).exception)
    result = CliRunner().invoke(app, [*command, "--topic-left", "/a/image_rect", "--topic-right", "/b/image_rect"])
    assert result.exit_code == 0, result.output
    times = [stamp_of(index) / 10**9 for index in range(COUNT)]
    np.testing.assert_allclose(read_tum(out / "trajectory.tum").timestamps, times, rtol=0, atol=1e-6)


def test_topics_go_with_bags_alone(demo_sequence: Path):
    with pytest.raises(InputError, match="only bags have topics"):
        open_sequence(demo_sequence, topics=("/left", None))


# Calibration


def add_images(recording: Recording, size: tuple[int, int], left: str, right: str) -> None:
    for topic in (left, right):
        recording.add(topic, START, image(recording.store, START, np.zeros(size[::-1], np.uint8)))


@pytest.mark.parametrize("kind", ["bag", "sqlite"])
@pytest.mark.parametrize(
    ("name", "model", "left_D", "right_D"),
    [
        ("plumb_bob", "radtan", [-0.28, 0.07, 2e-4, 2e-5, 0.0], [-0.27, 0.06, -1e-4, -3e-5, 0.0]),
        ("rational_polynomial", "radtan", [0.1, 0.02, 1e-4, 0, 0.01, 0.2, 0.01, 0.001] + 6 * [0.0], [0.1] + 7 * [0.01]),
        ("equidistant", "equidistant", [-0.01, 0.02, -0.01, 0.002], [-0.02, 0.01, -0.02, 0.003]),
    ],
)
def test_raw_images_take_lens_and_placement_from_camera_info(
    tmp_path: Path, kind: str, name: str, model: str, left_D: list[float], right_D: list[float]
):
    """CameraInfo is made as ROS makes it, from the rectification of a known pair; the pair comes back."""
    size = (752, 480)
    coefficients = [tuple(D[:8]) for D in (left_D, right_D)]
    left = CameraModel(*size, 458.6, 457.3, 367.2, 248.4, 0.0, model, coefficients[0])
    right = CameraModel(*size, 457.6, 456.1, 380.0, 255.2, 0.0, model, coefficients[1])
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.array([0.02, -0.01, 0.03]))[0]
    T[:3, 3] = 0.11, -0.002, 0.001
    rectifier = StereoRectifier(StereoCamera(left, right, T))
    rectified = rectifier.rectified
    recording = Recording(kind)
    turns = (rectifier.R_rectified_left, rectifier.R_rectified_right)
    for eye, camera, D, R, baseline in (
        ("left", left, left_D, turns[0], 0.0),
        ("right", right, right_D, turns[1], rectified.baseline),
    ):
        message = info(recording.store, size, camera.matrix, D, R, projection(rectified.matrix, baseline), name)
        recording.add(f"/{eye}/camera_info", START, message)
    add_images(recording, size, "/left/image_raw", "/right/image_raw")
    add_images(recording, size, "/left/image_rect", "/right/image_rect")
    path = recording.write(tmp_path)
    camera = open_sequence(path, topics=("/left/image_raw", "/right/image_raw")).camera
    assert (camera.left, camera.right) == (left, right)
    np.testing.assert_allclose(camera.T_left_right, T, atol=1e-12)
    camera = open_sequence(path, topics=("/left/image_rect", "/right/image_rect")).camera
    assert camera.is_rectified
    np.testing.assert_allclose(camera.left.matrix, rectified.matrix)
    assert camera.baseline == pytest.approx(rectified.baseline)


K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"P": projection(K, 0.0)}, r"/right/camera_info: no baseline \(P\[0, 3\] is 0\)"),
        ({"P": projection(K, -0.1)}, "/left/camera_info and /right/camera_info: left and right look swapped"),
        ({"P": np.zeros((3, 4))}, "/right/camera_info: not calibrated, P is .*; give --calibration"),
        ({"K": np.zeros((3, 3))}, "/right/camera_info: not calibrated, K is"),
        ({"model": "fov", "D": [1.0]}, "/right/camera_info: distortion_model is 'fov', the field-of-view model"),
        ({"D": [0.1, 0.1]}, "/right/camera_info: distortion has 2 coefficients"),
        ({"size": (128, 96)}, "right image is 64x48, the calibration is for 128x96"),
    ],
)
def test_calibration_errors(tmp_path: Path, changes: dict, message: str):
    recording = Recording("bag")
    add_images(recording, (64, 48), "/left/image_raw", "/right/image_raw")
    recording.add("/left/camera_info", START, info(ROS1, (64, 48), K, P=projection(K, 0.0)))
    values = {"size": (64, 48), "K": K, "P": projection(K, 0.1)} | changes
    recording.add("/right/camera_info", START, info(ROS1, **values))
    with pytest.raises(CalibrationError, match=message):
        open_sequence(recording.write(tmp_path))


def test_a_bag_without_camera_info_needs_a_calibration(tmp_path: Path, pictures, demo_sequence: Path):
    path = record("sqlite", pictures, None).write(tmp_path)
    with pytest.raises(
        CalibrationError, match=f"no CameraInfo that belongs to {LEFT} .* give --calibration; there are: none"
    ):
        open_sequence(path)
    sequence = open_sequence(path, calibration=demo_sequence / "calib.txt")
    assert len(list(sequence.frames())) == COUNT


def test_a_name_that_tells_not_whether_images_are_rectified_is_warned_about(
    tmp_path: Path, pictures, demo_camera: StereoCamera, caplog
):
    open_sequence(record("bag", pictures, demo_camera, "/left/image", "/right/image").write(tmp_path))
    assert "/left/image: neither 'rect' nor 'raw' in the name; taken as raw" in caplog.text


# Files that are no bags


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("content", [b"", b"no bag at all, but longer than any magic number"])
def test_files_that_are_no_bags(tmp_path: Path, name: str, content: bytes):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"{name}: cannot be read as a ROS bag"):
        open_sequence(tmp_path / name)


@pytest.mark.parametrize("kind", ["bag", "mcap file"])
def test_a_recording_that_was_cut_off_is_refused(tmp_path: Path, pictures, demo_camera: StereoCamera, kind: str):
    path = record(kind, pictures, demo_camera).write(tmp_path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="reindex"):
        list(open_sequence(path).frames())


def test_other_files_are_not_taken_for_bags(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match=r"notes.txt: no ROS bag; looked for a ROS bag \*.bag"):
        open_sequence(tmp_path / "notes.txt", format="bag")


def test_without_rosbags_the_error_tells_how_to_install_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    (tmp_path / "a.bag").write_bytes(b"")
    with pytest.raises(InputError, match=r"pip install 'sigmaslam\[bag\]'"):
        open_sequence(tmp_path / "a.bag")
