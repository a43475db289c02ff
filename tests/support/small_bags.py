"""Bags of two tiny stereo pairs, written by rosbags."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

START, STEP = 1_700_000_000_000_000_000, 50_000_000


IMU_COUNT, IMU_STEP = 6, 10_000_000


def write_bag(folder: Path, kind: str, size: tuple[int, int], imu: Sequence[str] = (), stamped: bool = True) -> Path:
    """A file with two pairs of images and their CameraInfo.

    Args:
        folder: new.
        kind: "bag" (ROS 1), "db3" or "mcap".
        size: (width, height) of the images.
        imu: topics of inertial sensors with samples whose values count from 0 on.
        stamped: headers of these have time stamps.
    Returns:
        The file.
    """
    folder.mkdir()
    ros1 = kind == "bag"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
    if ros1:
        path = folder / "recording.bag"
        writer: Any = rosbag1.Writer(path)
    else:
        plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
        writer = rosbag2.Writer(folder / "recording", version=9, storage_plugin=plugin)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        for eye, baseline in (("left", 0.0), ("right", 0.1)):
            messages = [_info(store, size, baseline, ros1)]
            info = writer.add_connection(f"/{eye}/camera_info", messages[0].__msgtype__, typestore=store)
            writer.write(info, START, serialize(messages[0], messages[0].__msgtype__))
            images = writer.add_connection(f"/{eye}/image_rect", "sensor_msgs/msg/Image", typestore=store)
            for k in range(2):
                image = _image(store, size, START + k * STEP, ros1)
                writer.write(images, START + k * STEP, serialize(image, image.__msgtype__))
        for topic in imu:
            connection = writer.add_connection(topic, "sensor_msgs/msg/Imu", typestore=store)
            for k in range(IMU_COUNT):
                stamp = START + k * IMU_STEP
                message = _imu(store, stamp if stamped else 0, k, ros1)
                writer.write(connection, stamp, serialize(message, message.__msgtype__))
    return path if ros1 else next((folder / "recording").glob(f"*.{kind}"))


def _header(store: Any, stamp: int, ros1: bool) -> Any:
    time = store.types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id="eye", **({"seq": 0} if ros1 else {}))


def _image(store: Any, size: tuple[int, int], stamp: int, ros1: bool) -> Any:
    width, height = size
    return store.types["sensor_msgs/msg/Image"](
        header=_header(store, stamp, ros1),
        height=height,
        width=width,
        encoding="mono8",
        is_bigendian=0,
        step=width,
        data=np.random.default_rng(0).integers(0, 255, width * height, np.uint8),
    )


def _imu(store: Any, stamp: int, index: int, ros1: bool) -> Any:
    vector, turn = store.types["geometry_msgs/msg/Vector3"], store.types["geometry_msgs/msg/Quaternion"]
    unknown, first = np.zeros(9), 6.0 * index
    return store.types["sensor_msgs/msg/Imu"](
        header=_header(store, stamp, ros1),
        orientation=turn(x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=unknown,
        angular_velocity=vector(x=first, y=first + 1, z=first + 2),
        angular_velocity_covariance=unknown,
        linear_acceleration=vector(x=first + 3, y=first + 4, z=first + 5),
        linear_acceleration_covariance=unknown,
    )


def _info(store: Any, size: tuple[int, int], baseline: float, ros1: bool) -> Any:
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    P = np.column_stack([K, [-50.0 * baseline, 0, 0]])
    arrays = {"d": np.zeros(5), "k": K.ravel(), "r": np.eye(3).ravel(), "p": P.ravel()}
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    return store.types["sensor_msgs/msg/CameraInfo"](
        header=_header(store, START, ros1),
        width=size[0],
        height=size[1],
        distortion_model="plumb_bob",
        binning_x=0,
        binning_y=0,
        roi=store.types["sensor_msgs/msg/RegionOfInterest"](**region),
        **{name.upper() if ros1 else name: array for name, array in arrays.items()},
    )
