"""Place, rotation and clock of an inertial sensor by a camera's path: batch least squares over preintegrated samples.

Unknown are, for every image, the camera's pose, the sensor's velocity and its biases, and for all together delay,
rotation, lever arm and gravity. Poses are measured by the camera, their changes by the samples between two images (C.
Forster et al.: On-Manifold Preintegration, IEEE Transactions on Robotics 33(1), 2017, eqs. 35 - 38). Images follow each
other, so that the normal equations are a chain with a border, which `arrow_solver` eliminates image by image. How noisy
poses, gyro and accelerometer are is estimated with the rest (variance components: W. Foerstner, B. P. Wrobel:
Photogrammetric Computer Vision, 2016, section 4.2.4).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sigmaslam.calibration.arrow_solver import ArrowSystem, Factor
from sigmaslam.errors import CalibrationError
from sigmaslam.estimation.inertial_turns import fit_turns
from sigmaslam.estimation.preintegration import POSITION, VELOCITY, Preintegrated, preintegrate
from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY, InertialSamples, InertialSensor
from sigmaslam.geometry.se3 import nearest_rotation, rotation_exp, rotation_log, se3_exp, se3_inverse, se3_log, skew
from sigmaslam.table import Table

NAMES = ("delay", *(f"{part}_{axis}" for part in ("rotation", "lever") for axis in "xyz"))
"""Of the calibration: seconds; radians, of T_cam_imu from the right; metres."""
MAX_ROUNDS = 25
# Of an image: pose, velocity, biases; of all: the above and gravity.
_POSE, _SPEED, _BIASES, _SIZE = slice(0, 6), slice(6, 9), slice(9, 15), 15
_DELAY, _ROTATION, _LEVER, _GRAVITY, _COMMON = 0, slice(1, 4), slice(4, 7), slice(7, 10), 10
# Prior standard deviations: an accelerometer's bias (data sheets: 0.02 to 0.5 m/s^2), a gyro's, rad/s, and by how much
# gravity's length, with the scale error of an accelerometer, differs from the standard one, m/s^2.
_PRIOR_ACCEL, _PRIOR_GYRO, _PRIOR_LENGTH = 0.2, 0.2, 0.05
# Variances of the densities to begin with, as in flight; seconds, radians and metres that are no change.
_FIRST_SCALE, _CONVERGED = 25.0, 1e-6
# So many rounds integrate the samples anew; after them biases and delay hardly move, and the first order will do.
_INTEGRATED = 3
# Turns that are off by more are in another unit (focal lengths of few views are off by a tenth); those of which less is
# explained are of another motion. Forces, m/s^2/sqrt(Hz), have 0.13 of a wrong sign or axis, MH_01's 0.003 to 0.03.
_SCALE_TOLERANCE, _EXPLAINED, _FOREIGN_FORCE = 0.3, 0.7, 0.1
# Images: fewer say nothing; they lie no further apart than that, seconds.
_FEWEST, _LONGEST = 20, 2.0
# Power spectra of accelerations that nobody measured, across gaps, m^2/s^3 and rad^2/s^3: those of a hand.
_UNKNOWN = np.array([10.0, 10.0])


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """What a recording says of an inertial sensor.

    Attributes:
        sensor: with mounting and time shift as found; noise and walks are those of the file.
        covariance: (7, 7) of `NAMES`.
        biases: (6,) of gyro and accelerometer at the end of the recording, rad/s and m/s^2.
        bias_covariance: (6, 6).
        gravity: (3,) in the world of the poses, m/s^2.
        gravity_sigma: standard deviation of its direction, radians, about the less certain axis.
        scales: (3,) how many times as large as said the standard deviations of poses, gyro and accelerometer are.
        images: number of poses.
    """

    sensor: InertialSensor
    covariance: np.ndarray
    biases: np.ndarray
    bias_covariance: np.ndarray
    gravity: np.ndarray
    gravity_sigma: float
    scales: np.ndarray
    images: int

    @property
    def is_foreign(self) -> bool:
        """Forces hardly follow the motion."""
        return bool((self.scales[2] - 1.0) * self.sensor.accel_density > _FOREIGN_FORCE)


@dataclass(frozen=True, slots=True)
class CameraPath(Table):
    """Poses of a left camera that are measured.

    Attributes:
        times: (N,) seconds, increasing.
        poses: (N, 4, 4) T_world_camera, in any world that stands still.
        covariances: (N, 6, 6) of errors of their own, in the camera's frame, translation before rotation; their size is
            estimated.
        common: (N, 6, P) by what errors that all poses have in common, each of a sigma of one, move them.
    """

    times: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    common: np.ndarray


@dataclass(frozen=True, slots=True)
class _State:
    """Estimates of N images and of what they share."""

    poses: np.ndarray
    speeds: np.ndarray
    biases: np.ndarray
    T_left_imu: np.ndarray
    gravity: np.ndarray
    shift: float

    def moved(self, steps: np.ndarray, shared: np.ndarray) -> "_State":
        """With steps (N, 15) of the images and (10,) of what they share."""
        T = self.T_left_imu.copy()
        T[:3, :3] = nearest_rotation(T[:3, :3] @ rotation_exp(shared[_ROTATION]))
        T[:3, 3] += shared[_LEVER]
        return _State(
            self.poses @ se3_exp(steps[:, _POSE]),
            self.speeds + steps[:, _SPEED],
            self.biases + steps[:, _BIASES],
            T,
            self.gravity + shared[_GRAVITY],
            self.shift + float(shared[_DELAY]),
        )


def calibrate_imu(
    path: CameraPath,
    samples: InertialSamples,
    sensor: InertialSensor,
    shared_errors: float = 1.0,
    done: Callable[[], object] = lambda: None,
) -> ImuCalibration:
    """Calibrates an inertial sensor beside a camera.

    Args:
        path: of the left camera.
        sensor: its noise; mounting and time shift are where the search begins: the rotation may be anything.
        shared_errors: so many times fewer poses than there are have errors of their own.
        done: called after each of at most 25 rounds.

    Raises:
        CalibrationError: too few images within the table's time, turns that are not the gyro's, or a motion that leaves
            something open.
    """
    t = samples.timestamp - sensor.time_shift
    path = path.select((path.times > t[0] + 0.1) & (path.times < t[-1] - 0.1))
    times, measured = path.times, path.poses
    if len(times) < _FEWEST or np.max(np.diff(times)) > _LONGEST:
        raise CalibrationError(
            f"{len(times)} images with a pose lie within the table's {t[0]:.1f} to {t[-1]:.1f} s, {_FEWEST} must, none "
            f"over {_LONGEST:g} s from the next: have both one clock, keep the board in view, move and turn the rig"
        )
    state = _start(times, measured, samples, sensor)
    roots = np.linalg.cholesky(np.linalg.inv(path.covariances)).transpose(0, 2, 1)
    scales = np.array([1.0, _FIRST_SCALE, _FIRST_SCALE])
    for turn in range(MAX_ROUNDS):
        if turn < _INTEGRATED:
            reference, whole = state, _integrate(times + state.shift, state.biases, samples, sensor)
        delay = state.shift - reference.shift
        motions = [
            each.corrected(np.r_[change, delay])
            for each, change in zip(whole, state.biases - reference.biases, strict=False)
        ]
        factors = _factors(state, measured, roots, motions, sensor, scales)
        try:
            system = ArrowSystem(factors, len(times), _SIZE, _COMMON)
        except np.linalg.LinAlgError:
            raise CalibrationError(
                "the motion leaves the mounting open: turn the rig about all axes and move it"
            ) from None
        steps, shared = system.solve()
        moved = float(np.max(np.abs(shared[: len(NAMES)])))
        state = state.moved(steps, shared)
        done()
        if turn < _INTEGRATED - 1:
            continue
        before, scales = scales, scales * _components(system, factors, steps, shared)
        scales[1:] = np.maximum(scales[1:], 1.0)
        if moved < _CONVERGED and np.max(np.abs(scales / before - 1.0)) < 1e-2:
            break
    last, joint = (shared_errors * each for each in system.last_covariance())
    moves = [
        ArrowSystem(_factors(state, poses, roots, motions, sensor, scales), len(times), _SIZE, _COMMON).solve()
        for poses in (measured, *(measured @ se3_exp(each) for each in np.moveaxis(path.common, 2, 0)))
    ]
    for steps, shared in moves[1:]:
        of_last, of_shared = steps[-1] - moves[0][0][-1], shared - moves[0][1]
        last, joint = last + np.outer(of_last, of_last), joint + np.outer(of_shared, of_shared)
    tangent = np.linalg.svd(state.gravity[None])[2][1:]
    of_gravity = tangent @ joint[_GRAVITY, _GRAVITY] @ tangent.T / STANDARD_GRAVITY**2
    return ImuCalibration(
        replace(sensor, T_left_imu=state.T_left_imu, time_shift=state.shift),
        joint[: len(NAMES), : len(NAMES)],
        state.biases[-1],
        last[_BIASES, _BIASES],
        state.gravity,
        float(np.sqrt(np.linalg.eigvalsh(of_gravity)[-1])),
        np.sqrt(scales),
        len(times),
    )


def _integrate(
    times: np.ndarray, biases: np.ndarray, samples: InertialSamples, sensor: InertialSensor
) -> list[Preintegrated]:
    """Motions between times (N,) of the sensor's clock, with the biases (N, 6) of the first of each two."""
    motions = []
    for (start, end), bias in zip(pairwise(times.tolist()), biases, strict=False):
        first, last = np.searchsorted(samples.timestamp, [start, end])
        near = samples.select(np.arange(max(first - 2, 0), min(last + 2, len(samples))))
        motions.append(preintegrate(near, start, end, bias[:3], bias[3:], sensor.spectra, _UNKNOWN))
    return motions


def _start(times: np.ndarray, poses: np.ndarray, samples: InertialSamples, sensor: InertialSensor) -> _State:
    """Rotation, delay and gyro bias by the turns alone; gravity as what forces are in the mean; speeds of the path."""
    R = poses[:, :3, :3]
    turns = rotation_log(R[:-1].transpose(0, 2, 1) @ R[1:])
    fit = fit_turns(times[:-1], times[1:], turns, samples, sensor.time_shift)
    if (
        fit is None
        or fit.explained < _EXPLAINED
        or abs(fit.scale - 1.0) > _SCALE_TOLERANCE
        or np.linalg.det(fit.rotation) < 0.0
    ):
        raise CalibrationError(
            "the gyro's turns are not those of the camera: are they in rad/s, right-handed, of the same recording, and "
            "is the clock within half a second? `sigmaslam check --imu` says which"
        )
    if np.degrees(np.sqrt(np.linalg.eigvalsh(fit.rotation_covariance)[-1])) > 10.0:
        raise CalibrationError("the camera turns about one axis alone: turn the rig about all three, and move it")
    T_left_imu = sensor.T_left_imu.copy()
    T_left_imu[:3, :3] = fit.rotation.T
    shift = sensor.time_shift + fit.delay
    forces = np.column_stack([np.interp(times + shift, samples.timestamp, each) for each in samples.accel.T])
    gravity = -np.mean(np.einsum("nij,nj->ni", R @ fit.rotation.T, forces), axis=0)
    speeds = np.gradient((poses @ T_left_imu)[:, :3, 3], times, axis=0)
    biases = np.tile(np.r_[fit.bias, np.zeros(3)], (len(times), 1))
    return _State(poses, speeds, biases, T_left_imu, gravity * (STANDARD_GRAVITY / np.linalg.norm(gravity)), shift)


def _factors(
    state: _State,
    measured: np.ndarray,
    roots: np.ndarray,
    motions: list[Preintegrated],
    sensor: InertialSensor,
    scales: np.ndarray,
) -> list[Factor]:
    """All that is known, whitened; the groups of the variance components are 0 poses, 1 gyro, 2 accelerometer."""
    factors = []
    for k, root in enumerate(roots / np.sqrt(scales[0])):
        residual = root @ se3_log(se3_inverse(measured[k]) @ state.poses[k])
        J = np.zeros((6, _SIZE))
        J[:, _POSE] = root
        factors.append(Factor(k, residual, J, None, None, ((0, slice(0, 6)),)))
    prior = np.zeros((6, _SIZE))
    prior[:, _BIASES] = np.diag(1.0 / np.repeat([_PRIOR_GYRO, _PRIOR_ACCEL], 3))
    length = float(np.linalg.norm(state.gravity))
    border = np.zeros((7, _COMMON))
    border[6, _GRAVITY] = state.gravity / length / _PRIOR_LENGTH
    residual = np.r_[prior[:, _BIASES] @ state.biases[0], (length - STANDARD_GRAVITY) / _PRIOR_LENGTH]
    factors.append(Factor(0, residual, np.r_[prior, np.zeros((1, _SIZE))], None, border, ()))
    walk = np.repeat([sensor.gyro_walk, sensor.accel_walk], 3)
    for k, motion in enumerate(motions):
        residual, J, K, border = _inertial(state, k, motion)
        noise = scales[1] * motion.gyro_noise + scales[2] * motion.accel_noise
        white = np.linalg.inv(np.linalg.cholesky(noise))
        steady = np.diag(1.0 / (walk * np.sqrt(motion.seconds)))
        whitened = [
            np.concatenate([white @ each[:9], steady @ each[9:]])
            for each in (residual[:, None], J, K, np.r_[border, np.zeros((6, _COMMON))])
        ]
        groups = ((1, slice(0, 3)), (2, slice(3, 9)))
        factors.append(Factor(k, whitened[0][:, 0], whitened[1], whitened[2], whitened[3], groups))
    return factors


def _inertial(state: _State, k: int, motion: Preintegrated) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Residual (15,) from image k to the next, with its derivatives by both images and by what they share."""
    R_ci, lever = state.T_left_imu[:3, :3], state.T_left_imu[:3, 3]
    s, g = motion.seconds, state.gravity
    R, R_next = (state.poses[j, :3, :3] @ R_ci for j in (k, k + 1))
    place, place_next = (state.poses[j, :3, 3] + state.poses[j, :3, :3] @ lever for j in (k, k + 1))
    speed, speed_next = state.speeds[k], state.speeds[k + 1]
    v = R.T @ (speed_next - speed - s * g)
    p = R.T @ (place_next - place - s * speed - 0.5 * s * s * g)
    residual = np.concatenate(
        [
            rotation_log(motion.turn.T @ R.T @ R_next),
            v - motion.velocity,
            p - motion.position,
            state.biases[k + 1] - state.biases[k],
        ]
    )
    # Turns of the sensor (from the right) and places of it by pose, rotation and lever arm.
    J, K, border = np.zeros((15, _SIZE)), np.zeros((15, _SIZE)), np.zeros((9, _COMMON))
    back = R.T @ R_next
    for matrix, by_turn, sign, camera in (
        (J, np.concatenate([-back.T, skew(v), skew(p)]), -1.0, state.poses[k, :3, :3]),
        (K, np.concatenate([np.eye(3), np.zeros((6, 3))]), 1.0, state.poses[k + 1, :3, :3]),
    ):
        matrix[:9, 3:6] = by_turn @ R_ci.T
        matrix[POSITION, 0:3] = sign * R.T @ camera
        matrix[POSITION, 3:6] -= sign * R.T @ camera @ skew(lever)
        matrix[VELOCITY, _SPEED] = sign * R.T
        matrix[9:, _BIASES] = sign * np.eye(6)
        border[:, _ROTATION] += by_turn
        border[POSITION, _LEVER] += sign * R.T @ camera
    J[POSITION, _SPEED] = -s * R.T
    J[:9, _BIASES] -= motion.slope[:, :6]
    border[:, _DELAY] = -motion.slope[:, 6]
    border[VELOCITY, _GRAVITY], border[POSITION, _GRAVITY] = -s * R.T, -0.5 * s * s * R.T
    return residual, J, K, border


def _components(system: ArrowSystem, factors: list[Factor], steps: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """(3,) by how much the variances of the groups are larger than was claimed: squares over redundancy."""
    squares, redundancy = np.zeros(3), np.zeros(3)
    for factor, spread in zip(factors, system.spreads(), strict=True):
        residual = factor.after(steps, shared)
        for group, rows in factor.groups:
            squares[group] += float(residual[rows] @ residual[rows])
            redundancy[group] += len(spread[rows]) - float(spread[rows].sum())
    return np.asarray(squares / np.maximum(redundancy, 1.0))
