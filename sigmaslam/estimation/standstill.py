"""Whether a body is at rest, by images and inertial sensor, which must agree; and whether it was hit."""

from collections import deque

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_95, CHI_SQUARE_999
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.se3 import se3_inverse, se3_log

# Seconds for which nothing may move, and the least number of samples in them that a variance can be told from.
WHILE, _LEAST_SAMPLES = 0.5, 10
# The variance of samples at rest is at most so many times the expected one: twice the standard deviation. That is
# between so many times the data sheet's: engines idle, at tones that no noise has, and what shakes more may fly.
_QUIET, _LEAST, _LARGEST = 4.0, 9.0, 25.0
# A jump of the force is a blow where it is so many times the usual one, and so large, m/s^2. In 105 s of a flight
# (EuRoC V1 01) the largest one of 50 ms is at most 5.6 times the usual one.
_UNUSUAL, _LEAST_BLOW = 8.0, 5.0


class Standstill:
    """Images say that nothing moves where poses half a second apart differ by no more than their noise.

    Elevators and trains are at rest for an inertial sensor, and drones with running motors for images: both must agree.
    In the dark the sensor must be as quiet as it was when both agreed, or as its data sheet says, and the velocity may
    be zero; where images have last shown a motion that the sensor does not feel, darkness is no rest.

    Attributes:
        speed_variance: (3, 3) of the velocity that images cannot tell from zero, in the camera's frame, (m/s)^2.
        spectra: (6,) of gyro and accelerometer at rest, as of white noise.
    """

    def __init__(self, sensor: InertialSensor) -> None:
        self._sheet = np.repeat(sensor.spectra, 3)
        self.spectra = self._sheet
        self._poses: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self.speed_variance = np.eye(3)
        self._is_seen, self._glides = False, False

    def see(
        self, timestamp: float, pose: np.ndarray, covariance: np.ndarray, samples: np.ndarray, noise: np.ndarray
    ) -> None:
        """Takes a pose by images.

        Args:
            timestamp: seconds.
            pose: (4, 4) of the camera in any frame that stays.
            covariance: (6, 6) of it in its own frame.
            samples: (N, 7) of the sensor in the last half second.
            noise: (2,) spectra of gyro and accelerometer in that time, as of white noise.
        """
        self._poses.append((timestamp, pose, covariance))
        while len(self._poses) > 1 and self._poses[1][0] <= timestamp - WHILE:
            self._poses.popleft()
        since, before, spread = self._poses[0]
        self._is_seen = False
        if timestamp - since < WHILE:
            return
        departure, spread = se3_log(se3_inverse(before) @ pose), spread + covariance
        self.speed_variance = spread[:3, :3] / (timestamp - since) ** 2
        stays, spectrum = squared_mahalanobis(departure, spread) < CHI_SQUARE_95[6], _spectrum(samples)
        expected = np.clip(np.repeat(noise, 3), _LEAST * self._sheet, _LARGEST * self._sheet)
        quiet = bool((spectrum < _QUIET * expected).all())
        self._is_seen, self._glides = bool(stays) and quiet, quiet and not stays
        if self._is_seen:
            self.spectra = np.maximum(spectrum, self._sheet)

    def holds(self, samples: np.ndarray, velocity: np.ndarray, covariance: np.ndarray, is_dark: bool) -> bool:
        """Whether the body is at rest.

        Args:
            samples: (N, 7) of the sensor in the last half second.
            velocity, covariance: (3,) and (3, 3) as predicted.
            is_dark: the last frame had no pose by images.
        """
        if self._glides or not (is_dark or self._is_seen) or (_spectrum(samples) > _QUIET * self.spectra).any():
            return False
        return bool(squared_mahalanobis(velocity, covariance + self.speed_variance) < CHI_SQUARE_999[3])


def find_blow(samples: np.ndarray, since: float) -> tuple[float, float] | None:
    """Time of a blow, and the jump of the force from sample to sample, m/s^2; None where there was none, or none shows.

    Args:
        samples: (N, 7) of the last while.
        since: time of the sensor up to which jumps are usual.
    """
    jumps = np.linalg.norm(np.diff(samples[:, 4:], axis=0), axis=1)
    known = int(np.searchsorted(samples[1:, 0], since, "right"))
    if not _LEAST_SAMPLES <= known < len(jumps):
        return None
    hit = known + int(np.argmax(jumps[known:]))
    bound = max(_UNUSUAL * float(np.sqrt(np.mean(jumps[:known] ** 2))), _LEAST_BLOW)
    return (float(samples[hit + 1, 0]), float(jumps[hit])) if jumps[hit] > bound else None


def _spectrum(samples: np.ndarray) -> np.ndarray:
    """(6,) of samples (N, 7) as of white noise; infinite where they are too few."""
    if len(samples) < _LEAST_SAMPLES:
        return np.full(6, np.inf)
    t = samples[:, 0]
    return np.asarray(samples[:, 1:].var(axis=0) * (t[-1] - t[0]) / (len(t) - 1))
