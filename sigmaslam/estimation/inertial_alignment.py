"""Gravity, velocity and biases from a short while of poses: linear, because stereo knows the scale.

T. Qin, P. Li, S. Shen: VINS-Mono, IEEE Transactions on Robotics 34(4), 2018, section V-B, without the scale; at rest
the same equations hold.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sigmaslam.estimation.inertial_buffer import InertialBuffer
from sigmaslam.estimation.preintegration import GYRO_BIAS, POSITION, SENSOR, TURN, Preintegrated
from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY
from sigmaslam.geometry.se3 import rotation_log, se3_exp

_LOGGER = logging.getLogger(__name__)

# Gravity is looked for in the poses of so many seconds, and in no fewer than so many poses.
_ALIGNED_SECONDS, _ALIGNED_POSES = 1.0, 5
# Sooner in so many, whose 27 coordinates are more than twice the unknowns; 0.4 s at 20 Hz, but for jitter.
_SOON_SECONDS, _SOON_POSES = 0.35, 9
# Poses of a camera that is so slow that fewer fit into the seconds above are kept for so long, seconds.
_LONGEST = 10.0
# m/s^2, standard deviation of an accelerometer's bias: data sheets of small sensors say 0.02 to 0.5.
_ACCEL_BIAS = 0.2
# Of gravity's length on Earth, m/s^2: it is 9.78 to 9.83.
_GRAVITY_LENGTH = 0.02
# Metres and radians by which poses from frame to frame are off at least, and rad/s that a gyro's bias then is.
_LEAST_PLACE, _LEAST_TURN = 2e-4, 2e-4
# Gravity whose length is off by more than three sigmas and this was not found, m/s^2; nor was one whose direction is
# less certain, radians.
_LENGTH_TOLERANCE, _LEAST_TILT_CERTAINTY = 0.5, 0.05
# Forces have the wrong sign where the other one leaves less than this share of the variance: MH01 0.08 to 0.2, or 11.
_WRONG_SIGN = 1 / 4
# Seconds of images without gravity after which it is said.
_PATIENCE = 3.0
# Turns of gyro and images that differ by more are not of one body: of the turns, and radians from frame to frame.
_TURN_SHARE, _TURN_ERROR = 0.25, 3e-3
# rad/s: a gyro's bias is not known better at the start, whatever residuals say.
_GYRO_BIAS_FLOOR = 2e-3
# Residuals are no white noise: neighbours share landmarks, so that there are about so many times fewer of them.
_SHARED = 4.0


@dataclass(frozen=True, slots=True)
class Alignment:
    """What is known at the last pose, in the frame of all poses.

    Attributes:
        velocity, gravity: (3,) each; the velocity is the sensor's.
        biases: (6,) of gyro, beside that of the motions, and accelerometer.
        covariance: (12, 12) of the four.
        shared: (12, 25) of the four with delay, factors and mounting, whose errors enter all of them.
    """

    velocity: np.ndarray
    gravity: np.ndarray
    biases: np.ndarray
    covariance: np.ndarray
    shared: np.ndarray


def gyro_fits(bodies: np.ndarray, motions: Sequence[Preintegrated]) -> bool:
    """Whether the gyro's turns between poses (N, 4, 4) of the sensor are those of the images.

    So that its unit, axes and clock are right; the N - 1 motions were integrated with its bias.
    """
    R = bodies[:, :3, :3]
    seen = rotation_log(R[:-1].transpose(0, 2, 1) @ R[1:])
    measured = rotation_log(np.array([each.turn for each in motions]))
    size = np.sqrt(np.mean((seen - measured) ** 2))
    return bool(size <= max(_TURN_SHARE * np.sqrt(np.mean(seen**2)), _TURN_ERROR))


def align_gyro(bodies: np.ndarray, motions: Sequence[Preintegrated]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The gyro's bias by the turns between poses (N, 4, 4) of the sensor that images saw, least squares.

    Bias (3,) on top of the one that the N - 1 motions were integrated with, rad/s, its covariance (3, 3), and its slope
    (3, 19) by errors of the sensor.
    """
    R = bodies[:, :3, :3]
    turns = np.array([each.turn for each in motions])
    slope, by = (np.concatenate([each.slope[TURN, part] for each in motions]) for part in (GYRO_BIAS, SENSOR))
    departure = rotation_log(turns.transpose(0, 2, 1) @ R[:-1].transpose(0, 2, 1) @ R[1:]).ravel()
    information = slope.T @ slope
    bias = np.linalg.solve(information, slope.T @ departure)
    residual = departure - slope @ bias
    variance = max(float(residual @ residual) / max(len(residual) - 3, 1), _LEAST_TURN**2)
    return bias, _SHARED * variance * np.linalg.inv(information), -np.linalg.solve(information, slope.T @ by)


def align(
    poses: np.ndarray, mounting: np.ndarray, motions: Sequence[Preintegrated], sensor_sigma: np.ndarray
) -> Alignment | None:
    """Velocity, gravity and biases by least squares; None where they cannot be told.

    A sensor that is mounted otherwise than believed finds gravity turned likewise, so that the two errors nearly
    cancel in what is predicted: `shared` holds that.

    Args:
        poses: (N, 4, 4) of the camera, N >= 4.
        mounting: (4, 4) T_camera_imu.
        motions: N - 1 between successive poses, integrated with the gyro's bias and without the accelerometer's.
        sensor_sigma: (25,) of the clock's delay, scale and misalignment, and the mounting, perturbed from the left.
    """
    found, covariance, excess, columns = _solve(poses @ mounting, motions)
    if excess > _LENGTH_TOLERANCE or _tilt(covariance) > _LEAST_TILT_CERTAINTY:
        return None
    columns = columns * sensor_sigma[:-6]
    for error in np.diag(sensor_sigma[-6:]):
        one, other = (_solve(poses @ se3_exp(side * error) @ mounting, motions)[0] for side in (1.0, -1.0))
        columns = np.column_stack([columns, 0.5 * (one - other)])
    covariance[6:9, 6:9] += _GYRO_BIAS_FLOOR**2 * np.eye(3)
    return Alignment(found[:3], found[3:6], found[6:], covariance + columns @ columns.T, columns * sensor_sigma)


def has_wrong_sign(bodies: np.ndarray, motions: Sequence[Preintegrated]) -> bool:
    """Whether forces of the other sign fit the path better, which give gravity's length as well; as of `gyro_fits`."""
    turned = [replace(each, velocity=-each.velocity, position=-each.position) for each in motions]
    right, wrong = (np.trace(_solve(bodies, each)[1]) for each in (motions, turned))  # which residuals scale
    return bool(wrong < _WRONG_SIGN * right)


def _tilt(covariance: np.ndarray) -> float:
    """Standard deviation of gravity's direction, radians, of the less certain axis."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1]) / STANDARD_GRAVITY)


def _solve(bodies: np.ndarray, motions: Sequence[Preintegrated]) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """(12,) velocity, gravity, biases; covariance; by how much gravity's length errs; slope (12, 19) by `SENSOR`."""
    R, p = bodies[:, :3, :3], bodies[:, :3, 3]
    # Place and velocity of each pose as maps of first place, first velocity, gravity, bias; the sensor; and one.
    identity, unknown = np.eye(12, 32), slice(9, 12)
    place, speed = identity[:3], identity[3:6]
    rows = [place]
    for k, each in enumerate(motions):
        s, known = each.seconds, np.r_[np.zeros(3), each.velocity, each.position]
        gained, moved = R[k] @ np.column_stack([each.slope, known]).reshape(3, 3, 26)[1:, :, 3:]
        place = place + s * speed + 0.5 * s * s * identity[6:9]
        place[:, 9:] += moved
        speed = speed + s * identity[6:9]
        speed[:, 9:] += gained
        rows.append(place)
    whole = np.concatenate(rows)
    A, by, y = whole[:, :12], whole[:, 12:31], p.ravel() - whole[:, 31]
    # Errors of the samples add up between poses that are far apart in time.
    integrated = np.mean([np.trace(each.accel_noise[POSITION, POSITION]) / 3.0 for each in motions])
    least = _LEAST_PLACE**2 + integrated
    variance, direction = least, np.zeros(3)
    for _ in range(3):  # without gravity's length, with it, and with the residuals' size
        weighted = A.T / variance
        information, vector = weighted @ A, weighted @ y
        information[unknown, unknown] += np.eye(3) / _ACCEL_BIAS**2
        free, alone = np.linalg.inv(information), vector.copy()
        information[6:9, 6:9] += np.outer(direction, direction) / _GRAVITY_LENGTH**2
        vector[6:9] += direction * STANDARD_GRAVITY / _GRAVITY_LENGTH**2
        solution = np.linalg.solve(information, vector)
        residual = y - A @ solution
        variance = _SHARED * max(float(residual @ residual) / max(len(y) - 12, 1), least)
        direction = solution[6:9] / np.linalg.norm(solution[6:9])
    length, spread = np.linalg.norm((free @ alone)[6:9]), direction @ free[6:9, 6:9] @ direction
    end = np.concatenate([speed, identity[6:9], np.zeros((3, 32)), identity[9:]])[:, :12]
    covariance = end @ np.linalg.inv(information) @ end.T
    slope = -end @ np.linalg.solve(information, weighted @ by)
    slope[:3] += speed[:, 12:31]
    slope[3:6] -= np.outer(direction, direction @ slope[3:6])
    bias, covariance[6:9, 6:9], slope[6:9] = align_gyro(bodies, motions)
    velocity = speed @ np.r_[solution, np.zeros(19), 1.0]
    found = np.concatenate([velocity, direction * STANDARD_GRAVITY, bias, solution[unknown]])
    excess = float(abs(length - STANDARD_GRAVITY) - 3.0 * np.sqrt(spread))
    return found, 0.5 * (covariance + covariance.T), excess, slope


class GravitySearch:
    """Looks for gravity in the last poses by images.

    Attributes:
        poses: T_first_camera (4, 4) with their times.
    """

    def __init__(self, sensor_sigma: np.ndarray) -> None:
        self.poses: list[tuple[float, np.ndarray]] = []
        self._sensor_sigma, self._is_refused = sensor_sigma, False
        self._first: float | None = None
        self._has_wrong_sign = False

    def find(
        self, time: float, pose: np.ndarray, samples: InertialBuffer, T_camera_imu: np.ndarray, densities: np.ndarray
    ) -> Alignment | None:
        """Takes the pose (4, 4) T_first_camera of a time; what is known with it, with the whole of the gyro's bias.

        `densities` are as of `InertialBuffer.preintegrate`.
        """
        self.poses.append((time, pose))
        while self.poses[0][0] < time - _LONGEST or (
            len(self.poses) > _ALIGNED_POSES and self.poses[1][0] <= time - _ALIGNED_SECONDS
        ):
            del self.poses[0]
        times, poses = [each[0] for each in self.poses], np.array([pose for _, pose in self.poses])
        seconds, is_soon = time - times[0], len(times) >= _SOON_POSES
        if len(times) < _ALIGNED_POSES or seconds < (_SOON_SECONDS if is_soon else 0.9 * _ALIGNED_SECONDS):
            return None
        bodies = poses @ T_camera_imu
        bias, whole = np.zeros(3), list[Preintegrated]()
        for _ in range(2):  # long intervals are no longer linear in the bias
            motions = [samples.preintegrate(*pair, np.r_[bias, np.zeros(3)], densities) for pair in pairwise(times)]
            whole = [each for each in motions if each is not None and each.missing == 0.0]
            if len(whole) < len(motions):
                self._complain(time, "samples are missing; all up to an image are to come before it")
                return None
            bias = bias + align_gyro(bodies, whole)[0]
        self._has_wrong_sign = self._has_wrong_sign or has_wrong_sign(bodies, whole)
        problem = "forces have the wrong sign: at rest they point away from the ground" if self._has_wrong_sign else ""
        if not gyro_fits(bodies, whole):
            problem = "turns are not those of the images; are unit (rad/s), axes, T_cam_imu and clock right?"
        if problem:
            if not self._is_refused:
                _LOGGER.warning("the inertial sensor is not used: its %s", problem)
            self._is_refused, self.poses = True, []
            return None
        found = align(poses, T_camera_imu, whole, self._sensor_sigma)
        if found is None:
            self._complain(time, "forces do not fit the path, or it tells too little; are unit (m/s^2) and axes right?")
            return None
        tilt, way = np.degrees(_tilt(found.covariance)), np.linalg.norm(np.diff(bodies[:, :3, 3], axis=0), axis=1).sum()
        _LOGGER.info("gravity is known to %.1f degrees, from %.1f s of images along %.2f m", tilt, seconds, way)
        return replace(found, biases=np.r_[bias, np.zeros(3)] + found.biases)

    def _complain(self, time: float, cause: str) -> None:
        """Says once that gravity is still unknown, and why."""
        self._first = time if self._first is None else self._first
        if time - self._first > _PATIENCE:
            _LOGGER.warning("the inertial sensor is not used yet, gravity is unknown after %g s: %s", _PATIENCE, cause)
            self._first = np.inf
