"""ROS messages: images as arrays, and two CameraInfo as a stereo camera."""

import logging
import re
from typing import Any

import cv2
import numpy as np

from sigmaslam.bounded_files import shorten
from sigmaslam.calibration_files.camera_infos import CameraInfo, stereo_from_infos
from sigmaslam.errors import CalibrationError, FrameError, InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.images import decode_image

logger = logging.getLogger(__name__)

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"

# Each encoding has its bytes per value, its channels, and the conversion to grey or BGR.
_ENCODINGS: dict[str, tuple[int, int, int | None]] = {
    "mono8": (1, 1, None),
    "8UC1": (1, 1, None),
    "mono16": (2, 1, None),
    "16UC1": (2, 1, None),
    "bgr8": (1, 3, None),
    "8UC3": (1, 3, None),
    "rgb8": (1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": (1, 4, None),
    "8UC4": (1, 4, None),
    "rgba8": (1, 4, cv2.COLOR_RGBA2BGRA),
    "bgr16": (2, 3, None),
    "rgb16": (2, 3, cv2.COLOR_RGB2BGR),
    **{
        f"bayer_{order.lower()}{8 * size}": (size, 1, getattr(cv2, f"COLOR_Bayer{order}2GRAY"))
        for order in ("RGGB", "BGGR", "GBRG", "GRBG")
        for size in (1, 2)
    },
    **dict.fromkeys(("yuv422", "uyvy"), (1, 2, cv2.COLOR_YUV2GRAY_UYVY)),
    **dict.fromkeys(("yuv422_yuy2", "yuyv"), (1, 2, cv2.COLOR_YUV2GRAY_YUY2)),
}


def stamp_ns(message: Any) -> int:
    """Time of a message's header, nanoseconds."""
    return int(message.header.stamp.sec) * 1_000_000_000 + int(message.header.stamp.nanosec)


def image_array(message: Any, name: str) -> np.ndarray:
    """Image of an Image or CompressedImage message.

    Returns:
        (H, W) or (H, W, C) uint8 or uint16, colours in OpenCV's order; Bayer and YUV images are made grey.

    Raises:
        FrameError: the encoding is not known, or there are fewer bytes than it takes.
    """
    # rclpy has arrays of Python, rosbags of NumPy.
    data = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):  # compressed
        return decode_image(data.tobytes(), name)
    if message.encoding not in _ENCODINGS:
        unknown = shorten(repr(message.encoding))
        raise FrameError(f"{name}: encoding {unknown} is not known; known are {', '.join(_ENCODINGS)}")
    size, channels, conversion = _ENCODINGS[message.encoding]
    height, width = int(message.height), int(message.width)
    row = width * channels * size
    step = max(int(message.step), row)
    if not 0 < height * step <= len(data):
        raise FrameError(
            f"{name}: {len(data)} bytes for a {width}x{height} image of {message.encoding}, {height * step} are needed"
        )
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row])
    values = rows.view(np.dtype(f"{'>' if message.is_bigendian else '<'}u{size}"))
    image = values.astype(f"u{size}", copy=False)
    image = image.reshape((height, width) if channels == 1 else (height, width, channels))
    return image if conversion is None else cv2.cvtColor(image, conversion)


def is_rectified(topic: str) -> bool:
    """Whether images of this topic are rectified by its name; a name that tells nothing is logged as a warning."""
    words = re.findall(r"[a-z]+", topic.lower())
    rectified = "rect" in words or "rectified" in words
    if not rectified and "raw" not in words:
        logger.warning("%s: neither 'rect' nor 'raw' in the name; taken as raw, not rectified images", topic)
    return rectified


def stereo_from_messages(
    left: Any, right: Any, image_topics: tuple[str, str], info_topics: tuple[str, str]
) -> StereoCamera:
    """Stereo camera from the CameraInfo messages of both eyes, rectified by the names of the image topics or raw.

    Raises:
        InputError: one topic is rectified, the other is not.
        CalibrationError: a message is not calibrated, has no baseline or an unknown lens model.
    """
    rectified = [is_rectified(topic) for topic in image_topics]
    if rectified[0] != rectified[1]:
        raise InputError(
            f"one of {image_topics[0]} and {image_topics[1]} is rectified by its name, the other is not; choose "
            "with --topic-left and --topic-right"
        )
    infos = [_camera_info(message, name) for message, name in zip((left, right), info_topics, strict=True)]
    return stereo_from_infos(infos[0], infos[1], rectified[0])


def _camera_info(message: Any, name: str) -> CameraInfo:
    # ROS 1 writes K, D, R, P; ROS 2 k, d, r, p.
    values = {
        key: np.array(getattr(message, key if hasattr(message, key) else key.lower()), dtype=np.float64)
        for key in ("D", "K", "R", "P")
    }
    for key, size in (("K", 9), ("R", 9), ("P", 12)):
        if values[key].size != size:
            raise CalibrationError(f"{name}: {key} has {values[key].size} numbers, not {size}")
    return CameraInfo(
        name=name,
        width=int(message.width),
        height=int(message.height),
        lens=message.distortion_model,
        D=values["D"].tolist(),
        K=values["K"].reshape(3, 3),
        R=values["R"].reshape(3, 3),
        P=values["P"].reshape(3, 4),
    )
