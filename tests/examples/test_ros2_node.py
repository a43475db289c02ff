"""The ROS 2 node on stubs of ROS: frames, covariances, statuses, late and dropped pairs, jumps, and what is missing."""

import threading
import time
from array import array
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam import StereoTracker, open_sequence
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import quaternion_to_matrix, rotation_log, se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.ros_messages import stereo_from_messages
from tests.support.examples import load_example
from tests.support.recorded_runs import some_estimate
from tests.support.ros_stubs import StubBuffer, StubNode, message_class, stubbed_ros

START = 1_700_000_000 * 10**9
TOPICS = "left/image_raw", "right/image_raw"
INFOS = "left/camera_info", "right/camera_info"
# The optical frame (x to the right, y down, z ahead) in a base whose x is ahead and z up, and where the camera sits.
T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.5], [0, 0, 0, 1]])


def transform(T: np.ndarray) -> Any:
    """The message of a pose; its rotation is that of T_BASE_CAMERA, or none."""
    x, y, z, w = (-0.5, 0.5, -0.5, 0.5) if T[0, 2] else (0.0, 0.0, 0.0, 1.0)
    rotation = message_class("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
    translation = message_class("geometry_msgs/msg/Vector3")(**dict(zip("xyz", T[:3, 3].tolist(), strict=True)))
    return message_class("geometry_msgs/msg/Transform")(translation=translation, rotation=rotation)


@pytest.fixture(scope="module")
def example() -> Iterator[ModuleType]:
    with stubbed_ros():
        yield load_example("ros2_node")


@pytest.fixture
def start(example: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Any]]:
    """Starts a node with parameters; the camera's place on the robot is known."""
    nodes = []
    monkeypatch.setattr(StubBuffer, "transforms", {("base_link", "left_optical"): transform(T_BASE_CAMERA)})

    def start(**given: Any) -> Any:
        monkeypatch.setattr(StubNode, "given", {"threads": 1, "frontend": "klt", "check": False, **given})
        nodes.append(example.SigmaSlamNode())
        return nodes[-1]

    yield start
    for node in nodes:
        node.destroy_node()


def header(nanoseconds: int) -> Any:
    stamp = message_class("builtin_interfaces/msg/Time")(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return message_class("std_msgs/msg/Header")(stamp=stamp, frame_id="left_optical")


def nanoseconds(message: Any) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def image(pixels: np.ndarray, at: int) -> Any:
    height, width = pixels.shape
    fields = {
        "height": height,
        "width": width,
        "encoding": "mono8",
        "step": width,
        "data": array("B", pixels.tobytes()),
    }
    return message_class("sensor_msgs/msg/Image")(header=header(at), **fields)


def camera_infos(sequence: StereoSequence) -> list[Any]:
    """What a driver would say of the raw images."""
    rectifier, made = StereoRectifier(sequence.camera), []
    rectified = rectifier.rectified
    for eye, (model, R) in enumerate(
        [
            (sequence.camera.left, rectifier.R_rectified_left),
            (sequence.camera.right, rectifier.R_rectified_right),
        ]
    ):
        P = np.array([[rectified.fx, 0, rectified.cx, 0], [0, rectified.fy, rectified.cy, 0], [0, 0, 1, 0]])
        P[0, 3] = -eye * rectified.fx * rectified.baseline
        made.append(
            message_class("sensor_msgs/msg/CameraInfo")(
                width=model.width,
                height=model.height,
                distortion_model="plumb_bob",
                d=[*map(float, model.distortion), *[0.0] * 5][:5],
                k=model.matrix.ravel().tolist(),
                r=R.ravel().tolist(),
                p=P.ravel().tolist(),
            )
        )
    return made


def tell_calibration(node: Any, sequence: StereoSequence) -> None:
    for topic, message in zip(INFOS, camera_infos(sequence), strict=True):
        node.deliver(topic, message)


def wait_for(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < until, "nothing came for 30 s"
        time.sleep(0.002)


def deliver(node: Any, frame: StereoFrame, at: int, later: int = 0) -> None:
    """Both eyes, the right one later by some nanoseconds."""
    node.deliver(TOPICS[0], image(frame.left, at))
    node.deliver(TOPICS[1], image(frame.right, at + later))


def track(node: Any, frames: list[StereoFrame], later: int = 0) -> None:
    """Delivers frames, each when the one before is tracked."""
    for frame in frames:
        count = len(said(node))
        deliver(node, frame, START + round(1e9 * frame.timestamp), later)
        wait_for(lambda count=count: len(said(node)) > count)


def said(node: Any) -> list[tuple[bytes, str]]:
    """Level and words of every diagnosis."""
    return [(each.status[0].level, each.status[0].message) for each in node.published["/diagnostics"]]


def matrix(message: Any) -> np.ndarray:
    """(4, 4) of a Pose or a Transform."""
    place, turn = ("position", "orientation") if hasattr(message, "position") else ("translation", "rotation")
    T = np.eye(4)
    T[:3, 3] = [getattr(getattr(message, place), axis) for axis in "xyz"]
    T[:3, :3] = quaternion_to_matrix(np.array([getattr(getattr(message, turn), axis) for axis in "xyzw"]))
    return T


def transforms(node: Any, parent: str, child: str) -> list[np.ndarray]:
    sent = [each for each in node.published["/tf"] if each.header.frame_id == parent and each.child_frame_id == child]
    return [matrix(each.transform) for each in sent]


def numerical_jacobian(pose: Callable[[np.ndarray], np.ndarray], step: float = 1e-6) -> np.ndarray:
    """(6, 6) of position and rotation about fixed axes by the error that a pose is a function of."""
    columns = []
    for error in step * np.eye(6):
        moved, back = pose(error), pose(-error)
        turned = rotation_log(moved[:3, :3] @ back[:3, :3].T)
        columns.append(np.r_[moved[:3, 3] - back[:3, 3], turned] / (2.0 * step))
    return np.column_stack(columns)


def assert_agree(node: Any, estimates: list[Any], times: list[int]) -> None:
    """What was published is what the tracker says of these frames, in the frames and the order of ROS."""
    poses, odometries = node.published["~/pose"], node.published["~/odometry"]
    assert [nanoseconds(each) for each in poses] == times
    assert [nanoseconds(each) for each in odometries] == times
    chains = zip(transforms(node, "map", "odom"), transforms(node, "odom", "base_link"), strict=True)
    for estimate, pose, odometry, chain in zip(estimates, poses, odometries, chains, strict=True):
        assert (pose.header.frame_id, odometry.header.frame_id) == ("map", "odom")
        assert odometry.child_frame_id == "base_link"
        T_camera = estimate.T_world_camera

        def base(error: np.ndarray, T_camera: np.ndarray = T_camera) -> np.ndarray:
            return T_BASE_CAMERA @ T_camera @ se3_exp(error) @ se3_inverse(T_BASE_CAMERA)

        np.testing.assert_allclose(matrix(pose.pose.pose), base(np.zeros(6)), atol=1e-9)
        np.testing.assert_allclose(chain[0] @ chain[1], base(np.zeros(6)), atol=1e-9)
        jacobian = numerical_jacobian(base)
        expected = jacobian @ estimate.covariance @ jacobian.T
        found = np.reshape(pose.pose.covariance, (6, 6))
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("source", ["demo", "kitti_raw_0926_0039_a", "euroc_mh01_f000_099"])
@pytest.mark.long
def test_a_recording_gives_the_tracker_s_poses_in_ros_frames(
    source: str, start: Callable[..., Any], demo_sequence: Path, request: pytest.FixtureRequest
):
    recording = demo_sequence if source == "demo" else request.getfixturevalue("real_data") / source
    sequence = open_sequence(recording)
    frames = [frame for frame, _ in zip(sequence.frames(), range(6), strict=False)]
    begin = frames[0].timestamp
    frames = [replace(frame, timestamp=frame.timestamp - begin) for frame in frames]
    node = start(slop=0.004)
    tell_calibration(node, sequence)
    track(node, frames, later=3_000_000)
    tracker = StereoTracker(stereo_from_messages(*camera_infos(sequence), TOPICS, INFOS), "klt", threads=1)
    stamps = [START + round(1e9 * frame.timestamp) for frame in frames]
    estimates = [
        tracker.step(frame.left, frame.right, (stamp - START) / 1e9)
        for frame, stamp in zip(frames, stamps, strict=True)
    ]
    published = [each.status in ("tracking", "doubtful", "ambiguous") for each in estimates]
    assert sum(published) == 5
    assert_agree(node, np.array(estimates)[published], np.array(stamps)[published].tolist())
    for estimate, (level, words) in zip(estimates, said(node), strict=True):
        assert words.startswith(estimate.status)
        assert level == (b"\0" if estimate.status == "tracking" else b"\1")
    if source.startswith("kitti"):  # a car that drives ahead: x of the base, not z of the camera (REP-103)
        ahead, left, up = matrix(node.published["~/pose"][-1].pose.pose)[:3, 3]
        speed = node.published["~/odometry"][-1].twist.twist.linear
        assert ahead > max(1.0, 5.0 * abs(left), 50.0 * abs(up))
        assert speed.x == pytest.approx(ahead / frames[-1].timestamp, rel=0.2)


@pytest.fixture
def demo(demo_sequence: Path) -> tuple[StereoSequence, list[StereoFrame]]:
    sequence = open_sequence(demo_sequence)
    return sequence, [frame for frame, _ in zip(sequence.frames(), range(8), strict=False)]


@pytest.mark.long
def test_frames_without_a_pose_give_diagnostics_alone(start: Callable[..., Any], demo: Any):
    sequence, frames = demo
    node, black = start(), np.zeros_like(frames[0].left)
    tell_calibration(node, sequence)
    frames[3] = replace(frames[2], timestamp=frames[3].timestamp)  # the driver freezes
    frames[4] = replace(frames[4], left=black, right=black.copy())
    track(node, frames[:6])
    words = [words for _, words in said(node)]
    assert [each.split(";")[0] for each in words] == ["starting", "tracking", "tracking", "skipped", "lost", "tracking"]
    assert [level for level, _ in said(node)] == [b"\1", b"\0", b"\0", b"\1", b"\2", b"\0"]
    assert len(node.published["~/pose"]) == len(node.published["~/odometry"]) == 3
    unknown = np.reshape(node.published["~/odometry"][-1].twist.covariance, (6, 6))
    assert (np.diag(unknown) == 1e6).all()


class Scripted:
    """In place of a tracker: estimates that a test gives, and a gate that holds it up."""

    def __init__(self, estimates: list[Any]) -> None:
        self._estimates = iter(estimates)
        self.begun, self.gate = threading.Event(), threading.Event()
        self.gate.set()
        self.stamps: list[float] = []

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float, mask: np.ndarray | None) -> Any:
        self.stamps.append(timestamp)
        self.begun.set()
        self.gate.wait(30.0)
        return replace(next(self._estimates), timestamp=timestamp)


def scripted(node: Any, estimates: list[Any]) -> Scripted:
    tracker = Scripted(estimates)
    node._tracker, node._T_base_camera = tracker, T_BASE_CAMERA
    return tracker


def blank(count: int) -> list[StereoFrame]:
    return [StereoFrame(k, 0.1 * k, *np.full((2, 12, 16), k, np.uint8)) for k in range(count)]


@pytest.mark.parametrize(
    ("status", "level", "published"),
    [
        ("tracking", b"\0", True),
        ("doubtful", b"\1", True),
        ("ambiguous", b"\1", True),
        ("relocalised", b"\1", True),
        ("skipped", b"\1", False),
        ("starting", b"\1", False),
        ("of another version", b"\1", False),
        ("lost", b"\2", False),
    ],
)
def test_every_status_has_its_level(start: Callable[..., Any], status: str, level: bytes, published: bool):
    node = start()
    scripted(node, [some_estimate(0.0, status, 1.0, 6)])
    track(node, blank(1))
    assert said(node) == [(level, status)]
    assert len(node.published["~/pose"]) == len(node.published["~/odometry"]) == published


def test_the_newest_pair_waits_and_those_between_are_dropped(start: Callable[..., Any]):
    node = start()
    tracker = scripted(node, [some_estimate(0.0, "tracking", 1.0, 6)] * 2)
    tracker.gate.clear()
    frames = blank(6)
    for frame in frames:
        began = time.monotonic()
        deliver(node, frame, START + round(1e9 * frame.timestamp))
        assert time.monotonic() - began < 0.5  # no callback waits for the tracker
        tracker.begun.wait(30.0)
    tracker.gate.set()
    wait_for(lambda: len(said(node)) == 2)
    assert tracker.stamps == [0.0, 0.5]
    values = {each.key: each.value for each in node.published["/diagnostics"][-1].status[0].values}
    assert values["dropped"] == "4"


def test_a_late_pair_is_dropped_and_the_next_one_is_tracked(start: Callable[..., Any]):
    node = start()
    tracker = scripted(node, [some_estimate(0.0, "tracking", 1.0, 6)] * 3)
    frames = blank(4)
    track(node, [frames[0], frames[2], frames[1], frames[3]])
    assert said(node)[2] == (b"\1", "a pair came 0.100 s late and is dropped")
    assert tracker.stamps == pytest.approx([0.0, 0.2, 0.3])
    assert len(node.published["~/pose"]) == 3


def test_eyes_further_apart_than_the_slop_are_no_pair(start: Callable[..., Any]):
    node = start(slop=0.002)
    [frame] = blank(1)
    deliver(node, frame, START, later=3_000_000)
    node._heard_at -= 5.0
    for timer in node.timers:
        timer()
    [(level, words)] = said(node)
    assert level == b"\2"
    assert "no pair of images for 5.0 s" in words
    assert "1 on left/image_raw, 1 on right/image_raw: raise `slop`" in words


def test_what_is_remapped_is_heard_by_its_own_name(start: Callable[..., Any], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(StubNode, "remapped", {"left/image_raw": "/cam/l/image_rect", "right/camera_info": "/info"})
    node = start()
    assert node._topics == ["/cam/l/image_rect", "right/image_raw"]
    assert node._info_topics == ["/cam/l/camera_info", "/info"]
    assert {*node.subscribers} == {"left/image_raw", "right/image_raw", "/cam/l/camera_info", "right/camera_info"}


def test_without_a_slop_equal_stamps_are_a_pair(start: Callable[..., Any], demo: Any):
    node = start(slop=0.0)
    tell_calibration(node, demo[0])
    track(node, blank(1))


def test_what_is_missing_is_said_and_waited_for(start: Callable[..., Any], demo: Any):
    sequence, frames = demo
    mounting = StubBuffer.transforms.pop(("base_link", "left_optical"))
    node = start()
    track(node, frames[:1])
    node.deliver(INFOS[0], camera_infos(sequence)[0])
    track(node, frames[1:2])
    node.deliver(INFOS[1], camera_infos(sequence)[1])
    track(node, frames[2:3])
    StubBuffer.transforms["base_link", "left_optical"] = mounting
    track(node, frames[3:5])
    words = [words for _, words in said(node)]
    assert "waiting for camera_info on left/camera_info and right/camera_info" in words[0]
    assert "waiting for camera_info on right/camera_info, or" in words[1]
    assert "waiting for the transform from base_link to the camera, left_optical" in words[2]
    assert words[3:] == ["starting", "tracking"]


@pytest.mark.long
def test_the_first_pairs_correct_the_rows_of_a_turned_camera(start: Callable[..., Any], demo_sequence: Path):
    sequence = open_sequence(demo_sequence)
    frames = [frame for frame, _ in zip(sequence.frames(), range(19), strict=False)]
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians((1.0, 0.0, 0.0)))[0]
    sequence.camera = replace(sequence.camera, T_left_right=sequence.camera.T_left_right @ turn)
    statuses = []
    for check in (False, True):
        node = start(check=check)
        tell_calibration(node, sequence)
        track(node, frames)
        statuses.append([words.split(";")[0] for _, words in said(node)])
    assert statuses[0] == ["starting"] * 19  # rows are 5 px off
    assert statuses[1][0] == "waiting for 16 more pairs of images, to check the cameras"
    assert statuses[1][16:] == ["starting", "tracking", "tracking"]
    assert node.logged[0].startswith("rows: ")
    assert "corrected" in node.logged[0]


@pytest.mark.long
def test_pairs_that_show_nothing_or_are_of_another_size_check_no_camera(start: Callable[..., Any], demo_sequence: Path):
    sequence = open_sequence(demo_sequence)
    frames = [frame for frame, _ in zip(sequence.frames(), range(36), strict=False)]
    black = np.zeros_like(frames[0].left)
    frames[:17] = [replace(each, left=black, right=black) for each in frames[:17]]  # behind a cap
    frames[17] = replace(frames[17], left=frames[17].left[::2].copy())
    node = start(check=True)
    tell_calibration(node, sequence)
    track(node, frames)
    words = [words.split(";")[0] for _, words in said(node)]
    assert words[16].startswith("waiting for images by which to check the cameras: ")
    assert words[17].startswith("waiting for 16 more pairs")
    assert words[33:] == ["starting", "tracking", "tracking"]
    assert node.logged == []


def test_what_cannot_be_used_ends_the_node_with_a_reason(start: Callable[..., Any], demo: Any, tmp_path: Path):
    sequence, frames = demo
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((240, 320), np.uint8))
    for given, kind, words in [
        ({"mask": str(tmp_path / "mask.png")}, InputError, "zero everywhere"),
        ({"map": str(tmp_path / "map.npz")}, InputError, r"map\.npz.*no such file"),
        ({"calibration": str(tmp_path / "stereo.yaml")}, CalibrationError, r"stereo\.yaml"),
        ({"frontend": "fast"}, InputError, "there is no front-end 'fast'"),
    ]:
        node = start(**given)
        tell_calibration(node, sequence)
        track(node, frames[:1])
        wait_for(lambda node=node: node.failure is not None)
        with pytest.raises(kind, match=words):
            raise node.failure
        assert said(node)[-1] == (b"\2", str(node.failure))
        assert "Traceback" in node.logged[0]
    node = start()
    deliver(node, frames[0], 0)
    wait_for(lambda: node.failure is not None)
    assert "no time stamps" in str(node.failure)


def test_an_image_that_cannot_be_used_is_said_and_the_next_one_is_tracked(start: Callable[..., Any], demo: Any):
    sequence, frames = demo
    node = start()
    tell_calibration(node, sequence)
    small = replace(frames[1], left=frames[1].left[::2].copy())
    track(node, [frames[0], small, *frames[2:4]])
    assert [words.split(";")[0] for _, words in said(node)][2:] == ["tracking", "tracking"]
    level, words = said(node)[1]
    assert level == b"\2"
    assert "left image is 320x120, its calibration is for 320x240" in words


def test_another_node_s_odometry_is_completed(start: Callable[..., Any]):
    """map -> odom alone is given, so that map -> odom -> base_link is the pose."""
    T_odom_base = np.eye(4)
    T_odom_base[:3, 3] = 4.0, 5.0, 6.0
    node = start(publish_odom_tf=False)
    estimate = replace(some_estimate(0.0, "tracking", 1.0, 6), T_world_camera=se3_exp(np.arange(6.0) / 10.0))
    scripted(node, [estimate] * 2)
    frames = blank(2)
    track(node, frames[:1])
    assert said(node)[0][0] == b"\1"
    assert "tracking; no odom -> base_link of another node" in said(node)[0][1]
    StubBuffer.transforms["odom", "base_link"] = transform(T_odom_base)
    track(node, frames[1:])
    assert said(node)[1] == (b"\0", "tracking")
    assert not transforms(node, "odom", "base_link")
    [T_map_odom] = transforms(node, "map", "odom")
    np.testing.assert_allclose(T_map_odom @ T_odom_base, matrix(node.published["~/pose"][1].pose.pose), atol=1e-9)


def test_a_loop_and_a_return_jump_in_the_map_and_not_in_odom(start: Callable[..., Any]):
    """Two metres a second ahead; a loop at frame 3 moves the map by a metre, a return at frame 7 by two."""
    node, estimates = start(), []
    statuses = ["tracking"] * 6 + ["lost", "relocalised", "tracking", "tracking"]
    for k, status in enumerate(statuses):
        T = np.eye(4)
        T[:3, 3] = 1.0 * (k > 3) + 2.0 * (k > 6), 0.0, 0.2 * k
        loop = 0.0 if k == 3 else None
        estimates.append(replace(some_estimate(0.1 * k, status, 1.0, 6), T_world_camera=T, loop=loop))
    scripted(node, estimates)
    track(node, blank(10))
    poses = [matrix(each.pose.pose) for each in node.published["~/pose"]]
    in_odom = [matrix(each.pose.pose) for each in node.published["~/odometry"]]
    # Lost, the base has moved on; the odometry does not know by how much.
    np.testing.assert_allclose([each[0, 3] for each in in_odom], 0.2 * np.r_[0:6, 5:8], atol=1e-9)
    np.testing.assert_allclose([each[1, 3] for each in in_odom], 0.0, atol=1e-9)
    np.testing.assert_allclose([each[1, 3] for each in poses], np.repeat([0.0, -1.0, -3.0], [4, 2, 3]), atol=1e-9)
    for pose, odometry, T_map_odom in zip(poses, in_odom, transforms(node, "map", "odom"), strict=True):
        np.testing.assert_allclose(T_map_odom @ odometry, pose, atol=1e-9)
    speeds = [each.twist.twist.linear.x for each in node.published["~/odometry"]]
    np.testing.assert_allclose(speeds, [0, 2, 2, 2, 2, 2, 0, 2, 2], atol=1e-9)
    spreads = [np.trace(np.reshape(each.pose.covariance, (6, 6))) for each in node.published["~/odometry"]]
    assert spreads[3] < spreads[4] < spreads[6]  # what was not known before a jump stays


def test_what_is_left_out_after_a_loss_stays_in_the_covariance(example: ModuleType):
    generator = np.random.default_rng(1)
    before, after, later = (se3_exp(generator.normal(size=6)) for _ in range(3))
    odometry, tiny = example.ContinuousOdometry(), 1e-6 * np.eye(6)
    odometry.update(1.0, before, tiny, tiny, False)
    odometry.forget_velocity()
    for seconds, pose, jumps in ((2.0, after, True), (2.1, later, False)):
        odometry.update(seconds, pose, tiny, tiny, jumps)
        error = se3_log(se3_inverse(odometry.pose) @ pose)
        assert error @ np.linalg.solve(odometry.covariance, error) < 1.5


def test_a_velocity_and_its_covariance_are_those_of_two_poses(example: ModuleType):
    generator = np.random.default_rng(0)
    twist, first = generator.normal(size=6), se3_exp(generator.normal(size=6))
    second = first @ se3_exp(0.1 * twist)
    roots = 0.01 * generator.normal(size=(2, 6, 6))
    spread = roots @ roots.transpose(0, 2, 1)
    odometry = example.ContinuousOdometry()
    odometry.update(1.0, first, spread[0], spread[0], False)
    assert (odometry.twist_covariance == 1e6 * np.eye(6)).all()
    odometry.update(1.1, second, spread[1], spread[1], False)
    np.testing.assert_allclose(odometry.twist, twist, rtol=1e-9)

    def velocity(errors: np.ndarray) -> np.ndarray:
        moved = se3_inverse(first @ se3_exp(errors[:6])) @ second @ se3_exp(errors[6:])
        return se3_log(se3_inverse(se3_exp(0.1 * twist)) @ moved) / 0.1  # in the base as it is now

    jacobian = np.column_stack([(velocity(e) - velocity(-e)) / 2e-6 for e in 1e-6 * np.eye(12)])
    joint = np.zeros((12, 12))
    joint[:6, :6], joint[6:, 6:] = spread
    np.testing.assert_allclose(odometry.twist_covariance, jacobian @ joint @ jacobian.T, rtol=1e-5, atol=1e-9)
    odometry.forget_velocity()
    assert not odometry.twist.any()


def test_the_covariance_is_that_of_position_and_fixed_axes(example: ModuleType):
    generator = np.random.default_rng(0)
    for _ in range(5):
        pose, root = se3_exp(generator.normal(size=6)), generator.normal(size=(6, 6))
        covariance = root @ root.T
        jacobian = numerical_jacobian(lambda error, pose=pose: pose @ se3_exp(error))
        message = example.with_covariance(pose, covariance)
        np.testing.assert_allclose(matrix(message.pose), pose, atol=1e-12)
        found = np.reshape(message.covariance, (6, 6))
        np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, rtol=1e-5, atol=1e-7)
        # The lever from the camera to the base: their variances differ.
        assert not np.allclose(turn_covariance(T_BASE_CAMERA, covariance), covariance, rtol=0.1)


def test_main_ends_with_the_reason(example: ModuleType, monkeypatch: pytest.MonkeyPatch, start: Callable[..., Any]):
    start()  # stubs know the camera's place
    calls = []
    rclpy = example.rclpy
    monkeypatch.setattr(rclpy, "init", lambda args: calls.append("init"))
    monkeypatch.setattr(rclpy, "ok", lambda: True)
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: calls.append("shutdown"))

    def spin_once(node: Any, timeout_sec: float) -> None:
        deliver(node, blank(1)[0], 0)
        with suppress(AssertionError):
            wait_for(lambda: node.failure is not None)

    monkeypatch.setattr(rclpy, "spin_once", spin_once)
    with pytest.raises(SystemExit, match="error: images on left/image_raw have no time stamps"):
        example.main()
    assert calls == ["init", "shutdown"]


def test_a_signal_while_a_frame_is_tracked_ends_quietly(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, start: Callable[..., Any]
):
    """As rclpy: spinning raises, and publishers of a context that is shut down do, too."""
    start()
    rclpy, nodes, is_on, crashes = example.rclpy, [], [True], []
    monkeypatch.setattr(rclpy, "init", lambda args: None)
    monkeypatch.setattr(rclpy, "ok", lambda: is_on[0])
    monkeypatch.setattr(rclpy, "try_shutdown", lambda: None)
    monkeypatch.setattr(threading, "excepthook", crashes.append)

    def refuse(message: Any) -> None:
        raise RuntimeError("Failed to publish: publisher's context is invalid")

    def spin_once(node: Any, timeout_sec: float) -> None:
        nodes.append(node)
        is_on[0] = False
        node._diagnostics.publish = refuse
        deliver(node, blank(1)[0], 0)
        time.sleep(0.1)
        raise example.ExternalShutdownException

    monkeypatch.setattr(rclpy, "spin_once", spin_once)
    example.main()
    assert nodes[0].failure is None
    assert not crashes
