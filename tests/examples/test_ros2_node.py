"""The example's messages, written into a bag and read back, say what the stream has said."""

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from sigmaslam.bodies.object_tracker import ObjectEstimate
from sigmaslam.geometry.se3 import quaternion_to_matrix, rotation_log, se3_exp
from sigmaslam.live.estimate_stream import describe_estimate, format_estimate
from sigmaslam.live.frame_sink import TrackedFrame
from tests.support.recorded_runs import some_estimate

ROOT = Path(__file__).resolve().parents[2]
START = 1_700_000_000


@pytest.fixture(scope="module")
def example() -> ModuleType:
    specification = importlib.util.spec_from_file_location("ros2_node", ROOT / "examples" / "ros2_node.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def frames(count: int) -> list[TrackedFrame]:
    """Poses that are turned and moved, with full covariances; the first one has none yet."""
    generator = np.random.default_rng(0)
    made = []
    for k in range(count):
        root = 0.01 * generator.normal(size=(6, 6))
        estimate = replace(
            some_estimate(START + 0.1 * k, "tracking", 1.0, 6),
            T_world_camera=se3_exp(generator.normal(size=6)) if k else np.full((4, 4), np.nan),
            covariance=root @ root.T,
        )
        made.append(TrackedFrame(k, estimate, None))
    return made


def numerical_jacobian(pose: np.ndarray, step: float = 1e-6) -> np.ndarray:
    """(6, 6) of position and rotation about fixed axes by an error in the pose's own frame."""
    columns = []
    for error in step * np.eye(6):
        moved, back = pose @ se3_exp(error), pose @ se3_exp(-error)
        turned = rotation_log(moved[:3, :3] @ back[:3, :3].T)
        columns.append(np.r_[moved[:3, 3] - back[:3, 3], turned] / (2.0 * step))
    return np.column_stack(columns)


def test_the_covariance_is_that_of_position_and_fixed_axes(example: ModuleType):
    for frame in frames(6)[1:]:
        pose, covariance = frame.result.pose, frame.result.pose_covariance
        jacobian = numerical_jacobian(pose)
        found = example.fixed_axes_covariance(covariance, pose[:3, :3])
        np.testing.assert_allclose(found, jacobian @ covariance @ jacobian.T, rtol=1e-5, atol=1e-10)
        assert not np.allclose(found, covariance, rtol=0.1)


def test_a_rotation_matrix_of_a_quaternion_equals_the_package_s(example: ModuleType):
    quaternion = np.random.default_rng(1).normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    np.testing.assert_allclose(example.rotation_matrix(quaternion), quaternion_to_matrix(quaternion), atol=1e-12)


def test_a_bag_has_every_pose_of_the_stream(example: ModuleType, tmp_path: Path):
    highlevel = pytest.importorskip("rosbags.highlevel")
    given = frames(6)
    example.main(["--bag", str(tmp_path / "bag")], [format_estimate(frame) for frame in given])
    with highlevel.AnyReader([tmp_path / "bag"]) as reader:
        assert {each.topic: each.msgtype for each in reader.connections} == example.TOPICS
        read = [(each.topic, at, reader.deserialize(content, each.msgtype)) for each, at, content in reader.messages()]
    for topic in example.TOPICS:
        messages = [(at, message) for name, at, message in read if name == topic]
        assert len(messages) == len(given) - 1  # one has no pose
        for frame, (at, message) in zip(given[1:], messages, strict=True):
            said = describe_estimate(frame)
            pose = said["T_world_camera"]
            header, of_pose = message.header, message.pose.pose
            assert at == header.stamp.sec * 10**9 + header.stamp.nanosec
            assert abs(at - said["time"] * 1e9) < 500
            assert header.frame_id == example.WORLD
            assert [getattr(of_pose.position, axis) for axis in "xyz"] == pose["position"]
            assert [getattr(of_pose.orientation, axis) for axis in "xyzw"] == pose["quaternion_xyzw"]
            rotation = quaternion_to_matrix(np.array(pose["quaternion_xyzw"]))
            expected = example.fixed_axes_covariance(np.array(said["covariance"]), rotation)
            np.testing.assert_allclose(message.pose.covariance.reshape(6, 6), expected, rtol=1e-9, atol=1e-15)
            if topic.endswith("odometry"):
                assert message.child_frame_id == example.CAMERA
                assert (np.diag(message.twist.covariance.reshape(6, 6)) == example.UNKNOWN_VARIANCE).all()


def test_a_followed_body_is_placed_in_the_camera(example: ModuleType):
    rosbags = pytest.importorskip("rosbags.typesys")
    store = rosbags.get_typestore(rosbags.Stores.LATEST)
    frame = frames(2)[1]
    line = json.loads(format_estimate(TrackedFrame(0, ObjectEstimate(frame.result), None)))
    odometry = example.messages(line, store.types.__getitem__)["/sigmaslam/odometry"]
    assert (odometry.header.frame_id, odometry.child_frame_id) == (example.CAMERA, example.OBJECT)
    assert odometry.pose.pose.position.x == line["T_camera_object"]["position"][0]


def test_a_node_publishes_both_topics(example: ModuleType):
    """Where ROS 2 is installed."""
    rclpy = pytest.importorskip("rclpy")
    publisher = example.NodePublisher()
    try:
        for topic, message in example.messages(describe_estimate(frames(2)[1]), publisher.types).items():
            publisher.publish(topic, message, 0)
        assert rclpy.ok()
    finally:
        publisher.close()
