"""Motion by wheels: the velocity changes as they measure, and images say what is wrong with it."""

import logging
from collections import deque

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.preintegration import bridge_spectrum, interpolate
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse, se3_log

_LOGGER = logging.getLogger(__name__)

# Order of the error state, see `MotionFilter`.
_POSE, _TWIST = slice(0, 6), slice(6, 12)
# Frames with a pose over which velocities of wheels and images are compared before wheels predict.
COMPARED = 10
# Wheels whose velocities depart by more than this share, or by more than this share of what constant velocity allows
# in a second, are not of one body with the camera, or of another unit.
DEPARTURE = 0.25
# Wheels are at first as noisy as this share of what constant velocity allows in a second; images have no less.
_LEAST_SHARE = 0.01
# Seconds over which the slowly changing part of an error, as of slip and worn tyres, grows as large as the white one:
# at first, and at least and most, as it is learned by how successive errors resemble each other.
SLOW, _SHORTEST, _LONGEST = 1.0, 0.3, 30.0
# A frame changes the noise that is learned by this share, and none counts for more than so many variances.
_ADAPTATION, _MOST_SURPRISE = 0.05, 3.0
# Seconds without samples after which the odometry is taken for dead.
_DEAD = 1.0


class OdometryMotion(MotionFilter):
    """Predicts by wheels; by constant velocity until they are known to agree with images.

    The state is that of constant velocity, whose twist follows the measured one: what images correct of the twist is
    the slow error of the wheels, and stays. The noise is white besides, along each of the six axes of the vehicle, and
    learned from how far poses lie from predictions. What no column measures is zero: wheels neither slide nor jump.

    Args:
        T_camera_base: (4, 4) takes points of the vehicle's frame into the camera that is tracked.
    """

    reckoning = "odometry"
    _measures = np.ones(6)  # which axes are; the others move on at constant velocity
    _name, _mend = (
        "odometry",
        ("its velocities are not those of the images; are units (m/s, rad/s), axes (forward, left, up), T_cam_base"),
    )

    def __init__(self, backend: str, sensor: OdometrySensor, T_camera_base: np.ndarray) -> None:
        super().__init__(backend)
        self.samples = SampleBuffer(sensor.time_shift)
        self.sensors = {"odometry": self.samples}
        self.spectrum, self.slow = np.zeros(6), np.zeros(6)
        """Of the velocities of the vehicle: white noise, m^2/s and rad^2/s, and random walks, m^2/s^3 and rad^2/s^3."""
        self._last = np.zeros(6)  # departure of the last frame
        self._unsampled = np.zeros(6)  # spectrum of what samples up to this one are too few for
        self._adjoint = se3_adjoint(T_camera_base)
        # What of the slow error of the twist stays from frame to frame: roll and pitch return by themselves.
        stays = np.array([1.0, 1.0, 1.0, *([0.0, 0.0] if sensor.is_planar else [1.0, 1.0]), 1.0])
        self._stays = self._adjoint @ np.diag(stays) @ np.linalg.inv(self._adjoint)
        self._measured: np.ndarray | None = None  # twist of the vehicle up to the last frame
        self._departures: deque[np.ndarray] = deque(maxlen=COMPARED)
        self._compared: deque[np.ndarray] = deque(maxlen=COMPARED)
        self._seconds, self._densities, self._is_refused, self._is_held = 0.0, np.zeros(2), False, False

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Of constant velocity alone: wheels measure on where images are lost."""
        if not self.is_odometric:
            super().set_twist(twist, sigma)
            self._departures.clear()
            self._compared.clear()

    def predict(
        self, seconds: float, densities: np.ndarray, sigma: float = 0.0, timestamp: float | None = None
    ) -> None:
        """Moves on to the frame of that time stamp, by the samples of the seconds before it."""
        self._seconds, self._densities = seconds, np.repeat(densities, 3)
        before, self._measured = self._measured, None
        if timestamp is not None:
            self.samples.forget(timestamp - seconds + self.samples.time_shift)
            self._measured, self._unsampled = self._mean_twist(timestamp - seconds, timestamp)
        if self._measured is None and self.is_odometric:
            _LOGGER.warning("the %s gives no samples: constant velocity goes on", self._name)
            self.is_odometric = False
        if self._measured is None or before is None or not self.is_odometric:
            super().predict(seconds, densities, sigma)
            return
        self.twist = self._adjoint @ self._measured + self._stays @ (self.twist - self._adjoint @ before)
        kept = np.eye(12)
        kept[_TWIST, _TWIST] = self._stays
        self._covariance = kept @ self._covariance @ kept.T
        super().predict(seconds, densities * (1.0 - self._measures[[0, 3]]))
        noise = (self._adjoint * (seconds * (self.spectrum + self._unsampled))) @ self._adjoint.T
        adjoint = se3_adjoint(self.step)
        self._covariance[_POSE, _POSE] += adjoint @ noise @ adjoint.T
        self._covariance[_TWIST, _TWIST] += (self._adjoint * (seconds * self.slow)) @ self._adjoint.T
        if sigma > 0.0:
            self.doubt_time(sigma)

    def correct(self, step: np.ndarray, covariance: np.ndarray) -> None:
        """Takes over the posterior of the pose, which knew the prediction; compares wheels with it."""
        seen = None
        if self.is_odometric:  # wheels that predict draw the twist along, not the step
            seen = np.linalg.solve(self._adjoint, self.twist) + self._learn(step, covariance) / self._seconds
        super().correct(step, covariance)
        if self._measured is not None and not self._is_held:
            seen = np.linalg.solve(self._adjoint, self.twist) if seen is None else seen
            self._departures.append(seen - self._measured)
            self._compared.append(self._measured)
            if len(self._compared) == COMPARED:  # in what began at rest, too: there any unit fits
                agrees = self._agrees()
                if agrees != self.is_odometric:
                    (self._begin if agrees else self._leave)()
                elif not agrees and not self._is_refused:
                    _LOGGER.warning("the %s is not used: %s and clock right?", self._name, self._mend)
                    self._is_refused = True

    # ---- parts

    def _mean_twist(self, start: float, end: float) -> tuple[np.ndarray | None, np.ndarray]:
        """Twist (6,) of the vehicle that leads from one of its poses to another; None without samples.

        And spectra (6,) of what it may have done between samples, and beyond them, where its velocity is held.
        """
        table = self.samples.around(start, end)
        if not len(table):
            return None, np.zeros(6)
        start, end = start + self.samples.time_shift, end + self.samples.time_shift
        t = table[:, 0]
        gap, held = np.diff(t).max(initial=0.0), max(t[0] - start, end - t[-1], 0.0)
        self._is_held = bool(held > gap)
        if gap > _DEAD or held > _DEAD:
            return None, np.zeros(6)
        values = np.hstack([table[:, 4:], table[:, 1:4]]) * self._measures
        unsampled = self._measures * (self._densities * held**2 / 3.0 + bridge_spectrum(t, values, gap))
        edges = np.r_[start, t[(t > start) & (t < end)], end]
        twists = interpolate(edges, t, values)
        T = np.eye(4)
        for part in se3_exp(np.diff(edges)[:, None] * 0.5 * (twists[1:] + twists[:-1])):
            T = T @ part
        return se3_log(T) / (end - start), unsampled

    def _agrees(self) -> bool:
        """Whether the last velocities of the wheels are those of the images, in the mean where they predict."""
        departures, measured = np.array(self._departures), np.array(self._compared)
        if self.is_odometric:  # single frames are noisy
            departures = departures.mean(axis=0, keepdims=True)
        for part in (slice(0, 3), slice(3, 6)):
            squared, allowed = (
                np.sum(each[:, part] ** 2, axis=1).mean() for each in (departures, DEPARTURE * measured)
            )
            least = DEPARTURE**2 * self._densities[part].sum()
            if self._measures[part].any() and squared > max(allowed, least):
                return False
        return True

    def _begin(self) -> None:
        """Wheels predict from now on."""
        departures, least = np.array(self._departures), _LEAST_SHARE**2 * self._densities
        self.spectrum = self._measures * (departures.var(axis=0) * self._seconds + least)
        self.slow, self._last, self.is_odometric = self.spectrum / SLOW**2, np.zeros(6), True
        offset = self.spectrum / (COMPARED * self._seconds)
        free = np.diag(np.r_[np.zeros(6), 1.0 - self._measures])
        unmeasured = free @ self._covariance @ free
        self._covariance[_TWIST, :] = self._covariance[:, _TWIST] = 0.0
        self._covariance[_TWIST, _TWIST] = (self._adjoint * offset) @ self._adjoint.T
        self._covariance += unmeasured
        self._departures.clear()
        self._compared.clear()
        _LOGGER.info("%s predicts: to %.3f m/s and %.4f rad/s", self._name, *np.sqrt(self.spectrum[[0, 5]]))

    def _learn(self, step: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Noise of each axis, by how far (6,), which is returned, a pose lies from its prediction."""
        back = np.linalg.inv(se3_adjoint(self.step) @ self._adjoint)
        departure = back @ se3_log(step @ se3_inverse(self.step))
        # By so much the pose's covariance shrank, which is that of the departure, before this one made it wider.
        variance = np.diag(back @ (self.step_covariance - covariance) @ back.T) / self.widened
        seen = (variance > 0.0) & (self._unsampled < self.spectrum) & (self._measures > 0.0)
        normalised = np.where(seen, departure / np.sqrt(np.where(seen, variance, 1.0)), 0.0)
        normalised = np.clip(normalised, -_MOST_SURPRISE, _MOST_SURPRISE)
        self.spectrum = self.spectrum * np.exp(_ADAPTATION * np.where(seen, normalised**2 - 1.0, 0.0))
        self.slow = self.slow * np.exp(_ADAPTATION * normalised * self._last)
        self.slow = np.clip(self.slow, self.spectrum / _LONGEST**2, self.spectrum / _SHORTEST**2)
        self._last = normalised
        if (self.spectrum > self._densities).any():
            self._leave()
        return np.asarray(departure)

    def _leave(self) -> None:
        _LOGGER.warning("the %s departs from the images: constant velocity goes on", self._name)
        self.is_odometric = False
        self._departures.clear()
        self._compared.clear()
