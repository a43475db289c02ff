"""Whether an inertial sensor moves as the cameras do: unit and axes of both halves, T_cam_imu, and the clock."""

from dataclasses import replace

import numpy as np

from sigmaslam.calibration.imu_calibration import CameraPath, calibrate_imu
from sigmaslam.checks.finding import Finding
from sigmaslam.errors import CalibrationError
from sigmaslam.estimation.accelerometer_axes import SIGNED_AXES, fit_axes
from sigmaslam.estimation.inertial_motion import SENSOR_SIGMA
from sigmaslam.estimation.inertial_turns import SHARED_ERRORS, TurnFit, fit_turns
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import nearest_rotation, rotation_log
from sigmaslam.progress import counted
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.readers.selection import Selection
from sigmaslam.readers.stereo_sequence import StereoSequence
from sigmaslam.slam.tracker import StereoTracker

_GYRO, _ACCELEROMETER, _MOUNTING, _CLOCK = "gyro", "accelerometer", "T_cam_imu", "IMU clock"
# Units of rate, in which numbers are so many times those in rad/s.
_RATES = {"deg/s": 180.0 / np.pi, "mrad/s": 1e3, "mdeg/s": 180e3 / np.pi, "turns a minute": 30.0 / np.pi}
_SCALE_TOLERANCE = 0.1
# Below this share the gyro's turns are not those of the images; turns of fewer radians a frame are no turns.
_SAME, _LEAST_TURN = 0.7, 2e-3
# Rotations are signed axes if they are so near to them, radians; axes are wrong if others fit so many times better.
_NEAR, _BETTER = 0.2, 3.0
# What the tracker expects of delay and mounting, seconds, metres, radians: by less they are not wrong.
_DELAY, _LEVER, _TURN = float(SENSOR_SIGMA[0]), float(SENSOR_SIGMA[-4]), float(SENSOR_SIGMA[-1])
# Of three degrees of freedom, the quantile of chi-square at 3 sigma (99.73 %).
_CHI_SQUARE = 14.16
# A path is integrated over so many seconds of images whose turns can be interpolated: no further apart than that.
_WINDOW, _INTERVAL = 2.0, 0.15
# Place, speed and gravity are fitted to fewer than half of that many.
_LEAST_POSES = 8
# Metres: a place of the sensor that is known no better is not told.
_VAGUE = 0.1
# Frames that are tracked for the check, 5 s at 20 Hz: of MH_01's 50 show the sensor's place to 15 mm, these to 10.
_FRAMES = 100


def check_motion(sequence: StereoSequence, camera: StereoCamera, threads: int = 2) -> list[Finding]:
    """The findings of `judge_motion` from a few seconds of a sequence, tracked by `camera` alone."""
    assert sequence.imu is not None
    first = 0 if sequence.timestamps is None else _liveliest(np.asarray(sequence.timestamps), sequence.imu)
    part = sequence.select(Selection(first, _FRAMES))
    tracker = StereoTracker(camera, threads=threads)
    with counted("motion", part.length) as done:
        estimates = []
        for frame in part.frames():
            estimates.append(tracker.step(frame.left, frame.right, frame.timestamp))
            done()
    return judge_motion(
        np.array([each.timestamp for each in estimates]),
        np.array([each.T_world_camera for each in estimates]),
        np.array([each.status == "tracking" for each in estimates]),
        sequence.imu,
    )


def judge_motion(
    times: np.ndarray, poses: np.ndarray, tracked: np.ndarray, recording: InertialRecording
) -> list[Finding]:
    """Findings about unit and axes, mounting and clock, by how the camera moved.

    Args:
        times: (N,) seconds.
        poses: (N, 4, 4) T_world_camera of the left camera.
        tracked: (N,) bool, poses that come from images.
    """
    both = np.flatnonzero(tracked[:-1] & tracked[1:])
    R, sensor = poses[:, :3, :3], recording.sensor
    turns = rotation_log(R[both].transpose(0, 2, 1) @ R[both + 1]) if len(both) else np.zeros((0, 3))
    fit = fit_turns(times[both], times[both + 1], turns, recording.samples, sensor.time_shift)
    if fit is None:
        return [Finding(_GYRO, "unknown", "too few images were tracked within the table's time to judge its turns")]
    if fit.explained < _SAME:
        if np.sqrt(np.mean(np.sum(turns**2, axis=1))) < _LEAST_TURN:
            return [Finding(_GYRO, "unknown", "the camera hardly turns: turn it to have the inertial sensor judged")]
        message = (
            f"{recording.source}: turns of the gyro explain {fit.explained:.0%} of the camera's: is it of the same "
            "recording, and its clock within half a second?"
        )
        return [Finding(_GYRO, "error", message, fit.explained)]
    R_expected = sensor.T_left_imu[:3, :3].T
    off = fit.rotation @ R_expected.T
    axes = _nearest_axes(off, fit)
    T_left_imu = sensor.T_left_imu.copy()
    if axes is None:
        # Another mounting: axes of the accelerometer are judged against what the gyro shows.
        T_left_imu[:3, :3] = nearest_rotation(fit.rotation).T
    of_forces = _axes_of_forces(times, poses @ T_left_imu, tracked, recording, sensor.time_shift + fit.delay)
    mounting = _judge_mounting(fit, off, axes, of_forces, fit.rotation @ R_expected)
    if mounting.severity == "error":
        # The same axes of both halves are those of the mounting.
        axes, of_forces = np.eye(3), np.eye(3) if _same(of_forces, axes) else of_forces
    gyro, forces = _judge_gyro(fit, np.eye(3) if axes is None else axes), _judge_forces(of_forces)
    if gyro.severity == forces.severity == mounting.severity == "ok":
        part = _longest_part(times, tracked, recording, sensor.time_shift + fit.delay)
        mounting = _judge_place(times[part], poses[part], recording, mounting)
    return [gyro, forces, mounting, _judge_clock(fit, sensor.time_shift)]


def _liveliest(timestamps: np.ndarray, recording: InertialRecording) -> int:
    """Number of the first of the successive frames in which the sensor turns most."""
    samples = recording.samples
    ends = np.searchsorted(samples.timestamp, timestamps + recording.sensor.time_shift)
    squared = np.r_[0.0, np.cumsum(np.sum((samples.gyro - samples.gyro.mean(axis=0)) ** 2, axis=1))][ends]
    last = max(len(timestamps) - _FRAMES, 0)
    return int(np.argmax(squared[min(_FRAMES, len(squared)) - 1 :][: last + 1] - squared[: last + 1]))


def _nearest_axes(off: np.ndarray, fit: TurnFit) -> np.ndarray | None:
    """The signed axes that a gyro has instead of the expected ones; None where it is turned by another angle."""
    right = np.linalg.det(off) > 0.0
    turn, covariance = rotation_log(off), fit.rotation_covariance + _TURN**2 * np.eye(3)
    # No more than noise and what the tracker allows for.
    if right and float(turn @ np.linalg.solve(covariance, turn)) < _CHI_SQUARE:
        return np.eye(3)
    candidates = SIGNED_AXES[(np.linalg.det(SIGNED_AXES) > 0.0) == right]
    axes = candidates[np.argmax(np.einsum("kij,ij->k", candidates, off))]
    angle = float(np.linalg.norm(rotation_log(axes.T @ off)))
    return axes if angle < _NEAR and not (right and np.array_equal(axes, np.eye(3))) else None


def _axes_of_forces(
    times: np.ndarray, bodies: np.ndarray, tracked: np.ndarray, recording: InertialRecording, shift: float
) -> np.ndarray | None:
    """The signed axes (3, 3) that the accelerometer has instead of the expected ones; None where it does not show."""
    if not recording.sensor.has_accelerometer:
        return None
    part = _longest_part(times, tracked, recording, shift)
    times, bodies = times[part], bodies[part]
    if times[-1] - times[0] < 0.5 * _WINDOW or len(times) <= _LEAST_POSES:
        return None
    # The part of it with the longest way.
    way = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(bodies[:, :3, 3], axis=0), axis=1))]
    ends = np.searchsorted(times, times + _WINDOW, "right") - 1
    start = int(np.argmax(way[ends] - way))
    chosen = slice(start, int(ends[start]) + 1)
    misses = fit_axes(times[chosen], bodies[chosen], recording.samples, shift)
    best = int(np.argmin(misses))
    if misses[0] <= _BETTER * misses[best]:
        # Of a path without accelerations all axes are as good.
        return np.eye(3) if np.median(misses) > _BETTER * misses[0] else None
    return np.asarray(SIGNED_AXES[best].T)


def _longest_part(times: np.ndarray, tracked: np.ndarray, recording: InertialRecording, shift: float) -> slice:
    """The most successive images with a pose, and samples, none far from the next."""
    usable = tracked & (times + shift > recording.samples.timestamp[0])
    usable &= times + shift < recording.samples.timestamp[-1]
    breaks = np.flatnonzero(np.r_[True, (np.diff(times) > _INTERVAL) | ~usable[1:] | ~usable[:-1], True])
    longest = int(np.argmax(np.diff(breaks)))
    return slice(int(breaks[longest]), int(breaks[longest + 1]))


def _judge_gyro(fit: TurnFit, axes: np.ndarray) -> Finding:
    if abs(fit.scale - 1.0) > _SCALE_TOLERANCE:
        unit = next((name for name, size in _RATES.items() if abs(fit.scale / size - 1.0) < _SCALE_TOLERANCE), None)
        cure = f"it is in {unit}: give rad/s" if unit else "are its columns those of the rate in rad/s?"
        message = f"rates are {fit.scale:.3g} times those of the images: {cure}"
        return Finding(_GYRO, "error", message, fit.scale)
    if not np.array_equal(axes, np.eye(3)):
        return Finding(_GYRO, "error", f"rates in x, y, z are those about {_describe(axes)}: put the columns right")
    return Finding(_GYRO, "ok", f"its turns explain {fit.explained:.1%} of those of the images", fit.explained)


def _judge_forces(axes: np.ndarray | None) -> Finding:
    if axes is None:
        return Finding(_ACCELEROMETER, "unknown", "the path does not show which axes the accelerometer has")
    if np.array_equal(axes, np.eye(3)):
        return Finding(_ACCELEROMETER, "ok", "its axes give the path of the images")
    cure = "at rest they must be 9.81 upwards" if np.array_equal(axes, -np.eye(3)) else "put the columns right"
    return Finding(_ACCELEROMETER, "error", f"forces in x, y, z are those along {_describe(axes)}: {cure}")


def _judge_mounting(
    fit: TurnFit, off: np.ndarray, axes: np.ndarray | None, of_forces: np.ndarray | None, inverse: np.ndarray
) -> Finding:
    """Of the rotation in T_cam_imu; `off` (3, 3) takes directions of the sensor as expected to the sensor as it is.

    `axes` are the signed permutation nearest to that, `of_forces` those of the accelerometer, each None where it is
    not known; `inverse` is as `off`, if T_cam_imu were inverted.
    """
    right = np.linalg.det(off) > 0.0
    # A mirror is no rotation: determinant and all signs are changed first, for a number to show.
    angle = float(np.degrees(np.linalg.norm(rotation_log(off if right else -off))))
    sigma = float(np.degrees(np.sqrt(np.linalg.eigvalsh(fit.rotation_covariance)[-1])))
    if axes is not None and np.array_equal(axes, np.eye(3)):
        if np.radians(sigma) > _NEAR:
            return Finding(
                _MOUNTING, "unknown", "the camera turns about one axis: how the IMU is turned about it is open"
            )
        return Finding(_MOUNTING, "ok", f"the images' rotation is {angle:.2f} ± {sigma:.2f} degrees from it", angle)
    is_inverse = right and float(np.linalg.norm(rotation_log(inverse))) < _NEAR
    if axes is not None and _same(of_forces, axes):
        cure = "turn it, or the columns" if right else "that is left-handed: change signs of columns"
        cure = "is it inverted? It takes points of the sensor into the camera" if is_inverse else cure
        message = f"axes x, y, z of the sensor are {_describe(axes)} of the one it is made for: {cure}"
        return Finding(_MOUNTING, "error", message, angle)
    if axes is None and is_inverse:
        message = "it takes points of the camera into the sensor: invert it, T_cam_imu takes those of the sensor"
        return Finding(_MOUNTING, "error", message, angle)
    if axes is not None:
        return Finding(_MOUNTING, "unknown", "gyro and accelerometer have not the same axes")
    if not right:
        return Finding(_MOUNTING, "error", "the gyro is left-handed, and turned against it: are its signs right?")
    message = f"the sensor is turned by {angle:.1f} ± {sigma:.1f} degrees against it: calibrate with --imu"
    return Finding(_MOUNTING, "error" if np.radians(angle) > _NEAR else "warning", message, angle)


def _judge_place(times: np.ndarray, poses: np.ndarray, recording: InertialRecording, mounting: Finding) -> Finding:
    """Of the whole T_cam_imu, whose rotation is right, by the forces along the path."""
    # How well poses are known is estimated.
    path = CameraPath(times, poses, np.tile(1e-6 * np.eye(6), (len(times), 1, 1)), np.zeros((len(times), 6, 0)))
    try:
        found = calibrate_imu(path, recording.samples, recording.sensor, SHARED_ERRORS)
    except CalibrationError:
        return mounting
    place, covariance = found.sensor.T_left_imu[:3, 3], found.covariance[4:, 4:]
    change = place - recording.sensor.T_left_imu[:3, 3]
    size, sigma = float(np.linalg.norm(change)), float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    if found.is_foreign or sigma > _VAGUE:
        return mounting
    figure, where = f"{1e3 * size:.0f} ± {1e3 * sigma:.0f} mm", ", ".join(f"{each:.3f}" for each in place)
    if float(change @ np.linalg.solve(covariance + _LEVER**2 * np.eye(3), change)) < _CHI_SQUARE:
        return replace(mounting, message=f"{mounting.message}, the sensor's place {figure}")
    message = f"the sensor seems to be {figure} beside its place there, at ({where}) m: calibrate with --imu"
    return Finding(_MOUNTING, "warning", message, size)


def _judge_clock(fit: TurnFit, shift: float) -> Finding:
    delay, sigma = 1e3 * fit.delay, 1e3 * fit.delay_sigma
    figure = f"{abs(delay):.1f} ± {sigma:.1f} ms {'later' if delay > 0 else 'earlier'}"
    if abs(fit.delay) <= max(3.0 * fit.delay_sigma, _DELAY):
        return Finding(_CLOCK, "ok", f"its stamps are {figure} than those of the images", fit.delay)
    message = f"its stamps are {figure} than timeshift_cam_imu says: give {shift + fit.delay:.4f} s there"
    return Finding(_CLOCK, "warning", message, fit.delay)


def _same(of_forces: np.ndarray | None, axes: np.ndarray | None) -> bool:
    return of_forces is not None and axes is not None and np.array_equal(of_forces, axes)


def _describe(axes: np.ndarray) -> str:
    """Which axes a sensor has in the place of x, y, z, such as "y, -x, z"."""
    return ", ".join([f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.argmax(np.abs(row)))]}" for row in axes])
