"""Inertial samples between images as relative motions, and what their noise turns out to be."""

from math import comb

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sigmaslam.estimation.gaussian import regression
from sigmaslam.estimation.preintegration import Preintegrated, preintegrate
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.estimation.standstill import WHILE
from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor

# A frame changes what is learned by this share, however surprising its pose. Small departures show no small noise:
# images are better than they claim.
_ADAPTATION, _MOST_SURPRISE = 0.05, 3.0
# So many times the variance that samples show is no noise any more but another fault.
_LARGEST_SCALE = 1e4
# Order of the differences that tell noise, of means of so many samples, and how many they are at least; with fewer data
# sheets are taken to be off by five times.
_ORDER, _MEANS_OF, _LEAST_BENDS, _UNKNOWN = 6, (1, 2, 3), 6, 25.0


class InertialBuffer(SampleBuffer):
    """Integrates samples of angular rate and specific force between images.

    Of these, `factors` (2, 3, 3) are taken off, errors of scale and misalignment. `spectra` (2,) are those of the last
    while's noise.
    """

    def __init__(self, sensor: InertialSensor) -> None:
        super().__init__(sensor.time_shift)
        self.sensor, self.factors = sensor, np.zeros((2, 3, 3))
        self.spectra = sensor.spectra

    def preintegrate(self, start: float, end: float, biases: np.ndarray, densities: np.ndarray) -> Preintegrated | None:
        """The motion between two time stamps of the camera; None without samples near them.

        Args:
            start, end: seconds.
            biases: (6,) of gyro and accelerometer.
            densities: (2,) power spectra of unknown accelerations, m^2/s^3 and rad^2/s^3, for gaps.
        """
        # Earlier samples tell how noisy they are, and how fast they change in gaps.
        table = self.around(start - WHILE, end)
        start, end = start + self.time_shift, end + self.time_shift
        if len(table) < 2 or table[-1, 0] <= start:
            return None
        self.spectra = noise_spectra(table, self.sensor.spectra)
        measured = (table[:, 1:] - biases).reshape(-1, 2, 3).transpose(1, 0, 2)
        gyro, accel = measured - measured @ self.factors.transpose(0, 2, 1)
        samples, zero = InertialSamples(table[:, 0], gyro, accel), np.zeros(3)
        return preintegrate(samples, start, end, zero, zero, self.spectra, densities)


def noise_spectra(samples: np.ndarray, sheet: np.ndarray) -> np.ndarray:
    """(2,) power spectra of gyro and accelerometer as of white noise: a data `sheet`'s, which hold at rest, or more.

    The least that sixth differences of samples (N, 7), and of means of two and three, show. White noise is the same in
    all; motions are hardly in the finest, tones of rotors not in all, and neither is noise that a motion has.
    Errors of these in flight (EuRoC V1 01) are 7 and 10 to 17 times those by the data sheet, the root of this 4 and 14
    times it; unpowered (MH01) 1.0.
    """
    least = np.full(2, np.inf)
    for count in _MEANS_OF:
        means = samples[: len(samples) // count * count].reshape(-1, count, 7).mean(axis=1)
        if (least <= sheet).all() or len(means) < _ORDER + _LEAST_BENDS:
            break
        steps = np.diff(means[:, 0])
        even = sliding_window_view(steps, _ORDER).max(axis=1) < 1.5 * np.median(steps)
        bends = np.diff(means[:, 1:], _ORDER, axis=0)[even]
        if len(bends) >= _LEAST_BENDS:
            variances = np.mean(bends.reshape(-1, 2, 3) ** 2, axis=(0, 2)) / comb(2 * _ORDER, _ORDER)
            least = np.minimum(least, np.median(steps) * variances)
    return np.where(np.isfinite(least), np.maximum(least, sheet), _UNKNOWN * sheet)


class LearnedNoise:
    """By how much gyro and accelerometer are noisier than their samples say, followed by what poses show.

    Attributes:
        scale: (2,) of the variances; at least one.
    """

    def __init__(self) -> None:
        self.scale = np.ones(2)

    def of(self, motion: Preintegrated) -> np.ndarray:
        """(9, 9) covariance of a preintegrated motion."""
        gyro, accel = self.scale
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
