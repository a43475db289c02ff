"""The last samples of an inertial sensor, and what their noise turns out to be."""

from __future__ import annotations

import logging
from collections import deque

import numpy as np

from sigmaslam.estimation.gaussian import regression
from sigmaslam.estimation.preintegration import Preintegrated, preintegrate
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor

_LOGGER = logging.getLogger(__name__)

# Seconds of samples that are kept: twice what gravity is looked for in.
_KEPT = 20.0
# The noise that is learned begins at five times the densities of a data sheet, which hold at rest: in flight others
# take 3 to 17 times as much. A frame changes it by this share, and none counts for more than so many variances.
_FIRST_SCALE, _ADAPTATION, _MOST_SURPRISE = 25.0, 0.05, 9.0
# So many times the densities' variance is no noise any more but another fault.
_LARGEST_SCALE = 1e4


class InertialBuffer:
    """Takes samples as they come and integrates them between images.

    Args:
        sensor: its noise and clock.
    """

    def __init__(self, sensor: InertialSensor) -> None:
        self.sensor = sensor
        self.late = 0
        """Samples that were left out, as they were not later than the one before."""
        self._samples: deque[np.ndarray] = deque()
        self._table: np.ndarray | None = None  # of the samples, while they stay as they are

    def add(self, timestamp: float, gyro: np.ndarray, accel: np.ndarray) -> None:
        """Takes a sample, rad/s and m/s^2."""
        if self._samples and timestamp <= self._samples[-1][0]:
            if not self.late:
                _LOGGER.warning("an inertial sample at %.6f s is not later than the last one: left out", timestamp)
            self.late += 1
            return
        self._samples.append(np.r_[timestamp, gyro, accel])
        self._table = None
        self.forget(timestamp - _KEPT)

    def forget(self, before: float) -> None:
        """Samples before that time of the sensor's clock, but for the last of them, are needed no longer."""
        while len(self._samples) > 2 and self._samples[1][0] < before:
            self._samples.popleft()
            self._table = None

    def preintegrate(self, start: float, end: float, biases: np.ndarray, densities: np.ndarray) -> Preintegrated | None:
        """The motion between two time stamps of the camera; None without samples near them.

        Args:
            start, end: seconds.
            biases: (6,) of gyro and accelerometer.
            densities: (2,) power spectra of unknown accelerations, m^2/s^3 and rad^2/s^3, for gaps.
        """
        if self._table is None:
            self._table = np.array(self._samples).reshape(-1, 7)
        table = self._table
        start, end = start + self.sensor.time_shift, end + self.sensor.time_shift
        first = max(int(np.searchsorted(table[:, 0], start, "right")) - 1, 0)
        table = table[first : int(np.searchsorted(table[:, 0], end)) + 1]
        if len(table) < 2:
            return None
        samples = InertialSamples(table[:, 0], table[:, 1:4], table[:, 4:])
        return preintegrate(samples, start, end, biases[:3], biases[3:], self.sensor, densities)


class LearnedNoise:
    """By how much gyro and accelerometer are noisier than their densities say, followed by what poses show.

    Attributes:
        scale: (2,) of the variances; at least one.
    """

    def __init__(self) -> None:
        self.scale = np.array([_FIRST_SCALE, _FIRST_SCALE])

    def of(self, motion: Preintegrated) -> np.ndarray:
        """(9, 9) covariance of a preintegrated motion."""
        return np.asarray(self.scale[0] * motion.gyro_noise + self.scale[1] * motion.accel_noise)

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
