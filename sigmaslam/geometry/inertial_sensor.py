"""An inertial sensor beside the cameras: where it sits, how noisy it is, and what it measured."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.table import Table

STANDARD_GRAVITY = 9.80665
"""m/s^2, CIPM 1901; on Earth's surface it is 9.78 to 9.83."""


@dataclass(frozen=True, slots=True)
class InertialSensor:
    """Mounting and noise of an inertial sensor.

    Attributes:
        T_left_imu: (4, 4) takes points of the sensor into the left camera.
        gyro_density, accel_density: standard deviation of white noise, rad/s and m/s^2 per root hertz.
        gyro_walk, accel_walk: of the biases' random walks, rad/s^2 and m/s^3 per root hertz.
        time_shift: clock of the sensor minus that of the camera, seconds (Kalibr's `timeshift_cam_imu`).
        has_accelerometer: False: a gyro alone, of whose samples and densities forces are left out.
    """

    T_left_imu: np.ndarray
    gyro_density: float
    accel_density: float
    gyro_walk: float
    accel_walk: float
    time_shift: float = 0.0
    has_accelerometer: bool = True

    @property
    def spectra(self) -> np.ndarray:
        """(2,) power spectra of the white noise of gyro and accelerometer, rad^2/s and m^2/s^3."""
        return np.square([self.gyro_density, self.accel_density], dtype=float)


@dataclass(frozen=True, slots=True)
class InertialSamples(Table):
    """What the sensor measured, in the order of time.

    Attributes:
        timestamp: (N,) seconds, of the sensor's clock.
        gyro: (N, 3) angular rate, rad/s.
        accel: (N, 3) specific force, m/s^2: at rest 9.81 away from the ground.
    """

    timestamp: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
