"""What an inertial sensor says beside the pose: which way is up, and its biases."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.geometry.se3 import rotation_exp, skew


@dataclass(frozen=True, slots=True)
class InertialEstimate:
    """What is known with a frame, once gravity is.

    Attributes:
        up: (3,) unit vector away from the ground, in the left camera's frame.
        up_covariance: (3, 3) of it; none along it.
        T_gravity: (4, 4) takes points of the world, as this frame knows it, into one with z up and the same origin.
        gyro_bias, accel_bias: (3,) rad/s and m/s^2, in the sensor's frame.
        gyro_bias_sigma, accel_bias_sigma: (3,) standard deviations.
    """

    up: np.ndarray
    up_covariance: np.ndarray
    T_gravity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gyro_bias_sigma: np.ndarray
    accel_bias_sigma: np.ndarray

    @property
    def roll(self) -> float:
        """Radians about the line of sight, 0 for a level camera, positive where its right side is down."""
        return float(np.arctan2(-self.up[0], -self.up[1]))

    @property
    def pitch(self) -> float:
        """Radians by which the line of sight is above the horizon."""
        return float(np.arcsin(np.clip(self.up[2], -1.0, 1.0)))

    @property
    def sigmas(self) -> tuple[float, float]:
        """Standard deviations of roll and pitch, radians, half a turn at most: roll is open where one looks down."""
        x, y, _ = self.up
        level = x * x + y * y
        if level <= np.trace(self.up_covariance):
            return np.pi, self.tilt_sigma
        slopes = np.array([[y / level, -x / level, 0.0], [0.0, 0.0, 1.0 / np.sqrt(level)]])
        variances = np.einsum("ij,jk,ik->i", slopes, self.up_covariance, slopes)
        roll, pitch = np.minimum(np.sqrt(variances), np.pi).tolist()
        return roll, pitch

    @property
    def tilt_sigma(self) -> float:
        """Standard deviation of the direction, radians, about the less certain axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.up_covariance)[-1]))


def describe_inertial(
    motion: MotionFilter, R_rectified_left: np.ndarray, T_world_camera: np.ndarray
) -> InertialEstimate | None:
    """The estimate with the current frame; None without a sensor, and before gravity is known.

    Args:
        motion: of the tracker, after the frame.
        R_rectified_left: (3, 3) turns the left camera's axes into the rectified one's.
        T_world_camera: (4, 4) pose of the left camera.
    """
    if not motion.is_inertial:
        return None
    state = motion.state
    values, covariance = state.twist[3:12], state.covariance
    up = -values[:3] / np.linalg.norm(values[:3])
    # By a turn of the camera from the left in the keyframe's frame, and by gravity there.
    by_gravity = (np.outer(up, up) - np.eye(3)) / np.linalg.norm(values[:3])
    turn = (motion.step[:3, :3] @ R_rectified_left).T
    slope = turn @ np.concatenate([skew(up), by_gravity], axis=1)
    rows = np.r_[3:6, 9:12]  # the turn and gravity
    spread, sigmas = slope @ covariance[np.ix_(rows, rows)] @ slope.T, np.sqrt(np.diag(covariance)[12:18])
    up = turn @ up
    T_gravity = level_world(T_world_camera, up)
    return InertialEstimate(up, spread, T_gravity, values[3:6], values[6:], sigmas[:3], sigmas[3:])


def level_world(T_world_camera: np.ndarray, up: np.ndarray) -> np.ndarray:
    """T_gravity (4, 4), which takes points of the world into one with z up and the same origin.

    It is the least rotation that does: for a world that began with a level camera x stays on the right, and y is ahead.

    Args:
        T_world_camera: (4, 4) pose of the left camera.
        up: (3,) in its frame.
    """
    x, y, z = T_world_camera[:3, :3] @ up
    axis = np.array([y, -x, 0.0])
    sine = np.linalg.norm(axis)
    T = np.eye(4)
    T[:3, :3] = rotation_exp(axis / sine * np.arctan2(sine, z) if sine > 1e-9 else np.array([np.arctan2(0.0, z), 0, 0]))
    return T
