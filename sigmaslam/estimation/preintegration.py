"""Inertial samples between two images as one relative motion that needs neither pose, velocity nor gravity.

C. Forster, L. Carlone, F. Dellaert, D. Scaramuzza: On-Manifold Preintegration for Real-Time Visual-Inertial Odometry,
IEEE Transactions on Robotics 33(1), 2017, eqs. (26) - (48); integrated by the midpoint rule.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.inertial_turns import rotation_products
from sigmaslam.geometry.inertial_sensor import InertialSamples
from sigmaslam.geometry.se3 import rotation_exp, skew

# Order of the errors of a preintegrated motion.
TURN, VELOCITY, POSITION = slice(0, 3), slice(3, 6), slice(6, 9)
# What it depends on.
GYRO_BIAS, ACCEL_BIAS, SENSOR = slice(0, 3), slice(3, 6), slice(6, 25)
# Mean periods between two samples above which some are missing: jitter is less.
_GAP = 2.5
# Seconds of a gap across which values at both ends say what was between: bodies turn round in no less.
_BRIDGED = 0.3


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Relative motion of the sensor in its frame at the start, without gravity and without the velocity there.

    Attributes:
        seconds: duration.
        turn: (3, 3) rotation R_start_end.
        velocity, position: (3,) changes, m/s and m.
        slope: (9, 25) derivatives of (turn from the right, velocity, position) by gyro bias, accelerometer bias, the
            delay of the clock (rad/s, m/s^2, s), and errors of scale and misalignment of both (3, 3), row by row.
        gyro_noise, accel_noise: (9, 9) covariances by the white noise of each.
        missing: seconds of it without samples.
    """

    seconds: float
    turn: np.ndarray
    velocity: np.ndarray
    position: np.ndarray
    slope: np.ndarray
    gyro_noise: np.ndarray
    accel_noise: np.ndarray
    missing: float = 0.0

    def corrected(self, change: np.ndarray) -> Self:
        """With the first that the slope is by changed by (n,), to the first order."""
        step = self.slope[:, : len(change)] @ change
        return replace(
            self,
            turn=self.turn @ rotation_exp(step[TURN]),
            velocity=self.velocity + step[VELOCITY],
            position=self.position + step[POSITION],
        )


def preintegrate(
    samples: InertialSamples,
    start: float,
    end: float,
    gyro_bias: np.ndarray,
    accel_bias: np.ndarray,
    noise: np.ndarray,
    densities: np.ndarray,
) -> Preintegrated:
    """Integrates samples from `start` to `end`, seconds of the sensor's clock.

    Across gaps, and beyond the first and last sample, values are interpolated or held. In short gaps they depart from
    that by as much as they change elsewhere in such a time; else the noise is that of a motion which nobody measured.

    Args:
        samples: at least one; those around the interval, too.
        gyro_bias, accel_bias: (3,) taken off.
        noise: (2,) power spectra of gyro and accelerometer, rad^2/s and m^2/s^3, as of white noise.
        densities: (2,) power spectra of unknown accelerations, m^2/s^3 and rad^2/s^3, for gaps.
    """
    t = samples.timestamp
    inside = t[(t > start) & (t < end)]
    # Of one step alone, as in gaps, noise would be in six directions of nine.
    edges = np.r_[start, inside if len(inside) else 0.5 * (start + end), end]
    gyro, accel = (interpolate(edges, t, each) for each in (samples.gyro - gyro_bias, samples.accel - accel_bias))
    steps, middles = np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    # Length of the gap between samples that each step lies in.
    after = np.searchsorted(t, middles)
    before_first, behind_last = after == 0, after == len(t)
    gaps = t[np.clip(after, 1, len(t) - 1)] - t[np.clip(after - 1, 0, max(len(t) - 2, 0))]
    period = float(np.median(np.diff(t))) if len(t) > 1 else float(end - start)
    gaps = np.where(before_first, t[0] - start, np.where(behind_last, end - t[-1], gaps))
    is_gap = gaps > _GAP * period
    is_bridged = is_gap & (gaps <= _BRIDGED) & ~before_first & ~behind_last
    is_missing = is_gap & ~is_bridged
    spectra = np.tile(noise, (len(steps), 1))
    for k in np.flatnonzero(is_bridged):
        spectra[k] += [bridge_spectrum(t, values, gaps[k]).mean() for values in (samples.gyro, samples.accel)]
    # A rate that goes from end to end with an unknown angular acceleration, as a Brownian bridge.
    unknown = np.column_stack([densities[1] * gaps**2 / 12.0, np.full(len(steps), densities[0])])
    spectra[is_missing] += unknown[is_missing]
    rates, forces = (0.5 * (values[1:] + values[:-1]) for values in (gyro, accel))
    halves = rotation_exp(0.5 * steps[:, None] * rates)
    rotations = rotation_products(halves @ halves)
    turn, turned, h = rotations[-1], rotations[:-1] @ halves, steps[:, None]
    moved = (turned @ forces[..., None])[..., 0]
    speeds = np.vstack([np.zeros(3), np.cumsum(h * moved, axis=0)])
    places = np.vstack([np.zeros(3), np.cumsum(h * speeds[:-1] + 0.5 * h * h * moved, axis=0)])
    velocity, position, left = speeds[-1], places[-1], (end - edges[1:])[:, None]
    # What an error of each step's rate and force makes of the end.
    h, after, errors = h[..., None], rotations[1:], np.zeros((len(steps), 9, 6))
    errors[:, TURN, GYRO_BIAS] = h * turn.T @ after
    errors[:, VELOCITY, GYRO_BIAS] = -h * skew(velocity - speeds[1:]) @ after
    errors[:, POSITION, GYRO_BIAS] = -h * skew(position - places[1:] - left * speeds[1:]) @ after
    errors[:, VELOCITY, ACCEL_BIAS] = h * turned
    errors[:, POSITION, ACCEL_BIAS] = (0.5 * h + left[..., None]) * h * turned
    scaled = errors.reshape(-1, 9, 2, 3) * np.sqrt(spectra / steps[:, None])[:, None, :, None]
    columns = scaled.transpose(2, 1, 0, 3).reshape(2, 9, -1)
    slope, noises = -errors.sum(axis=0), columns @ columns.transpose(0, 2, 1)
    pairs = (errors[..., GYRO_BIAS], rates), (errors[..., ACCEL_BIAS], forces)
    factors = [-np.einsum("kri,kj->rij", *pair).reshape(9, 9) for pair in pairs]
    # The same samples, taken a moment later.
    delay = np.concatenate(
        [
            gyro[-1] - turn.T @ gyro[0],
            turn @ accel[-1] - accel[0] - np.cross(gyro[0], velocity),
            velocity - (end - start) * accel[0] - np.cross(gyro[0], position),
        ]
    )
    missing = float(steps[is_missing].sum())
    slope = np.column_stack([slope, delay, *factors])
    return Preintegrated(end - start, turn, velocity, position, slope, noises[0], noises[1], missing)


def bridge_spectrum(t: np.ndarray, values: np.ndarray, gap: float) -> np.ndarray:
    """Power spectra (D,), as of white noise, of how random walks depart from the line between both ends of a gap.

    The walks are as fast as values (N, D) at times (N,) change over that time.
    """
    starts = t <= t[-1] - gap
    changes = interpolate(t[starts] + gap, t, values) - values[starts]
    return np.asarray(np.mean(changes**2, axis=0) * gap / 12.0)


def interpolate(at: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(M, D) values at times (M,), of those (N, D) at times (N,); held beyond these."""
    return np.column_stack([np.interp(at, t, column) for column in values.T])
