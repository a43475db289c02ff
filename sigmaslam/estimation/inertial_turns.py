"""Turns of the images against those of a gyro: unit, handedness, rotation, bias and delay by least squares.

The gyro's samples become one attitude, which is interpolated at any time, so that the delay is found to a part of a
sample. For each delay the rotation is Wahba's problem (F. L. Markley: Attitude Determination Using Vector Observations
and the Singular Value Decomposition, J. Astronautical Sciences 36(3), 1988), not bound to right hands; the delay with
the least residual is refined by Gauss and Newton together with the others.
"""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import rotation_exp, rotation_log, skew

SHARED_ERRORS = 4.0
"""Errors of a tracker's poses are no white noise: neighbours share landmarks, about so many times fewer count."""
# Delays that are searched, seconds, and the step of the search: the turns of a frame of 50 ms are smooth over it.
_LONGEST_DELAY, _STEP = 0.5, 5e-3
# Gauss and Newton's steps from there: two come within 0.1 us at 20 Hz; long intervals begin further off.
_ROUNDS = 6
# So many intervals determine seven unknowns; more than so many say no more, and take long.
_FEWEST, _MOST = 12, 400
# Rates that are so many times as large are in another unit.
_UNIT = 3.0
# By so many variances a mirrored gyro must fit better than a right one.
_MIRRORED = 25.0


@dataclass(frozen=True, slots=True)
class TurnFit:
    """How the turns of a gyro follow from those of a camera: turn_imu = scale Q turn_camera + bias seconds.

    Attributes:
        scale: size of the gyro's turns over that of the camera's; 1 for rad/s.
        rotation: (3, 3) Q, the camera in the sensor's frame; its determinant is -1 where the sensor is left-handed.
        bias: (3,) of the gyro, in its unit.
        delay: seconds by which the sensor's stamps are later than the expected ones.
        delay_sigma: its standard deviation.
        rotation_covariance: (3, 3) of the rotation, from the left, radians.
        explained: share of the gyro's squared turns, beside the bias, that those of the camera explain.
    """

    scale: float
    rotation: np.ndarray
    bias: np.ndarray
    delay: float
    delay_sigma: float
    rotation_covariance: np.ndarray
    explained: float


class GyroAttitude:
    """Rotation since the first sample, at any time."""

    def __init__(self, samples: InertialSamples) -> None:
        self._t, self._gyro = samples.timestamp, samples.gyro
        mean = 0.5 * (self._gyro[1:] + self._gyro[:-1])
        self._attitude = rotation_products(rotation_exp(mean * np.diff(self._t)[:, None]))

    def at(self, times: np.ndarray) -> np.ndarray:
        """(N, 3, 3) at times (N,) of the sensor's clock; those outside of the table count as its ends."""
        t = np.clip(times, self._t[0], self._t[-1])
        k = np.clip(np.searchsorted(self._t, t, "right") - 1, 0, len(self._t) - 2)
        part = t - self._t[k]
        share = (part / (self._t[k + 1] - self._t[k]))[:, None]
        mean = self._gyro[k] + 0.5 * share * (self._gyro[k + 1] - self._gyro[k])
        return np.asarray(self._attitude[k] @ rotation_exp(mean * part[:, None]))

    def turns(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """(N, 3) rotation vectors between times."""
        return rotation_log(self.at(starts).transpose(0, 2, 1) @ self.at(ends))


def fit_turns(
    starts: np.ndarray, ends: np.ndarray, turns: np.ndarray, samples: InertialSamples, shift: float
) -> TurnFit | None:
    """Fits a gyro to the turns of a camera; None where fewer than a dozen of them lie inside the table's time.

    Args:
        starts, ends: (N,) time stamps of two images, seconds.
        turns: (N, 3) rotation vectors R_start_end of the camera from one to the other.
        samples: of the gyro, in any unit of rate.
        shift: clock of the sensor minus that of the camera as far as it is known; the delay comes on top.
    """
    inside = (starts + shift >= samples.timestamp[0]) & (ends + shift <= samples.timestamp[-1])
    size = np.where(inside, np.linalg.norm(turns, axis=1), -1.0)
    chosen = np.argsort(-size)[: min(_MOST, int(inside.sum()))]
    if len(chosen) < _FEWEST:
        return None
    starts, ends, seen = starts[chosen] + shift, ends[chosen] + shift, turns[chosen]
    seconds = ends - starts
    summed = np.cumsum(0.5 * np.diff(samples.timestamp)[:, None] * (samples.gyro[1:] + samples.gyro[:-1]), axis=0)

    def added(delay: float) -> np.ndarray:
        """Turns to the first order: quick, and of any unit, while rotations would pass half a turn."""
        at = np.r_[starts, ends] + delay
        start, end = np.split(np.column_stack([np.interp(at, samples.timestamp[1:], each) for each in summed.T]), 2)
        return np.asarray(end - start)

    delays = np.arange(-_LONGEST_DELAY, _LONGEST_DELAY + _STEP, _STEP).tolist()
    delay = min(delays, key=lambda each: _match(seen, added(each), seconds)[3])
    unit = _match(seen, added(delay), seconds)[0]
    unit = 1.0 if 1.0 / _UNIT < unit < _UNIT else unit
    attitude = GyroAttitude(replace(samples, gyro=samples.gyro / unit))

    def measured(delay: float) -> np.ndarray:
        return attitude.turns(starts + delay, ends + delay)

    for _ in range(_ROUNDS):
        gyro = measured(delay)
        scale, rotation, bias, _ = _match(seen, gyro, seconds)
        turned = scale * seen @ rotation.T
        slope = (measured(delay + 0.5 * _STEP) - measured(delay - 0.5 * _STEP)) / _STEP
        residual = gyro - turned - bias * seconds[:, None]
        by_bias = seconds[:, None, None] * np.eye(3)
        columns = np.concatenate([-skew(turned), by_bias, -slope[..., None]], axis=2).reshape(-1, 7)
        length = np.linalg.norm(columns, axis=0) + 1e-30
        delay += float(np.linalg.lstsq(columns / length, residual.ravel(), rcond=None)[0][6] / length[6])
    variance = max(float(np.sum(residual**2)) / (residual.size - 7), 1e-20)
    information = columns.T @ columns / variance
    sigma = np.sqrt(SHARED_ERRORS * np.linalg.pinv(information, hermitian=True)[6, 6])
    of_rotation = information[:3, :3] - information[:3, 3:] @ np.linalg.pinv(information[3:, 3:]) @ information[3:, :3]
    # Turns that are noise, as about the other axes of a car, do not show how a sensor is turned about its axis.
    values, vectors = np.linalg.eigh(of_rotation)
    values = np.maximum(values - 2.0 * len(seen), 0.0) / SHARED_ERRORS + np.pi**-2
    whole = np.sum((gyro - bias * seconds[:, None]) ** 2)
    explained = 1.0 - float(np.sum(residual**2) / max(whole, 1e-30))
    return TurnFit(unit * scale, rotation, unit * bias, delay, float(sigma), vectors / values @ vectors.T, explained)


def _match(seen: np.ndarray, gyro: np.ndarray, seconds: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, float]:
    """Scale, rotation and bias between turns (N, 3), and the share of squares that they leave."""
    weight = seconds / (seconds @ seconds)
    a, b = (each - seconds[:, None] * (weight @ each) for each in (seen, gyro))
    U, s, Vt = np.linalg.svd(b.T @ a)
    squared_a, squared_b = float(np.sum(a**2)) + 1e-30, float(np.sum(b**2)) + 1e-30
    scale = float(np.sqrt(squared_b / squared_a))
    left = 2.0 * (squared_b - scale * s.sum())
    if np.linalg.det(U @ Vt) < 0.0 and 4.0 * scale * s[2] < _MIRRORED * left / b.size:
        U[:, 2] *= -1.0
    rotation = U @ Vt
    return scale, rotation, weight @ (gyro - scale * seen @ rotation.T), left / squared_b


def rotation_products(steps: np.ndarray) -> np.ndarray:
    """Products (N + 1, 3, 3) of the first 0, 1, ... N rotations, by doubling."""
    R, reach = np.concatenate([np.eye(3)[None], steps]), 1
    while reach < len(R):
        R = np.concatenate([R[:reach], R[:-reach] @ R[reach:]])
        reach *= 2
    return R
