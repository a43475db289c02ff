"""An inertial sensor on the rendered camera: exact motion by the path's splines, and a small sensor's errors."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY, InertialSamples, InertialSensor
from sigmaslam.geometry.se3 import rigid_motion, rotation_exp
from sigmaslam_synthetic.motion.paths import Path

GRAVITY = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""m/s^2, in a world whose z is up."""
# Seconds of samples beyond the first and the last image.
_MARGIN = 0.05


@dataclass(frozen=True, slots=True)
class InertialGrade:
    """How good a sensor is, and how well its place on the camera is known: standard deviations, by default of Bosch's
    BMI160, which is common in stereo cameras and phones.

    Densities and walks are those of its Allan deviation in TUM VI (D. Schubert et al., The TUM VI Benchmark for
    Evaluating Visual-Inertial Odometry, IROS 2018), biases half of the typical offsets of its data sheet (3 deg/s,
    40 mg over its life), ranges two of its settings. Scale and misalignment are assumed, as the filter does: a
    calibration leaves over 0.2 %, without one TUM VI's sensor is off by 3 % (force) and 9 % (rate). Delay, place and
    turn are assumed, too: what a careful calibration with a board leaves over.

    Attributes:
        gyro_density, accel_density: of white noise, rad/s and m/s^2 per root hertz.
        gyro_walk, accel_walk: of the biases' random walks, rad/s^2 and m/s^3 per root hertz.
        gyro_bias, accel_bias: of the biases at the start, rad/s and m/s^2.
        scale, misalignment: of the factors along, and across, the axes.
        gyro_range, accel_range: largest values, rad/s and m/s^2.
        delay, place, turn: by how much the written time shift (s), place (m) and orientation (rad) are off.
        reach: the sensor is so far from the camera along each axis, at most, metres.
    """

    gyro_density: float = 8e-5
    accel_density: float = 1.4e-3
    gyro_walk: float = 2.2e-6
    accel_walk: float = 8.6e-5
    gyro_bias: float = 0.026
    accel_bias: float = 0.2
    scale: float = 0.005
    misalignment: float = 0.005
    gyro_range: float = 500.0 * np.pi / 180.0
    accel_range: float = 8.0 * STANDARD_GRAVITY
    delay: float = 2e-3
    place: float = 5e-3
    turn: float = 3.5e-3
    reach: float = 0.05


@dataclass(frozen=True, slots=True)
class InertialTruth:
    """What the samples were made of.

    Attributes:
        timestamp: (N,) seconds, of the sensor's clock, as the samples have them.
        gyro, accel: (N, 3) exact angular rate and specific force in the sensor's frame, rad/s and m/s^2.
        velocity: (N, 3) of the sensor, in the frame of the true poses, m/s.
        gyro_bias, accel_bias: (N, 3).
        gravity: (3,) in the frame of the true poses, m/s^2.
        T_left_imu: (4, 4) takes points of the sensor into the left camera.
        time_shift: clock of the sensor minus that of the camera, seconds.
        gyro_matrix, accel_matrix: (3, 3) factors on the exact values: scale and misalignment.
        range: (2,) largest angular rate and specific force.
    """

    timestamp: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gravity: np.ndarray
    T_left_imu: np.ndarray
    time_shift: np.ndarray
    gyro_matrix: np.ndarray
    accel_matrix: np.ndarray
    range: np.ndarray


@dataclass(frozen=True, slots=True)
class SimulatedInertial:
    """A sensor as its files describe it, what it measured, and the truth."""

    sensor: InertialSensor
    samples: InertialSamples
    truth: InertialTruth


def measure_exactly(path: Path, T_body_imu: np.ndarray, t: np.ndarray) -> tuple[InertialSamples, np.ndarray]:
    """Angular rate and specific force of a sensor on a body, and its velocity (N, 3) in the world.

    Args:
        path: of the body, in a world whose z is up.
        T_body_imu: (4, 4) takes points of the sensor to the body.
        t: (N,) seconds.
    """
    motion, lever, R = path.motion(t), T_body_imu[:3, 3], T_body_imu[:3, :3]
    swing = np.cross(motion.rate, lever)
    in_body = np.cross(motion.rate_change, lever) + np.cross(motion.rate, swing)
    force = in_body + np.einsum("nji,nj->ni", motion.rotation, motion.acceleration - GRAVITY)
    velocity = motion.velocity + np.einsum("nij,nj->ni", motion.rotation, swing)
    return InertialSamples(t, motion.rate @ R, force @ R), velocity


def wander(rng: np.random.Generator, count: int, period: float, first: float, walk: float) -> np.ndarray:
    """Biases (count, 3) of a random walk.

    Args:
        count: of samples, `period` seconds apart.
        period: seconds.
        first: standard deviation of the first one.
        walk: density of the walk, per second and root hertz.
    """
    steps = walk * np.sqrt(period) * rng.standard_normal((count, 3))
    steps[0] = first * rng.standard_normal(3)
    return np.cumsum(steps, axis=0)


def simulate_inertial(
    path: Path,
    duration: float,
    rate: float,
    rng: np.random.Generator,
    T_truth_world: np.ndarray,
    grade: InertialGrade | None = None,
) -> SimulatedInertial:
    """A sensor of random place and errors on a camera.

    Args:
        path: of the left camera, from 0 on; before it samples are those of its start.
        duration: seconds from the first image, at 0, to the last one.
        rate: samples a second.
        T_truth_world: (4, 4) takes the world to the frame of the true poses.
    """
    grade = grade or InertialGrade()
    R = Rotation.from_quat(rng.standard_normal(4)).as_matrix()
    mounting = rigid_motion(R, rng.uniform(-grade.reach, grade.reach, 3))
    turn, place = grade.turn * rng.standard_normal(3), grade.place * rng.standard_normal(3)
    T_left_imu = mounting @ rigid_motion(rotation_exp(turn), place)
    delay = float(grade.delay * rng.standard_normal())
    period = 1.0 / rate
    first = -_MARGIN - rng.uniform(0.0, period)
    stamps = first + period * np.arange(int((duration + 2.0 * _MARGIN) / period) + 2)
    exact, velocity = measure_exactly(path, T_left_imu, np.maximum(stamps - delay, 0.0))
    gyro_bias = wander(rng, len(stamps), period, grade.gyro_bias, grade.gyro_walk)
    accel_bias = wander(rng, len(stamps), period, grade.accel_bias, grade.accel_walk)
    matrices = grade.misalignment * rng.standard_normal((2, 3, 3))
    matrices[:, range(3), range(3)] = 1.0 + grade.scale * rng.standard_normal((2, 3))
    white = rng.standard_normal((2, len(stamps), 3)) / np.sqrt(period)
    gyro = exact.gyro @ matrices[0].T + gyro_bias + grade.gyro_density * white[0]
    accel = exact.accel @ matrices[1].T + accel_bias + grade.accel_density * white[1]
    R_truth_world = T_truth_world[:3, :3]
    truth = InertialTruth(
        stamps,
        exact.gyro,
        exact.accel,
        velocity @ R_truth_world.T,
        gyro_bias,
        accel_bias,
        R_truth_world @ GRAVITY,
        T_left_imu,
        np.array(delay),
        matrices[0],
        matrices[1],
        np.array([grade.gyro_range, grade.accel_range]),
    )
    samples = InertialSamples(
        stamps,
        np.clip(gyro, -grade.gyro_range, grade.gyro_range),
        np.clip(accel, -grade.accel_range, grade.accel_range),
    )
    sensor = InertialSensor(mounting, grade.gyro_density, grade.accel_density, grade.gyro_walk, grade.accel_walk)
    return SimulatedInertial(sensor, samples, truth)
