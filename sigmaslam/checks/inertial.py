"""What is wrong with the tables of sensors of motion: their times, and the unit of force."""

from collections.abc import Sequence

import numpy as np

from sigmaslam.checks.calibration import MAX_BASELINE
from sigmaslam.checks.finding import Finding
from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.readers.odometry import OdometryRecording

_NAME = "inertial sensor"
# The median specific force of whatever moves on Earth is within so much of gravity, m/s^2; other units are far off.
_LENGTH_TOLERANCE = 3.0
# Periods that are missing in a row before it is said, and samples a second that preintegration needs, and velocities.
_GAP, _LEAST_RATE, _LEAST_ODOMETRY_RATE = 2.5, 50.0, 10.0
# Ranges that sensors have, rad/s and m/s^2; a value within this share of one that lasts so long is at its end.
_RATES = np.radians([125, 250, 500, 1000, 2000, 4000])
_FORCES = STANDARD_GRAVITY * np.array([2, 4, 8, 16, 32])
_AT_END, _FLAT = 0.02, 3
# What times in other units were off by when read: large whole ones are read as nanoseconds, others as seconds.
_UNITS = (("", 1.0), ("micro", 1e-3), ("milli", 1e-6), ("milli", 1e3), ("micro", 1e6), ("nano", 1e9))


def check_inertial(recording: InertialRecording, timestamps: Sequence[float] | None) -> Finding:
    """The worst that is wrong with a sensor's table; turns are judged while tracking, by those of the images.

    Args:
        timestamps: of the images, seconds; None where they are not known.
    """
    samples, source = recording.samples, recording.source
    lever = float(np.linalg.norm(recording.sensor.T_left_imu[:3, 3]))
    if lever > MAX_BASELINE:
        where = "millimetres" if lever < 1e3 * MAX_BASELINE else "other units than metres"
        message = f"{source}: T_cam_imu has the sensor {lever:.3g} m from the camera: is it in {where}? Give metres"
        return Finding(_NAME, "error", message, lever)
    length = float(np.median(np.linalg.norm(samples.accel, axis=1)))
    is_whole = recording.sensor.has_accelerometer
    if is_whole and abs(length - STANDARD_GRAVITY) > _LENGTH_TOLERANCE:
        factors = {"g": 1.0, "mg": 1e3, "cm/s^2": 1e2 * STANDARD_GRAVITY}
        unit = next((name for name, value in factors.items() if abs(length / value - 1.0) < 0.15), None)
        cure = f"it is in {unit}: give m/s^2" if unit else "are its columns those of the specific force in m/s^2?"
        message = f"{source}: specific force is {length:.3g} in the median, not 9.81: {cure}"
        return Finding(_NAME, "error", message, length)
    found = check_times(recording, timestamps, _NAME, _LEAST_RATE)
    for name, values, ranges in (("rate", samples.gyro, _RATES), ("force", samples.accel, _FORCES)):
        peak, count = _saturated(values, ranges)
        if count and found.severity != "error":
            message = f"{source}: the {name} stays at {peak:.3g} for {count} samples: saturated? Set a wider range"
            return Finding(_NAME, "warning", message, peak)
    if found.severity == "ok":
        forces = f"gravity {length:.2f} m/s^2" if is_whole else "a gyro alone"
        return Finding(_NAME, "ok", f"{found.message}, {forces}", found.figure)
    return found


def check_times(
    recording: InertialRecording | OdometryRecording,
    images: Sequence[float] | None,
    name: str = "odometry",
    least_rate: float = _LEAST_ODOMETRY_RATE,
) -> Finding:
    """The worst that is wrong with a table's times, and with those of images beside it, seconds; None: unknown."""
    t, source = recording.samples.timestamp, recording.source
    intervals = np.diff(t)
    rate = 1.0 / float(np.median(intervals))
    unit = next((name for name, factor in _UNITS if 10.0 < factor * rate < 2e3), "")
    if images is not None and len(images):
        shifted = np.asarray(images) + recording.sensor.time_shift
        covered = float(np.mean((shifted >= t[0]) & (shifted <= t[-1])))
        if covered < 1.0:
            cure = f"they look like {unit}seconds: give seconds" if unit else "is it of the same clock?"
            message = f"{source}: {1.0 - covered:.0%} of the images lie outside its times: {cure}"
            return Finding(name, "error" if covered < 0.5 else "warning", message, covered)
    gaps = intervals[intervals > _GAP / rate]
    if rate < least_rate or len(gaps):
        doubt = f" (are its times {unit}seconds?)" if unit else ""
        message = f"{source}: {rate:.0f} samples a second{doubt}, {len(gaps)} gaps of up to {intervals.max():.2f} s"
        return Finding(name, "warning", f"{message}: at least {least_rate:.0f} without gaps carry a pose", rate)
    return Finding(name, "ok", f"{rate:.0f} samples a second", rate)


def _saturated(values: np.ndarray, ranges: np.ndarray) -> tuple[float, int]:
    """Size at which an axis of (N, 3) values stays at the end of a usual range, and for how many samples; or zeros."""
    for axis in np.abs(values).T:
        peak = float(axis.max())
        top = np.flatnonzero(np.diff(np.r_[False, axis >= 0.999 * peak, False].astype(int)))
        flat = int(np.max(top[1::2] - top[::2]))
        if flat >= _FLAT and np.min(np.abs(peak / ranges - 1.0)) < _AT_END:
            return peak, flat
    return 0.0, 0
