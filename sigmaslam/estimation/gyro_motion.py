"""Motion by a gyro alone: it turns as measured, and moves on at constant velocity."""

import numpy as np

from sigmaslam.estimation.odometry_motion import OdometryMotion
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import se3_exp


class GyroMotion(OdometryMotion):
    """Odometry that measures angular velocities alone, whose slow error is the gyro's bias.

    Args:
        T_camera_imu: (4, 4) takes points of the sensor into the camera that is tracked.
    """

    reckoning = "inertial"
    _measures = np.repeat([0.0, 1.0], 3)
    _name, _mend = "inertial sensor", "its turns are not those of the images; are unit (rad/s), axes, T_cam_imu"

    def __init__(self, backend: str, sensor: InertialSensor, T_camera_imu: np.ndarray) -> None:
        super().__init__(backend, OdometrySensor(np.eye(4), sensor.time_shift, is_planar=False), T_camera_imu)
        self.sensors = {"imu": self.samples}

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Of the velocity alone once the gyro predicts."""
        known, covariance = self.twist[3:].copy(), self._covariance.copy()
        super(OdometryMotion, self).set_twist(twist, sigma)
        if self.is_odometric:
            self.twist = np.r_[twist[:3], known]
            self._covariance[9:, 9:] = covariance[9:, 9:]

    def predict(
        self, seconds: float, densities: np.ndarray, sigma: float = 0.0, timestamp: float | None = None
    ) -> None:
        """As wheels do; notes the turn."""
        super().predict(seconds, densities, sigma, timestamp)
        self.turn = se3_exp(seconds * self.twist)[:3, :3] if self.is_odometric else None
