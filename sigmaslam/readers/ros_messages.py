"""ROS messages: images as arrays, and two CameraInfo as a stereo camera."""

import logging
import re
from typing import Any

import cv2
import numpy as np

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import CalibrationError, FrameError, InputError
from sigmaslam.geometry.camera import CameraModel, DistortionModel, StereoCamera
from sigmaslam.readers.calibration_files import right_position
from sigmaslam.readers.euroc import DISTORTION_MODELS
from sigmaslam.readers.images import decode_image

logger = logging.getLogger(__name__)

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"

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
_LENS_MODELS: dict[str, DistortionModel] = {**DISTORTION_MODELS, "rational_polynomial": "radtan", "": "none"}


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
    if message.__msgtype__ == COMPRESSED_IMAGE:
        return decode_image(message.data.tobytes(), name)
    if message.encoding not in _ENCODINGS:
        unknown = shorten(repr(message.encoding))
        raise FrameError(f"{name}: encoding {unknown} is not known; known are {', '.join(_ENCODINGS)}")
    size, channels, conversion = _ENCODINGS[message.encoding]
    height, width = int(message.height), int(message.width)
    row = width * channels * size
    step = max(int(message.step), row)
    if not 0 < height * step <= len(message.data):
        raise FrameError(
            f"{name}: {len(message.data)} bytes for a {width}x{height} image of {message.encoding}, "
            f"{height * step} are needed"
        )
    rows = np.ascontiguousarray(message.data[: height * step].reshape(height, step)[:, :row])
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


def stereo_from_infos(
    left: Any, right: Any, image_topics: tuple[str, str], info_topics: tuple[str, str]
) -> StereoCamera:
    """Stereo camera from the CameraInfo of both eyes.

    Rectified images (by the name of their topic) have the pinhole cameras of P; raw ones have K and D, and R
    and P say how the two are placed: x_rectified = R x, and P = K' [I | t].

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
    P_left, P_right = (_matrix(info, "p", (3, 4), name) for info, name in zip((left, right), info_topics, strict=True))
    T_left_right = np.eye(4)
    T_left_right[:3, 3] = right_position(P_left, P_right)
    if not np.any(T_left_right[:3, 3]):
        raise CalibrationError(
            f"{info_topics[1]}: no baseline (P[0, 3] is 0): the eyes were calibrated one by one; calibrate them as a "
            "stereo pair, or give --calibration"
        )
    if rectified[0]:
        models = [
            _model(info, P[:, :3], name, False)
            for info, P, name in zip((left, right), (P_left, P_right), info_topics, strict=True)
        ]
    else:
        rotations = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
        models = []
        for rotation, info, name in zip(rotations, (left, right), info_topics, strict=True):
            rotation[:3, :3] = _matrix(info, "r", (3, 3), name)
            models.append(_model(info, _matrix(info, "k", (3, 3), name), name, True))
        T_left_right = rotations[0].T @ T_left_right @ rotations[1]
    try:
        return StereoCamera(models[0], models[1], T_left_right)
    except CalibrationError as error:
        raise CalibrationError(f"{info_topics[0]} and {info_topics[1]}: {error}") from None


def _matrix(info: Any, key: str, shape: tuple[int, int], name: str) -> np.ndarray:
    # ROS 1 writes K, D, R, P; ROS 2 k, d, r, p.
    matrix = np.array(getattr(info, key, None) if hasattr(info, key) else getattr(info, key.upper()), dtype=np.float64)
    if matrix.size != np.prod(shape):
        raise CalibrationError(f"{name}: {key.upper()} has {matrix.size} numbers, not {np.prod(shape)}")
    matrix = matrix.reshape(shape)
    if not np.all(np.isfinite(matrix)) or abs(np.linalg.det(matrix[:, :3])) == 0.0:
        raise CalibrationError(f"{name}: not calibrated, {key.upper()} is {matrix.tolist()}; give --calibration")
    return matrix


def _model(info: Any, K: np.ndarray, name: str, distorted: bool) -> CameraModel:
    model, distortion = _lens(info, name) if distorted else ("none", ())
    try:
        return CameraModel(
            int(info.width), int(info.height), K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], model, distortion
        )
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}; give --calibration") from None


def _lens(info: Any, name: str) -> tuple[DistortionModel, tuple[float, ...]]:
    if info.distortion_model not in _LENS_MODELS:
        known = ", ".join(model for model in _LENS_MODELS if model)
        raise CalibrationError(
            f"{name}: distortion_model is {shorten(repr(info.distortion_model))}; known are {known}; give --calibration"
        )
    model = _LENS_MODELS[info.distortion_model]
    distortion = [float(value) for value in (info.d if hasattr(info, "d") else info.D)]
    if model == "radtan" and not any(distortion):
        model = "none"
    if model == "none":
        return "none", ()
    # The eight coefficients of the rational model precede thin prism and tilt, which are nearly always zero.
    while len(distortion) > 8 and distortion[-1] == 0.0:
        distortion.pop()
    return model, tuple(distortion)
