"""Inertial samples between images as relative motions, and what their noise turns out to be."""

import numpy as np

from sigmaslam.estimation.gaussian import regression
from sigmaslam.estimation.preintegration import Preintegrated, preintegrate
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.estimation.standstill import WHILE
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor

# The noise is at least five times that of a data sheet, which holds at rest: in flight it is 3 to 17 times that, and
# small departures show that images are better than they claim. A frame changes what is learned by this share.
_FIRST_SCALE, _ADAPTATION, _MOST_SURPRISE = 25.0, 0.05, 3.0
# So many times the densities' variance is no noise any more but another fault.
_LARGEST_SCALE = 1e4


class InertialBuffer(SampleBuffer):
    """Integrates samples of angular rate and specific force between images.

    Of these, `factors` (2, 3, 3) are taken off, errors of scale and misalignment.
    """

    def __init__(self, sensor: InertialSensor) -> None:
        super().__init__(sensor.time_shift)
        self.sensor, self.factors = sensor, np.zeros((2, 3, 3))

    def preintegrate(self, start: float, end: float, biases: np.ndarray, densities: np.ndarray) -> Preintegrated | None:
        """The motion between two time stamps of the camera; None without samples near them.

        Args:
            start, end: seconds.
            biases: (6,) of gyro and accelerometer.
            densities: (2,) power spectra of unknown accelerations, m^2/s^3 and rad^2/s^3, for gaps.
        """
        table = self.around(start - WHILE, end)  # earlier samples tell how fast they change in gaps
        start, end = start + self.time_shift, end + self.time_shift
        if len(table) < 2 or table[-1, 0] <= start:
            return None
        measured = (table[:, 1:] - biases).reshape(-1, 2, 3).transpose(1, 0, 2)
        gyro, accel = measured - measured @ self.factors.transpose(0, 2, 1)
        samples, zero = InertialSamples(table[:, 0], gyro, accel), np.zeros(3)
        return preintegrate(samples, start, end, zero, zero, self.sensor, densities)


class LearnedNoise:
    """By how much gyro and accelerometer are noisier than their densities say, followed by what poses show.

    Attributes:
        scale: (2,) of the variances; at least one.
    """

    def __init__(self) -> None:
        self.scale = np.array([_FIRST_SCALE, _FIRST_SCALE])

    def of(self, motion: Preintegrated) -> np.ndarray:
        """(9, 9) covariance of a preintegrated motion."""
        gyro, accel = np.maximum(self.scale, _FIRST_SCALE)
        return np.asarray(gyro * motion.gyro_noise + accel * motion.accel_noise)

    def learn(self, departure: np.ndarray, removed: np.ndarray) -> None:
        """Takes how far a pose lies from its prediction.

        Args:
            departure: (6,) translation and rotation.
            removed: (6, 6) by how much the pose's covariance shrank, which is that of the departure.
        """
        for k, part in enumerate((slice(3, 6), slice(0, 3))):
            squared = float((regression(departure[None, part], removed[part, part]) @ departure[part]).item())
            surprise = min(max(squared / 3.0, 0.0), _MOST_SURPRISE)
            self.scale[k] = np.clip(self.scale[k] * np.exp(_ADAPTATION * (surprise - 1.0)), 1.0, _LARGEST_SCALE)
