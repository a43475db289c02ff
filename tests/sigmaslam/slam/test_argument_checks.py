"""Arguments of another type, shape or value give one error of ours that names them and says what to give."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Event, current_thread
from typing import Any
from unittest import mock

import numpy as np
import pytest

import sigmaslam
from sigmaslam.bodies.object_tracker import ObjectTracker
from sigmaslam.errors import FrameError, InputError
from sigmaslam.estimation.preintegration import preintegrate
from sigmaslam.frontend import build_frontend
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.readers import open_sequence
from sigmaslam.readers.stereo_sequence import StereoFrame
from sigmaslam.slam import tracker as tracker_module
from sigmaslam.slam.argument_checks import check_frame
from sigmaslam.slam.tracker import StereoTracker


@pytest.fixture(scope="module")
def frames(demo_sequence: Path) -> list[StereoFrame]:
    return [frame for frame, _ in zip(open_sequence(demo_sequence).frames(), range(3), strict=False)]


@pytest.fixture(scope="module")
def tracker(demo_sequence: Path) -> StereoTracker:
    return StereoTracker(open_sequence(demo_sequence).camera, "klt")


IMAGE = np.zeros((240, 320), np.uint8)
WRONG_IMAGES = [
    (np.zeros((240, 320, 3), np.uint8), r"uint8 of shape \(240, 320, 3\).*cv2.COLOR_BGR2GRAY"),
    (IMAGE[:, :, None], r"uint8 of shape \(240, 320, 1\): give a grey .*; take image\[:, :, 0\]$"),
    (IMAGE.astype(float), r"float64 of shape \(240, 320\).*astype\(np.uint8\)"),
    (IMAGE.astype(np.uint16), r"uint16 of shape \(240, 320\)"),
    (IMAGE > 0, "bool of shape"),
    (IMAGE[0], r"uint8 of shape \(320,\): give a grey"),
    (None, "NoneType and no array: give a grey .* cv2.imread"),
    (IMAGE[:1, :3].tolist(), "list and no array"),
    ("left.png", "str and no array"),
]


@pytest.mark.parametrize(("image", "words"), WRONG_IMAGES)
def test_images_of_another_kind_are_refused(tracker: StereoTracker, image: Any, words: str):
    with pytest.raises(FrameError, match=f"^left image is {words}"):
        tracker.step(image, IMAGE, 0.0)
    with pytest.raises(FrameError, match=f"^right image is {words}"):
        tracker.step(IMAGE, image, 0.0)
    with pytest.raises(InputError, match=f"^image1 is {words}"):
        sigmaslam.match_images(IMAGE, image, "sift")


def test_an_image_of_another_size_is_refused(tracker: StereoTracker):
    with pytest.raises(FrameError, match="left image is 320x50, its calibration is for 320x240"):
        tracker.step(IMAGE[:50], IMAGE, 0.0)


@pytest.mark.parametrize(
    "timestamp",
    [
        None,
        "0.1",
        float("nan"),
        float("inf"),
        True,
        [1.0],
        np.zeros(1),
        1j,
        np.complex64(1),
        np.timedelta64(1),
        10**400,
    ],
)
def test_times_that_are_no_numbers_are_refused(tracker: StereoTracker, timestamp: Any):
    with pytest.raises(InputError, match=r"^timestamp is .*: give seconds as a"):
        tracker.step(IMAGE, IMAGE, timestamp)


@pytest.mark.parametrize("timestamp", [1, np.float32(1.5), np.int64(2), 1e9])
def test_times_of_any_kind_of_number_are_taken(timestamp: Any):
    assert type(check_frame(IMAGE, IMAGE, timestamp, None)) is float


def test_a_buffer_that_is_filled_again_and_whole_seconds_change_nothing(demo_sequence: Path, frames: list[StereoFrame]):
    plain, reusing = (StereoTracker(open_sequence(demo_sequence).camera, "klt") for _ in range(2))
    left, right = np.empty_like(IMAGE), np.empty_like(IMAGE)
    for second, frame in enumerate(frames):
        expected = plain.step(frame.left, frame.right, float(second))
        left[:], right[:] = frame.left, frame.right
        found = reusing.step(left, right, np.int64(second))
        left[:], right[:] = 0, 0
        np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
        assert found.status == expected.status


def test_pairs_that_come_from_several_threads_are_taken_one_by_one(demo_sequence: Path, frames: list[StereoFrame]):
    tracker = StereoTracker(open_sequence(demo_sequence).camera, "klt")
    held, step = Event(), tracker._step

    def wait(*arguments: Any) -> Any:
        held.wait(30.0)
        return step(*arguments)

    with mock.patch.object(tracker, "_step", side_effect=wait) as slow, ThreadPoolExecutor(2) as pool:
        first = pool.submit(tracker.step, frames[0].left, frames[0].right, 0.0)
        while not slow.called:
            pass
        second = pool.submit(tracker.step, frames[1].left, frames[1].right, 0.05)
        with pytest.raises(TimeoutError):
            second.result(0.1)
        assert slow.call_count == 1
        held.set()
        assert [first.result().status, second.result().status] == ["starting", "tracking"]


def test_a_refused_frame_leaves_the_tracker_as_it_was(demo_sequence: Path, frames: list[StereoFrame]):
    camera = open_sequence(demo_sequence).camera
    plain, disturbed = StereoTracker(camera, "klt"), StereoTracker(camera, "klt")
    for frame in frames:
        expected = plain.step(frame.left, frame.right, frame.timestamp)
        for left, timestamp in ((None, frame.timestamp), (frame.left[:50], frame.timestamp), (frame.left, -1.0)):
            if timestamp >= 0.0 or frame.timestamp > 0.0:
                with pytest.raises(InputError):
                    disturbed.step(left, frame.right, timestamp)
        found = disturbed.step(frame.left, frame.right, frame.timestamp)
        np.testing.assert_array_equal(found.T_world_camera, expected.T_world_camera)
        np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_time_stamps_in_nanoseconds_are_refused_with_their_unit(demo_sequence: Path, frames: list[StereoFrame]):
    tracker = StereoTracker(open_sequence(demo_sequence).camera, "klt")
    tracker.step(frames[0].left, frames[0].right, 1e18)
    with pytest.raises(InputError, match="1e\\+08 s after the one before: give seconds, not nano- or micro"):
        tracker.step(frames[1].left, frames[1].right, 1e18 + 1e8)


@pytest.mark.parametrize("pause", [10.0, 1e3, 9e4])
def test_a_pause_is_survived(demo_sequence: Path, frames: list[StereoFrame], pause: float):
    tracker = StereoTracker(open_sequence(demo_sequence).camera, "klt")
    for k, frame in enumerate(frames):
        estimate = tracker.step(frame.left, frame.right, k * pause)
        assert np.isfinite(estimate.T_world_camera).all()
        assert np.isfinite(estimate.covariance).all()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"camera": "stereo.yaml"}, r"camera is 'stereo.yaml': give a StereoCamera.*from_yaml"),
        ({"camera": None}, "camera is None"),
        ({"frontend": "sfit"}, "there is no front-end 'sfit': choose one of learned"),
        ({"frontend": 3}, "frontend is 3: give a name, or an object with name, observe"),
        ({"backend": "tensorflow"}, "backend is 'tensorflow': give one of onnx, torch"),
        ({"config": {"window": 8}}, "config is .*give a TrackerConfig"),
        ({"threads": 0}, "threads is 0: give a whole number"),
        ({"threads": 1.5}, "threads is 1.5"),
    ],
)
def test_wrong_arguments_of_both_trackers_are_refused(demo_sequence: Path, changed: dict[str, Any], words: str):
    arguments = {"camera": open_sequence(demo_sequence).camera, "frontend": "klt", **changed}
    with pytest.raises(InputError, match=words):
        StereoTracker(**arguments)
    with pytest.raises(InputError, match=words):
        ObjectTracker(region=np.ones((240, 320), bool), **arguments)


SENSOR = InertialSensor(np.eye(4), 1e-3, 1e-2, 1e-5, 1e-4)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        (
            {"imu": "imu.yaml"},
            r"imu is 'imu.yaml': give an InertialSensor, such as read_imu\(Path.* of sigmaslam.readers.inertial",
        ),
        ({"imu": replace(SENSOR, accel_density=0)}, "imu.accel_density is 0: give that of the data sheet"),
        ({"imu": replace(SENSOR, gyro_walk=float("nan"))}, "imu.gyro_walk is nan"),
        ({"imu": replace(SENSOR, T_left_imu=np.eye(3))}, r"imu.T_left_imu is .*give a rotation with a translation"),
        ({"imu": replace(SENSOR, T_left_imu=np.diag([1.0, 1.0, -1.0, 1.0]))}, "imu.T_left_imu"),
        ({"imu": replace(SENSOR, **{"gyro_density": "0.1"})}, "imu.gyro_density is '0.1'"),
        ({"imu": replace(SENSOR, T_left_imu=np.eye(4) + np.eye(4, k=-3))}, "imu.T_left_imu.*last row is 0 0 0 1"),
        ({"imu": replace(SENSOR, **{"T_left_imu": [[1.0], [0.0, 1.0]]})}, "imu.T_left_imu"),
        ({"imu": replace(SENSOR, **{"time_shift": None})}, "imu.time_shift is None"),
        ({"imu": replace(SENSOR, time_shift=float("inf"))}, "imu.time_shift is inf: give seconds"),
        ({"odometry": "wheels.csv"}, "odometry is 'wheels.csv': give an OdometrySensor"),
        ({"odometry": OdometrySensor(np.full((4, 4), np.nan))}, "odometry.T_left_base"),
    ],
)
def test_a_wrong_sensor_beside_the_cameras_is_refused(demo_sequence: Path, changed: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        StereoTracker(open_sequence(demo_sequence).camera, "klt", **changed)


def test_densities_are_numbers_of_any_kind_and_a_gyro_alone_has_none_of_forces(
    demo_sequence: Path, frames: list[StereoFrame]
):
    camera = open_sequence(demo_sequence).camera
    StereoTracker(camera, "klt", imu=replace(SENSOR, accel_density=np.inf, accel_walk=np.inf, has_accelerometer=False))
    whole = preintegrate(
        InertialSamples(np.arange(3.0), np.zeros((3, 3)), np.ones((3, 3))),
        *(0.0, 2.0, np.zeros(3), np.zeros(3), InertialSensor(np.eye(4), 1, 1, 1, 1).spectra, np.ones(2)),
    )
    assert np.linalg.eigvalsh(whole.gyro_noise + whole.accel_noise)[0] > 0.0


@pytest.mark.parametrize("delay", [10.0, float("nan"), "0.01"])
def test_a_delay_that_is_no_part_of_a_second_is_refused(demo_sequence: Path, delay: Any):
    with pytest.raises(InputError, match=r"right_delay is .*give seconds, such as 0\.01 for ten milliseconds"):
        StereoTracker(open_sequence(demo_sequence).camera, "klt", right_delay=delay)


@pytest.mark.parametrize(
    ("region", "words"),
    [
        (None, "region is None: give a bool array"),
        ("1,2,30,40", "region is '1,2,30,40'.*read_region"),
        (np.ones((3, 3), bool), r"region is 'bool \(3, 3\)'"),
        (np.ones((240, 320)), r"region is 'float64 \(240, 320\)'"),
        (np.zeros((240, 320), bool), "false everywhere"),
    ],
)
def test_a_wrong_region_is_refused(demo_sequence: Path, region: Any, words: str):
    with pytest.raises(InputError, match=words):
        ObjectTracker(open_sequence(demo_sequence).camera, region, "klt")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frontend": ["sift"]}, "there is no front-end"),
        ({"max_keypoints": "many"}, "give a whole number"),
        ({"min_probability": None}, "give a number from 0 to 1"),
    ],
)
def test_wrong_options_of_match_images_are_refused(options: dict[str, Any], words: str):
    with pytest.raises(InputError, match=words):
        sigmaslam.match_images(IMAGE, IMAGE, **{"frontend": "sift", **options})


@pytest.mark.parametrize(("threads", "name"), [(1, "MainThread"), (2, "loading")])
def test_networks_are_loaded_beside_what_else_a_start_needs(
    demo_sequence: Path, monkeypatch: pytest.MonkeyPatch, threads: int, name: str
):
    camera, loaded = open_sequence(demo_sequence).camera, []

    def load(*arguments: Any) -> Any:
        loaded.append((current_thread().name, build_frontend(*arguments)))
        return loaded[-1][1]

    monkeypatch.setattr(tracker_module, "build_frontend", load)
    tracker = StereoTracker(camera, "orb", threads=threads)
    assert len(loaded) == 1
    assert loaded[0][0].startswith(name)
    assert tracker._frontend is loaded[0][1]
    # One that is given is taken as it is, and what is wrong is said as if it had not been beside.
    assert StereoTracker(camera, tracker._frontend, threads=threads)._frontend is tracker._frontend
    with pytest.raises(InputError, match="cuda"):
        StereoTracker(camera, provider="cuda", threads=threads)
