"""Poses of `sigmaslam track --stream` as ROS 2 messages: published where rclpy is installed, or written into a bag.

    sigmaslam track RECORDING --out run --stream stdout | python examples/ros2_node.py
    sigmaslam track RECORDING --out run --stream stdout | python examples/ros2_node.py --bag poses
    python examples/ros2_node.py --udp 5005      # beside: sigmaslam track ... --stream udp://127.0.0.1:5005

It needs numpy, and rclpy or (for --bag) rosbags, but not sigmaslam: ROS may have another Python. Topics are
/sigmaslam/pose (PoseWithCovarianceStamped) and /sigmaslam/odometry (Odometry); frames without a pose give no message.
The axes are a camera's: x to the right, y down, z ahead, in both frames.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

import numpy as np

WORLD, CAMERA, OBJECT = "sigmaslam_world", "left_camera_optical_frame", "sigmaslam_object"
TOPICS = {
    "/sigmaslam/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/sigmaslam/odometry": "nav_msgs/msg/Odometry",
}
# Velocities are not told: a variance that gives those of a message no weight, (m/s)^2 and (rad/s)^2.
UNKNOWN_VARIANCE = 1e6

Types = Callable[[str], Any]
"""The class of a message by its name, of rclpy or of rosbags: both take fields as keywords."""


class Publisher(Protocol):
    """Where messages go."""

    types: Types

    def publish(self, topic: str, message: Any, nanoseconds: int) -> None:
        """Takes a message of that time."""

    def close(self) -> None:
        """The last one has come."""


def fixed_axes_covariance(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The covariance of a pose as ROS has it: of x, y, z and of rotations about the fixed axes of the parent frame.

    An error (translation t, rotation r) in the pose's own frame moves the position by R t, and turns by R r about the
    fixed axes: R exp(r) = exp(R r) R.

    Args:
        covariance: (6, 6) in the pose's own frame, translation before rotation.
        rotation: (3, 3) R of the pose.
    """
    turn = np.kron(np.eye(2), rotation)
    return turn @ covariance @ turn.T


def rotation_matrix(quaternion: Iterable[float]) -> np.ndarray:
    """(3, 3) of a unit quaternion (x, y, z, w)."""
    *vector, w = quaternion
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2.0 * w * cross + 2.0 * cross @ cross


def messages(line: dict[str, Any], types: Types) -> dict[str, Any]:
    """Messages by topic for a line of the stream; none without a pose and its covariance."""
    of_object = "T_camera_object" in line
    pose = line["T_camera_object" if of_object else "T_world_camera"]
    if pose is None or line["covariance"] is None:
        return {}
    parent, child = (CAMERA, OBJECT) if of_object else (WORLD, CAMERA)
    covariance = fixed_axes_covariance(np.array(line["covariance"]), rotation_matrix(pose["quaternion_xyzw"]))
    nanoseconds = stamp(line)
    time = types("builtin_interfaces/msg/Time")(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    header = types("std_msgs/msg/Header")(stamp=time, frame_id=parent)
    with_covariance = types("geometry_msgs/msg/PoseWithCovariance")(
        pose=types("geometry_msgs/msg/Pose")(
            position=types("geometry_msgs/msg/Point")(**dict(zip("xyz", pose["position"], strict=True))),
            orientation=types("geometry_msgs/msg/Quaternion")(
                **dict(zip("xyzw", pose["quaternion_xyzw"], strict=True))
            ),
        ),
        covariance=covariance.ravel(),
    )
    vector = types("geometry_msgs/msg/Vector3")
    at_rest = types("geometry_msgs/msg/Twist")(linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    twist = types("geometry_msgs/msg/TwistWithCovariance")(
        twist=at_rest, covariance=(UNKNOWN_VARIANCE * np.eye(6)).ravel()
    )
    pose_class, odometry_class = (types(kind) for kind in TOPICS.values())
    made = (
        pose_class(header=header, pose=with_covariance),
        odometry_class(header=header, child_frame_id=child, pose=with_covariance, twist=twist),
    )
    return dict(zip(TOPICS, made, strict=True))


def stamp(line: dict[str, Any]) -> int:
    """Time of a line, nanoseconds."""
    return round(line["time"] * 1e9)


class NodePublisher:
    """A ROS 2 node."""

    def __init__(self) -> None:
        import rclpy

        self._rclpy = rclpy
        rclpy.init()
        self._node = rclpy.create_node("sigmaslam")
        self._topics = {
            topic: self._node.create_publisher(self.types(kind), topic, 10) for topic, kind in TOPICS.items()
        }

    @staticmethod
    def types(name: str) -> Any:
        """The class that ROS has made of a definition."""
        from importlib import import_module

        package, _, kind = name.split("/")
        return getattr(import_module(f"{package}.msg"), kind)

    def publish(self, topic: str, message: Any, nanoseconds: int) -> None:
        """Publishes a message; its header has the time."""
        self._topics[topic].publish(message)

    def close(self) -> None:
        """Ends the node."""
        self._node.destroy_node()
        self._rclpy.shutdown()


class BagPublisher:
    """A new ROS 2 bag, readable without ROS.

    Args:
        path: of the folder to make.
    """

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag2 import Writer
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.LATEST)
        self._writer = Writer(path, version=9)
        self._writer.open()
        self._connections = {
            topic: self._writer.add_connection(topic, kind, typestore=self._store) for topic, kind in TOPICS.items()
        }

    def types(self, name: str) -> Any:
        """The class that rosbags has made of a definition."""
        return self._store.types[name]

    def publish(self, topic: str, message: Any, nanoseconds: int) -> None:
        """Writes a message."""
        content = self._store.serialize_cdr(message, TOPICS[topic])
        self._writer.write(self._connections[topic], nanoseconds, content)

    def close(self) -> None:
        """Writes what a bag ends with."""
        self._writer.close()


def datagrams(port: int) -> Iterator[bytes]:
    """Datagrams that come to a port of this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", port))
        while True:
            yield receiver.recv(65536)


def main(arguments: list[str] | None = None, lines: Iterable[bytes] | None = None) -> None:
    """Entry point; lines come from the standard input unless they are given, or `--udp` says else."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--bag", type=Path, help="write a new ROS 2 bag in this folder instead of publishing")
    parser.add_argument("--udp", type=int, help="port of 127.0.0.1 to listen to instead of the standard input")
    given = parser.parse_args(arguments)
    publisher: Publisher = NodePublisher() if given.bag is None else BagPublisher(given.bag)
    try:
        for text in lines or (sys.stdin.buffer if given.udp is None else datagrams(given.udp)):
            line = json.loads(text)
            for topic, message in messages(line, publisher.types).items():
                publisher.publish(topic, message, stamp(line))
    except KeyboardInterrupt:
        pass
    finally:
        publisher.close()


if __name__ == "__main__":
    main()
