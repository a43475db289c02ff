"""Recordings tracked with some images black: what becomes of the pose, and whether it is as sure as it says."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionState
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY
from sigmaslam.geometry.se3 import se3_body, se3_inverse, se3_log, skew
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame, blacken, interval
from sigmaslam_benchmarks.live.judge import DrivenPose, pose_errors
from sigmaslam_benchmarks.live.recordings import GoodFrames
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error
from sigmaslam_evaluation.metrics.truth_covariance import relative_truth_covariance, truth_covariance

METHODS = ("images", "gyro", "both sensors")
"""Images alone, with a gyro, and with gyro and accelerometer."""
STATES = ("velocity", "gravity", "gyro bias", "accelerometer bias")
BOUND = 2.5
"""Sigmas within which the end of the dark is to be."""
# Frames with images after the dark that are tracked.
_AFTER = 10
# Degrees by which each end of a true motion may be turned, at most: MH_01's turns are those of images alone to 0.05
# degrees in a second. Its rotations are off by 0.2 degrees, but alike for seconds.
_TRUTH_TURN = 0.035
# Order of the error state of the filter with an inertial sensor, see sigmaslam.estimation.inertial_motion.
_TURN, _VELOCITY, _GRAVITY, _GYRO_BIAS, _ACCEL_BIAS = (slice(k, k + 3) for k in (3, 6, 9, 12, 15))


@dataclass(frozen=True, slots=True)
class DarkCase:
    """A way to track a recording.

    Attributes:
        method: one of `METHODS`.
        marks: seconds of darkness after which it is judged, as many as it lasts at last; 0: none.
        first: number of the first dark frame.
    """

    method: str
    marks: tuple[float, ...] = (0.0,)
    first: int = 0

    @property
    def name(self) -> str:
        """Of its result."""
        return f"{self.method.replace(' ', '_')}-{self.marks[-1]:g}s-{self.first}"


@dataclass(frozen=True, slots=True)
class DarkResult:
    """What became of a run up to a mark; NaN where there is nothing to judge.

    Attributes:
        dark, inertial, lost: dark frames, and those of them called `inertial`, and `lost` or `starting`.
        lost_after: frames after the dark that are called `lost`.
        back: frames with images until one has a pose by its images again; -1: none of those that were tracked.
        end_metres, end_degrees: error of the motion from the last frame before the dark to its last frame.
        end_sigmas: length of the last dark frame's position error under the covariance of its pose since the keyframe.
        after_metres: error of the motion from the last frame before the dark to the first one that is back.
        nees, place_nees: of the pose since the keyframe and of its position per degree of freedom, mean over the dark;
            without dark of the pose that is published, mean over the frames that are tracked.
        states: NEES per degree of freedom of `STATES`, likewise; empty without an inertial sensor or its truth.
        tilt, tilt_sigma: error of gravity's direction and its standard deviation, degrees, at the end.
        ate: root mean square position error of all frames, metres.
        cpu: milliseconds a frame, of frames with images.
        known: seconds until gravity was known.
    """

    dark: int
    inertial: int
    lost: int
    lost_after: float
    back: float
    end_metres: float
    end_degrees: float
    end_sigmas: float
    after_metres: float
    nees: float
    place_nees: float
    states: dict[str, float] = field(default_factory=dict)
    tilt: float = float("nan")
    tilt_sigma: float = float("nan")
    ate: float = float("nan")
    cpu: float = float("nan")
    known: float = float("nan")


@dataclass(frozen=True, slots=True)
class _Tracked:
    """What the tracker says of a frame.

    Attributes:
        status: as it is called.
        pose: (4, 4) T_world_camera.
        covariance: (6, 6) of it, in the camera's own frame.
        keyframe: number of the frame that `motion` begins at; -1: there is none.
        motion: pose since the keyframe and what else is known.
        is_inertial: the sensor is in use.
        cpu: seconds.
    """

    status: str
    pose: np.ndarray
    covariance: np.ndarray
    keyframe: int
    motion: MotionState
    is_inertial: bool
    cpu: float


def run_dark(good: GoodFrames, case: DarkCase, seed: int) -> list[DarkResult]:
    """Tracks a recording as the case says and judges it at each of its marks.

    Args:
        good: all frames; of a run with darkness those long after it are left out.
        case: what to do.
        seed: of the noise of dark images.
    """
    rate, first = 1.0 / interval(good.frames), case.first
    counts = [round(seconds * rate) for seconds in case.marks]
    frames = blacken(good.frames, first, counts[-1], np.random.default_rng(seed))
    if counts[-1]:
        frames = frames[: first + counts[-1] + _AFTER]
    imu = None if case.method == METHODS[0] else good.imu
    if imu is not None and case.method == METHODS[1]:
        imu = replace(imu, sensor=replace(imu.sensor, has_accelerometer=False))
    tracked = list(_track(frames, good, imu))
    return [_judge(tracked, good, range(first, first + count), count == counts[-1]) for count in counts]


def _judge(tracked: Sequence[_Tracked], good: GoodFrames, dark: range, is_last: bool) -> DarkResult:
    """What became of a run after those dark frames; what comes after them only where images come."""
    statuses, missing = [each.status for each in tracked], float("nan")
    judged = dark if len(dark) else range(1, len(tracked))
    states = [_state_errors(tracked[k], good, k) for k in judged]
    lost, end, after, lost_after, back = ("lost", "starting"), np.full(6, np.nan), missing, missing, missing
    if len(dark):
        end = _motion_error(tracked, good, dark.start - 1, dark.stop - 1)
        errors = [_pose_sigmas(tracked[k], good, k) for k in dark]
    else:
        errors = _published_sigmas(tracked, good)
    if is_last:
        lost_after = sum(status in lost for status in statuses[dark.stop :]) if len(dark) else statuses.count("lost")
        kinds = (*lost, "inertial", "skipped")
        number = next((k for k in range(dark.stop, len(tracked)) if statuses[k] not in kinds), None)
        back = -1 if number is None else number - dark.stop
        if number is not None and len(dark):
            after = float(np.linalg.norm(_motion_error(tracked, good, dark.start - 1, number)[:3]))
    known = next((k for k, each in enumerate(tracked) if each.is_inertial), None)
    return DarkResult(
        dark=len(dark),
        inertial=sum(statuses[k] == "inertial" for k in dark),
        lost=sum(statuses[k] in lost for k in dark),
        lost_after=lost_after,
        back=back,
        end_metres=float(np.linalg.norm(end[:3])),
        end_degrees=float(np.degrees(np.linalg.norm(end[3:]))),
        end_sigmas=errors[-1][0] if len(dark) else missing,
        after_metres=after,
        nees=_mean([each for _, each in errors]),
        place_nees=_mean([each**2 / 3.0 for each, _ in errors]),
        states={name: _mean([each[name] for each in states if each]) for name in STATES} if any(states) else {},
        tilt=states[-1].get("tilt", missing),
        tilt_sigma=states[-1].get("tilt sigma", missing),
        ate=_ate(tracked, good),
        cpu=1e3 * _mean([each.cpu for k, each in enumerate(tracked) if k not in dark]),
        known=missing if known is None else good.frames[known].timestamp - good.frames[0].timestamp,
    )


def _track(frames: Sequence[DrivenFrame], good: GoodFrames, imu: InertialRecording | None) -> Iterator[_Tracked]:
    tracker = StereoTracker(good.camera, threads=1, imu=None if imu is None else imu.sensor)
    keyframe, given = -1, 0
    for number, frame in enumerate(frames):
        began = time.process_time()
        if imu is not None:
            end = int(np.searchsorted(imu.samples.timestamp, frame.timestamp + imu.sensor.time_shift)) + 1
            rows = imu.samples.select(np.arange(given, min(end, len(imu.samples))))
            for sample in zip(rows.timestamp.tolist(), rows.gyro, rows.accel, strict=True):
                tracker.add_imu(*sample)
            given = max(given, end)
        estimate = tracker.step(frame.left, frame.right, frame.timestamp)
        cpu = time.process_time() - began
        if estimate.tracks is not None:
            keyframe = number
        # No result has velocity, gravity and biases: they are the filter's own.
        motion = tracker._motion
        pose, covariance = estimate.T_world_camera, estimate.covariance
        yield _Tracked(estimate.status, pose, covariance, keyframe, motion.state, motion.is_inertial, cpu)


def _motion_error(tracked: Sequence[_Tracked], good: GoodFrames, first: int, last: int) -> np.ndarray:
    """(6,) error of the motion between two frames."""
    found = se3_inverse(tracked[first].pose) @ tracked[last].pose
    true = se3_inverse(good.truth.poses[first]) @ good.truth.poses[last]
    return np.asarray(se3_log(se3_inverse(found) @ true))


def _pose_sigmas(frame: _Tracked, good: GoodFrames, number: int) -> tuple[float, float]:
    """Mahalanobis length of the position's error since the keyframe, and NEES per degree of freedom of the pose's."""
    if frame.keyframe in (-1, number):
        return float("nan"), float("nan")
    true = se3_inverse(good.truth.poses[frame.keyframe]) @ good.truth.poses[number]
    error = se3_log(se3_inverse(frame.motion.step) @ true)
    spread = np.minimum(good.truth.covariance, truth_covariance(np.inf, _TRUTH_TURN))[None]
    claimed = se3_body(frame.motion.step, frame.motion.covariance[:6, :6])
    claimed = claimed + relative_truth_covariance(true[None], spread, spread)[0]
    position = squared_mahalanobis(error[:3], claimed[:3, :3])
    return float(np.sqrt(position)), float(squared_mahalanobis(error, claimed)) / 6.0


def _published_sigmas(tracked: Sequence[_Tracked], good: GoodFrames) -> list[tuple[float, float]]:
    """`_pose_sigmas` of the published poses, relative to the start, of the frames called `tracking`."""
    poses = [DrivenPose(k, each.status, each.pose, each.covariance) for k, each in enumerate(tracked)]
    errors = pose_errors(poses, good.truth)
    rows = [k for k, each in enumerate(tracked) if each.status == "tracking"]
    return list(zip(errors.sigmas[rows].tolist(), (errors.pose[rows] / 6.0).tolist(), strict=True))


def _state_errors(frame: _Tracked, good: GoodFrames, number: int) -> dict[str, float]:
    """NEES per degree of freedom of what only an inertial sensor knows; empty where it is unknown or has no truth."""
    path = None if good.imu is None else good.imu.source.with_name("truth.npz")
    if not frame.is_inertial or path is None or not path.is_file():
        return {}
    with np.load(path) as truth:
        t = good.frames[number].timestamp + float(truth["time_shift"])
        clock = truth["timestamp"]
        velocity, gyro_bias, accel_bias = (
            np.array([np.interp(t, clock, axis) for axis in truth[name].T])
            for name in ("velocity", "gyro_bias", "accel_bias")
        )
        gravity = truth["gravity"]
    others, covariance = frame.motion.twist, frame.motion.covariance
    R_camera_key, R_camera_world = frame.motion.step[:3, :3].T, good.truth.poses[number][:3, :3].T
    errors: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    for name, part, found, true in (
        ("velocity", _VELOCITY, others[:3], velocity),
        ("gravity", _GRAVITY, others[3:6], gravity),
    ):
        # In the camera, whose rotation since the keyframe is uncertain, too.
        J = np.zeros((3, len(covariance)))
        J[:, part], J[:, _TURN] = R_camera_key, R_camera_key @ skew(found)
        errors[name] = R_camera_world @ true - R_camera_key @ found, J @ covariance @ J.T
    errors["gyro bias"] = gyro_bias - others[6:9], covariance[_GYRO_BIAS, _GYRO_BIAS]
    errors["accelerometer bias"] = accel_bias - others[9:12], covariance[_ACCEL_BIAS, _ACCEL_BIAS]
    # Gravity has its length: only its direction is unknown.
    down = R_camera_key @ others[3:6] / STANDARD_GRAVITY
    across = np.linalg.svd(down[None])[2][1:]
    error, spread = errors["gravity"]
    errors["gravity"] = across @ error, across @ spread @ across.T
    found_errors = {name: float(squared_mahalanobis(*each)) / len(each[0]) for name, each in errors.items()}
    error, spread = errors["gravity"]
    to_degrees = 180.0 / np.pi / STANDARD_GRAVITY
    found_errors["tilt"] = to_degrees * float(np.linalg.norm(error))
    found_errors["tilt sigma"] = to_degrees * float(np.sqrt(np.trace(spread)))
    return found_errors


def _ate(tracked: Sequence[_Tracked], good: GoodFrames) -> float:
    rows = [k for k, each in enumerate(tracked) if np.isfinite([*each.pose.flat, *good.truth.poses[k].flat]).all()]
    times = np.array([good.frames[k].timestamp for k in rows])
    estimate = Trajectory(times, np.array([tracked[k].pose for k in rows]))
    return absolute_trajectory_error(estimate, Trajectory(times, good.truth.poses[rows])).rmse


def _mean(values: Sequence[float]) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")
