"""A ROS 2 node that tracks a stereo camera in its own process: images in; pose, odometry, tf and diagnostics out.

    python examples/ros2_node.py --ros-args -r __ns:=/stereo -p base_frame:=base_link -p map:=run/map.npz

It needs ROS 2 (rclpy, message_filters, tf2_ros) and sigmaslam in one Python. IT HAS BEEN TESTED AGAINST STUBS OF ROS
ONLY, with recorded images (tests/examples/test_ros2_node.py), and on no robot yet.

In: `left/image_raw`, `right/image_raw` (Image; with `rect` in place of `raw` in the names: rectified), `camera_info`
beside each, and tf from `base_frame` to the optical frame of the left images (x to the right, y down, z ahead).
Out: `~/pose` (PoseWithCovarianceStamped of the base in `map_frame`), `~/odometry` (Odometry of the base in
`odom_frame`, without jumps; twist in the base), tf `map_frame` -> `odom_frame` -> `base_frame` (REP-105), and
`/diagnostics` (DiagnosticArray): ok while `tracking`, a warning or an error else.

`map_frame` has the axes of the base (x ahead, y to the left, z up: REP-103) at the first pose, or those of the map; not
levelled. No pose is published of a frame that is lost, skipped or starting. While one pair is tracked the
newest one waits, those between are dropped, and so are late ones; how many is in the diagnostics.
"""

from __future__ import annotations

import sys
import threading
import time
import traceback
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

try:
    import geometry_msgs.msg as geometry
    import rclpy
    from builtin_interfaces.msg import Time as Stamp
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from message_filters import ApproximateTimeSynchronizer, Subscriber
    from nav_msgs.msg import Odometry
    from rclpy.executors import ExternalShutdownException
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.time import Time
    from sensor_msgs.msg import CameraInfo, Image
    from std_msgs.msg import Header
    from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener
except ImportError as error:
    sys.exit(f"{error.name} is not there: source ROS 2's setup.bash, in a Python that has sigmaslam as well")

from sigmaslam import Estimate, StereoCamera, StereoTracker
from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.checks.check import PAIRS_BEFORE_TRACKING, check_pairs
from sigmaslam.checks.finding import wrong
from sigmaslam.errors import FrameError, InputError
from sigmaslam.geometry.se3 import (
    matrix_to_quaternion,
    quaternion_to_matrix,
    se3_exp,
    se3_inverse,
    se3_log,
    turn_covariance,
)
from sigmaslam.readers.images import GreyConverter
from sigmaslam.readers.masks import read_mask
from sigmaslam.readers.ros_messages import image_array, stamp_ns, stereo_from_messages

PARAMETERS = {
    "left": "left/image_raw",
    "right": "right/image_raw",
    "slop": 0.002,  # seconds by which the stamps of both eyes may differ; 0: they must be equal
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "publish_odom_tf": True,  # false: another node gives odom -> base, such as wheels
    "calibration": "",  # file in place of the CameraInfo, any that `sigmaslam track --calibration` reads
    "check": True,  # the first 17 pairs, which are not tracked, and correct what is wrong with the right eye's rows
    "mask": "",  # image, black where the left image is not used
    "map": "",  # map.npz of an earlier run with the same camera on the same robot
    "frontend": "learned",
    "threads": 2,
}
PUBLISHED = ("tracking", "doubtful", "ambiguous", "relocalised")
"""Statuses whose pose images have given."""
UNSEEN = ("exposure", "overlap")
"""Findings of images that show nothing of the cameras, as behind a cap."""
# A variance that gives a velocity that is not known no weight, (m/s)^2 and (rad/s)^2.
UNKNOWN_VARIANCE = 1e6
# Seconds without a pair of images until that is an error.
SILENCE = 1.0


@dataclass
class ContinuousOdometry:
    """The base in the odom frame: its motion without what loops and returns change, which goes into map -> odom.

    Attributes:
        T_odom_map: (4, 4); the identity until the first jump.
        pose: (4, 4) T_odom_base; None before the first pose.
        covariance: (6, 6) of it in the base; what was known before a jump stays in it.
        twist: (6,) of the base in its own frame, m/s and rad/s; zero where it is not known.
        twist_covariance: (6, 6) of it.
    """

    T_odom_map: np.ndarray = field(default_factory=lambda: np.eye(4))
    pose: np.ndarray | None = None
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    twist: np.ndarray = field(default_factory=lambda: np.zeros(6))
    twist_covariance: np.ndarray = field(default_factory=lambda: UNKNOWN_VARIANCE * np.eye(6))
    _before_jumps: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))  # perturbed from the left in odom
    _last: tuple[float, np.ndarray] | None = None  # time, and covariance of the last frame since its keyframe

    def forget_velocity(self) -> None:
        """A frame had no pose."""
        self._last = None
        self.twist, self.twist_covariance = np.zeros(6), UNKNOWN_VARIANCE * np.eye(6)

    def update(
        self, seconds: float, T_map_base: np.ndarray, covariance: np.ndarray, since_key: np.ndarray, jumps: bool
    ) -> None:
        """Takes a pose with its covariance in the base, and the part of that since the last keyframe.

        Where it `jumps`, by what a loop or a return corrects, the motion is taken to go on as it was.
        """
        before, step = self.pose, None if self._last is None else seconds - self._last[0]
        if jumps and before is not None:
            expected = before @ se3_exp(self.twist * (step or 0.0))
            left_out = se3_log(se3_inverse(expected) @ self.T_odom_map @ T_map_base) * (step is None)  # while lost
            self.T_odom_map = expected @ se3_inverse(T_map_base)
            self._before_jumps = turn_covariance(before, self.covariance + np.outer(left_out, left_out))
        self.pose = self.T_odom_map @ T_map_base
        self.covariance = covariance + turn_covariance(se3_inverse(self.pose), self._before_jumps)
        if before is not None and step is not None and self._last is not None and not jumps:
            moved = se3_inverse(before) @ self.pose
            self.twist = se3_log(moved) / step
            # Both are known relative to their keyframe.
            self.twist_covariance = (turn_covariance(se3_inverse(moved), self._last[1]) + since_key) / step**2
        self._last = seconds, since_key


class SigmaSlamNode(Node):
    """Tracks in a thread of its own, so that callbacks never wait for it.

    Attributes:
        failure: why the node cannot go on; None while it can.
    """

    def __init__(self) -> None:
        super().__init__("sigmaslam")
        self._given = {name: self.declare_parameter(name, default).value for name, default in PARAMETERS.items()}
        self._topics = [self.resolve_topic_name(self._given[eye]) for eye in ("left", "right")]
        infos = [self._find_info_topic(self._given[eye]) for eye in ("left", "right")]
        self._info_topics = [self.resolve_topic_name(topic) for topic in infos]
        self.failure: Exception | None = None
        self._infos: list[CameraInfo | None] = [None, None]
        self._heard, self._dropped, self._late, self._heard_at = [0, 0], 0, 0, time.monotonic()
        self._tracker: StereoTracker | None = None
        self._camera: StereoCamera | None = None
        self._mask: np.ndarray | None = None
        self._T_base_camera = np.eye(4)
        self._odometry, self._grey = ContinuousOdometry(), GreyConverter()
        self._first, self._last, self._jumps = 0, 0, False  # nanoseconds
        self._pair: tuple[Image, Image] | None = None
        self._first_pairs: list[tuple[np.ndarray, np.ndarray, float]] = []
        self._stopped, self._changed = False, threading.Condition()
        self._tf = Buffer()
        self._listener = TransformListener(self._tf, self)
        self._broadcaster = TransformBroadcaster(self)
        self._pose_publisher = self.create_publisher(geometry.PoseWithCovarianceStamped, "~/pose", 10)
        self._odometry_publisher = self.create_publisher(Odometry, "~/odometry", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        given = [self._given[eye] for eye in ("left", "right")]  # a name that is resolved would be remapped again
        eyes = [Subscriber(self, Image, topic, qos_profile=qos_profile_sensor_data) for topic in given]
        for eye, topic in enumerate(infos):
            self.create_subscription(CameraInfo, topic, partial(self._take_info, eye), qos_profile_sensor_data)
            eyes[eye].registerCallback(partial(self._count, eye))
        self._pairs = ApproximateTimeSynchronizer(eyes, 10, self._given["slop"] + 1e-9)  # which takes what is below
        self._pairs.registerCallback(self._take_pair)
        self.create_timer(SILENCE, self._watch)
        self._thread = threading.Thread(target=self._work, name="sigmaslam", daemon=True)
        self._thread.start()

    def _find_info_topic(self, images: str) -> str:
        """Beside the images, wherever they are remapped to, unless it is remapped itself."""
        own = str(PurePosixPath(images).parent / "camera_info")
        if self.resolve_topic_name(own) != self.resolve_topic_name(own, only_expand=True):
            return own
        return str(PurePosixPath(self.resolve_topic_name(images)).parent / "camera_info")

    def destroy_node(self) -> None:
        """Ends the tracking first."""
        with self._changed:
            self._stopped = True
            self._changed.notify()
        self._thread.join()
        super().destroy_node()

    # ---- callbacks, which never wait

    def _take_info(self, eye: int, message: CameraInfo) -> None:
        self._infos[eye] = message

    def _count(self, eye: int, message: Image) -> None:
        self._heard[eye] += 1

    def _take_pair(self, left: Image, right: Image) -> None:
        with self._changed:
            self._dropped += self._pair is not None
            self._pair, self._heard_at = (left, right), time.monotonic()
            self._changed.notify()

    def _watch(self) -> None:
        silent = time.monotonic() - self._heard_at
        if silent > SILENCE:
            counts = ", ".join(f"{self._heard[eye]} on {self._topics[eye]}" for eye in range(2))
            mend = "raise `slop`, or trigger both eyes at once" if min(self._heard) else "check topics and QoS"
            message = f"no pair of images for {silent:.1f} s; images so far: {counts}: {mend}"
            self._diagnose(DiagnosticStatus.ERROR, message, self.get_clock().now().to_msg())

    # ---- the thread

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._pair is not None or self._stopped)
                pair, self._pair = self._pair, None
            if pair is None or self._stopped:
                return
            try:
                self._track(*pair)
            except FrameError as error:
                self._odometry.forget_velocity()
                if rclpy.ok():
                    self._diagnose(DiagnosticStatus.ERROR, str(error), pair[0].header.stamp)
            except Exception as error:  # the node ends, in place of going on without its thread
                if not rclpy.ok():  # nothing can be published any more
                    return
                self._diagnose(DiagnosticStatus.ERROR, str(error), pair[0].header.stamp)
                self.get_logger().fatal(traceback.format_exc())
                self.failure = error
                return

    def _track(self, left: Image, right: Image) -> None:
        began, stamp = time.monotonic(), stamp_ns(left)
        if stamp == 0:
            raise InputError(f"images on {self._topics[0]} have no time stamps (they are 0): let the driver set them")
        if stamp <= self._last:
            self._late += 1
            late = (self._last - stamp) / 1e9
            mend = ": where time began anew, as in a bag that is played again, start the node again"
            message = f"a pair came {late:.3f} s late and is dropped{mend if late > SILENCE else ''}"
            self._diagnose(DiagnosticStatus.WARN, message, left.header.stamp)
            return
        self._first, self._last = self._first or stamp, stamp
        seconds = (stamp - self._first) / 1e9  # a float does not hold nanoseconds since 1970
        pair = zip((left, right), self._topics, strict=True)
        images = [self._grey.convert(image_array(image, topic), topic) for image, topic in pair]
        if self._tracker is None and (missing := self._prepare(left, (*images, seconds))) is not None:
            self._diagnose(DiagnosticStatus.WARN, f"waiting for {missing}", left.header.stamp)
            return
        assert self._tracker is not None
        estimate = self._tracker.step(*images, seconds, self._mask)
        words = [estimate.status, *estimate.doubts]
        if estimate.status in PUBLISHED:
            words += self._publish(estimate, left.header.stamp)
            self._jumps = False
        else:
            self._odometry.forget_velocity()
        # A loop moves the keyframes after the pose of its frame is known, so the next frame jumps.
        self._jumps |= estimate.loop is not None
        level = DiagnosticStatus.OK if words == ["tracking"] else DiagnosticStatus.WARN
        values = {
            "inliers": f"{estimate.inliers} of {estimate.matches}",
            "NIS per degree of freedom": f"{estimate.nis / max(estimate.dof, 1):.2f}",
            "sigma of the position, m": f"{np.sqrt(np.trace(estimate.covariance[:3, :3])):.4f}",
            "milliseconds": f"{1e3 * (time.monotonic() - began):.0f}",
        }
        level = DiagnosticStatus.ERROR if estimate.status == "lost" else level
        self._diagnose(level, "; ".join(words), left.header.stamp, values)

    def _prepare(self, left: Image, pair: tuple[np.ndarray, np.ndarray, float]) -> str | None:
        """Makes the tracker, once enough pairs are there to check; what is missing for it, in words.

        Raises:
            SigmaSlamError: the calibration, the mask or the map cannot be used.
        """
        given = self._given
        missing = [topic for topic, info in zip(self._info_topics, self._infos, strict=True) if info is None]
        if missing and not given["calibration"]:
            return f"camera_info on {' and '.join(missing)}, or the parameter `calibration`"
        try:
            mounting = self._tf.lookup_transform(given["base_frame"], left.header.frame_id, Time())
        except TransformException as error:
            return f"the transform from {given['base_frame']} to the camera, {left.header.frame_id} ({error})"
        self._T_base_camera = as_matrix(mounting.transform)
        if self._camera is None and given["calibration"]:
            self._camera = read_calibration(Path(given["calibration"]), (left.width, left.height))
        elif self._camera is None:
            self._camera = stereo_from_messages(*self._infos, tuple(self._topics), tuple(self._info_topics))
        camera = self._camera
        checked: dict[str, Any] = {"camera": camera}
        if given["check"]:
            self._first_pairs.append(pair)
            if (more := PAIRS_BEFORE_TRACKING - len(self._first_pairs)) > 0:
                return f"{more} more pairs of images, to check the cameras"
            check, self._first_pairs = check_pairs(camera, self._first_pairs, given["threads"]), []
            if blind := [each.message for each in check.findings if each.severity == "error" and each.name in UNSEEN]:
                return f"images by which to check the cameras: {blind[0]}"
            checked = check.tracker_arguments
            for each in wrong(check.findings):
                self.get_logger().warning(f"{each.name}: {each.message}")
        try:
            size = camera.left.width, camera.left.height
            self._mask = read_mask(Path(given["mask"]), *size) if given["mask"] else None
        except FrameError as error:  # of no single frame
            raise InputError(str(error)) from None
        tracker = StereoTracker(**checked, frontend=given["frontend"], threads=given["threads"])
        if given["map"]:
            tracker.load_map(Path(given["map"]))
        tracker.warm_up()
        self._tracker = tracker
        return None

    def _publish(self, estimate: Estimate, stamp: Stamp) -> list[str]:
        """Publishes a pose; what went wrong, in words."""
        T_base_camera, odometry, given = self._T_base_camera, self._odometry, self._given
        # The tracker's world has the axes of the first camera: the map has those of the base there.
        T_map_base = T_base_camera @ estimate.T_world_camera @ se3_inverse(T_base_camera)
        covariance = turn_covariance(T_base_camera, estimate.covariance)
        since_key = turn_covariance(T_base_camera, estimate.frame_covariance)
        jumps = self._jumps or estimate.status == "relocalised"
        odometry.update(estimate.timestamp, T_map_base, covariance, since_key, jumps)
        in_map, in_odom = (Header(stamp=stamp, frame_id=given[name]) for name in ("map_frame", "odom_frame"))
        pose = with_covariance(T_map_base, covariance)
        self._pose_publisher.publish(geometry.PoseWithCovarianceStamped(header=in_map, pose=pose))
        linear, angular = (filled(geometry.Vector3, part) for part in np.split(odometry.twist, 2))
        spread = odometry.twist_covariance.ravel().tolist()
        twist = geometry.TwistWithCovariance(twist=geometry.Twist(linear=linear, angular=angular), covariance=spread)
        moved = {"child_frame_id": given["base_frame"], "pose": with_covariance(odometry.pose, odometry.covariance)}
        self._odometry_publisher.publish(Odometry(header=in_odom, twist=twist, **moved))
        T_odom_base, transforms = odometry.pose, []
        if given["publish_odom_tf"]:
            transforms.append(as_transform(T_odom_base, in_odom, given["base_frame"]))
        else:
            try:
                found = self._tf.lookup_transform(given["odom_frame"], given["base_frame"], Time.from_msg(stamp))
            except TransformException as error:
                return [f"no {given['odom_frame']} -> {given['base_frame']} of another node ({error})"]
            T_odom_base = as_matrix(found.transform)
        transforms.append(as_transform(T_map_base @ se3_inverse(T_odom_base), in_map, given["odom_frame"]))
        self._broadcaster.sendTransform(transforms)
        return []

    def _diagnose(self, level: bytes, message: str, stamp: Stamp, values: dict[str, str] | None = None) -> None:
        counted = {**(values or {}), "dropped": str(self._dropped), "late": str(self._late)}
        pairs = [KeyValue(key=key, value=value) for key, value in counted.items()]
        told = {"name": f"{self.get_name()}: tracking", "hardware_id": self._topics[0], "values": pairs}
        status = DiagnosticStatus(level=level, message=message, **told)
        self._diagnostics.publish(DiagnosticArray(header=Header(stamp=stamp), status=[status]))


def as_matrix(transform: geometry.Transform) -> np.ndarray:
    """(4, 4) of a message."""
    T = np.eye(4)
    T[:3, :3] = quaternion_to_matrix(np.array([getattr(transform.rotation, axis) for axis in "xyzw"]))
    T[:3, 3] = [getattr(transform.translation, axis) for axis in "xyz"]
    return T


def as_transform(T: np.ndarray, header: Header, child: str) -> geometry.TransformStamped:
    """The message of a pose (4, 4) of the child in the header's frame."""
    transform = geometry.Transform(translation=filled(geometry.Vector3, T[:3, 3]), rotation=quaternion(T))
    return geometry.TransformStamped(header=header, child_frame_id=child, transform=transform)


def with_covariance(T: np.ndarray, covariance: np.ndarray) -> geometry.PoseWithCovariance:
    """The message of a pose (4, 4) with its covariance (6, 6) in its own frame, translation before rotation.

    ROS has that of x, y, z and of rotations about the fixed axes of the parent frame. An error (t, r) in the pose's own
    frame moves the position by R t, and turns by R r about the fixed axes: R exp(r) = exp(R r) R.
    """
    turn = np.kron(np.eye(2), T[:3, :3])
    pose = geometry.Pose(position=filled(geometry.Point, T[:3, 3]), orientation=quaternion(T))
    return geometry.PoseWithCovariance(pose=pose, covariance=(turn @ covariance @ turn.T).ravel().tolist())


def quaternion(T: np.ndarray) -> geometry.Quaternion:
    """Of the rotation of a pose (4, 4)."""
    return filled(geometry.Quaternion, matrix_to_quaternion(T[:3, :3]))


def filled(kind: Any, values: np.ndarray) -> Any:
    """A message with fields x, y, z and, of four values, w."""
    return kind(**dict(zip("xyzw", values.tolist(), strict=False)))


def main() -> None:
    """Entry point; the exit code is 1 where the calibration, the mask or the map cannot be used."""
    rclpy.init(args=sys.argv)
    node = SigmaSlamNode()
    try:
        while rclpy.ok() and node.failure is None:
            rclpy.spin_once(node, timeout_sec=0.1)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    if node.failure is not None:
        sys.exit(f"error: {node.failure}")


if __name__ == "__main__":
    main()
