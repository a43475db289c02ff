"""Arguments of the trackers, checked in constant time before anything is computed with them."""

import math
from numbers import Real
from typing import Any

import numpy as np

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import FrameError, InputError
from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.frontend.types import check_grey
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import is_rigid
from sigmaslam.inference.backends import ONNX, backend_names
from sigmaslam.slam.config import TrackerConfig

# Seconds. A clock that jumps further has another unit, or began anew; the motion in between would be unknown anyway.
_LONGEST_PAUSE = 1e5
MAX_DELAY = 1.0
"""Of the right eye, seconds: more are another unit, or frames so far apart that no velocity lasts."""
_DENSITIES = ("gyro_density", "gyro_walk", "accel_density", "accel_walk")
_FRONTEND_METHODS = ("name", "observe", "match", "follow")


def check_tracker_arguments(
    camera: object,
    frontend: object,
    backend: object,
    config: object,
    threads: object,
    weights: object = None,
    right_delay: object = 0.0,
    imu: Any = None,
    odometry: Any = None,
) -> None:
    """The arguments with which a tracker is made.

    Raises:
        InputError: one is of another type, or names nothing; names the argument, what was given, and the mend.
    """
    if not isinstance(camera, StereoCamera):
        raise _wrong("camera", camera, "a StereoCamera, such as StereoCamera.from_yaml('stereo.yaml')")
    if not isinstance(frontend, str) and not all(hasattr(frontend, name) for name in _FRONTEND_METHODS):
        raise _wrong("frontend", frontend, f"a name, or an object with {', '.join(_FRONTEND_METHODS)}")
    if backend != ONNX and backend not in backend_names():
        raise _wrong("backend", backend, f"one of {', '.join(backend_names())}")
    if config is not None and not isinstance(config, TrackerConfig):
        raise _wrong("config", config, "a TrackerConfig, such as TrackerConfig(window=8)")
    if not isinstance(threads, int | np.integer) or isinstance(threads, bool) or threads < 1:
        raise _wrong("threads", threads, "a whole number from 1")
    if weights is not None and not isinstance(frontend, str):
        raise InputError(f"weights {weights} are for a front-end by name: give the networks to your own one instead")
    if not isinstance(right_delay, Real) or not abs(float(right_delay)) < MAX_DELAY:
        raise _wrong("right_delay", right_delay, "seconds, such as 0.01 for ten milliseconds")
    if imu is not None:
        _check_sensor("imu", imu, InertialSensor, "T_left_imu")
        measured = [name for name in _DENSITIES if imu.has_accelerometer or name.startswith("gyro")]
        if wrong := [name for name in measured if not _is_number(value := getattr(imu, name)) or value <= 0.0]:
            raise _wrong(f"imu.{wrong[0]}", getattr(imu, wrong[0]), "that of the data sheet, above zero")
    if odometry is not None:
        _check_sensor("odometry", odometry, OdometrySensor, "T_left_base")


def check_sample(motion: MotionFilter, name: str, timestamp: float, one: Any, other: Any) -> SampleBuffer:
    """A sample of an inertial sensor or of odometry; what takes it.

    Args:
        name: "imu" or "odometry".
    Raises:
        InputError: the tracker knows no such sensor, or the sample is no time and two vectors of finite numbers.
    """
    if name not in motion.sensors:
        raise InputError(f"add_{name}: the tracker knows no such sensor: make it with {name}=...")
    if np.shape(one) != (3,) or np.shape(other) != (3,) or not np.isfinite([timestamp, *one, *other]).all():
        given = shorten(f"{timestamp!r}, {one!r}, {other!r}")
        raise InputError(f"add_{name}: expected seconds and two vectors of three finite numbers, found {given}")
    return motion.sensors[name]


def check_region(region: Any, camera: StereoCamera) -> None:
    """The region of a body in the first raw left image.

    Raises:
        InputError: it is no array of truth values of the image's size, or nothing is in it.
    """
    size = (camera.left.height, camera.left.width)
    if not isinstance(region, np.ndarray) or region.dtype != np.bool_ or region.shape != size:
        given = f"{region.dtype} {region.shape}" if isinstance(region, np.ndarray) else region
        raise _wrong("region", given, f"a bool array {size}, true on the body, such as read_region makes")
    if not region.any():
        raise InputError("region is false everywhere: pixels of the body must be true")


def check_frame(left: Any, right: Any, timestamp: Any, before: float | None) -> float:
    """A stereo pair and its time, in seconds.

    Args:
        left, right: images; their size is checked where they are rectified.
        timestamp: seconds.
        before: of the last pair, None for the first one.
    Raises:
        InputError: the time stamp is no finite number, or does not come after the last one, or far after it.
        FrameError: an image is no (H, W) uint8 array.
    """
    check_grey(left, "left image")
    check_grey(right, "right image")
    is_number = isinstance(timestamp, Real) and not isinstance(timestamp, bool | np.timedelta64)
    try:
        seconds = float(timestamp) if is_number else math.nan
    except OverflowError:
        seconds = math.inf
    if not math.isfinite(seconds):
        raise _wrong("timestamp", timestamp, "seconds as a finite number")
    if before is not None and seconds <= before:
        raise InputError(f"time stamp {seconds:.6f} s does not come after {before:.6f} s: sort the frames by time")
    if before is not None and seconds - before > _LONGEST_PAUSE:
        raise InputError(
            f"time stamp {seconds:.6f} s comes {seconds - before:.3g} s after the one before: give seconds, not "
            "nano- or microseconds; after a pause of days make a new tracker"
        )
    return seconds


def check_mask(mask: Any, width: int, height: int) -> None:
    """The mask of a raw left image.

    Raises:
        FrameError: it is no (H, W) bool or uint8 array of the image's size, or zero everywhere.
    """
    if not isinstance(mask, np.ndarray) or mask.dtype not in (np.bool_, np.uint8) or mask.shape != (height, width):
        given = f"{mask.dtype} {mask.shape}" if isinstance(mask, np.ndarray) else shorten(repr(mask), 60)
        raise FrameError(f"mask is {given}: give a bool or uint8 array ({height}, {width}) of the raw left image")
    if not mask.any():
        raise FrameError("mask is zero everywhere: what may be used of the left image must not be zero")


def _check_sensor(name: str, sensor: Any, kind: type[InertialSensor | OdometrySensor], mounting: str) -> None:
    """A sensor beside the cameras: where it is, and its clock."""
    if not isinstance(sensor, kind):
        module = f"sigmaslam.readers.{'inertial' if name == 'imu' else name}"
        raise _wrong(name, sensor, f"an {kind.__name__}, such as read_{name}(Path(...)).sensor of {module}")
    if not is_rigid(T := getattr(sensor, mounting)):
        raise _wrong(f"{name}.{mounting}", T, "a rotation with a translation, (4, 4), whose last row is 0 0 0 1")
    if not _is_number(sensor.time_shift):
        raise _wrong(f"{name}.time_shift", sensor.time_shift, "seconds")


def _is_number(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _wrong(name: str, value: object, expected: str) -> InputError:
    return InputError(f"{name} is {shorten(repr(value), 60)}: give {expected}")
