"""A camera in an unsteady hand or on a small drone in gusts: its turning reverses before a tracker has learned it."""

import numpy as np
from scipy.interpolate import CubicSpline

from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam_synthetic.motion.paths import LARGEST_NOISE, Path, noise, padded_clock, path_through

_DEGREE = np.pi / 180
# Peaks of the turning, degrees a second: 27 to 44 pixels a frame at a focal length of 460 pixels and 20 Hz.
_TURNING = (68.0, 110.0)
# Where a swing ends, degrees off the slow path. With these peaks it takes 0.2 to 0.5 s from one end to the other.
_SWING = (6.5, 10.5)
# The same of the roll, which makes no flow in the middle of the image.
_ROLLING, _ROLL_SWING = (15.0, 40.0), (1.5, 4.0)
_TILT = 12.0  # degrees rms by which the swings lean from the horizontal


def slowed(path: Path, duration: float) -> Path:
    """The same way without stops, passed within that many seconds."""
    return Path(path.times * (duration / path.times[-1]), path.positions, path.rotations)


def shaken(rng: np.random.Generator, slow: Path, reach: float) -> Path:
    """A slow path, shaken.

    The camera swings to and fro about an axis that wanders around its vertical one. The peaks of the rate and the ends
    of the swings are random, each of its own: the rate goes from one peak to the opposite one within half a second,
    and its past does not tell when or how far. The roll swings likewise, at less, and the position shakes.

    Args:
        slow: where the camera goes but for the shaking; from 0 on.
        reach: metres that the position leaves the slow path along each axis, at most; in bands of 1 to 2.5 Hz.
    """
    clock, inside = padded_clock(slow.end)
    t = clock[inside]
    T = slow.poses(t)
    swing, roll = _swings(rng, t, _SWING, _TURNING), _swings(rng, t, _ROLL_SWING, _ROLLING)
    lean = _DEGREE * _TILT * noise(rng, t, 1, 0.1, 0.4)[:, 0]
    turn = np.stack([swing * np.sin(lean), swing * np.cos(lean), roll], axis=-1)
    position = T[:, :3, 3] + 0.97 * reach / LARGEST_NOISE * noise(rng, t, 3, 1.0, 2.5)
    return path_through(t, position, T[:, :3, :3] @ rotation_exp(turn))


def _swings(
    rng: np.random.Generator, t: np.ndarray, ends: tuple[float, float], peaks: tuple[float, float]
) -> np.ndarray:
    """Angles (N,) at times t (N,), radians, of a C2 swinging to and fro.

    Args:
        t: seconds.
        ends: range of the angles where a swing ends, to either side, degrees.
        peaks: range of the peaks of the rate, degrees a second; kept to about a tenth.
    """
    side = rng.choice([-1.0, 1.0])
    times, angles = [t[0] - 1.0 - rng.uniform(0.0, 0.3)], [side * rng.uniform(*ends)]
    while len(times) < 4 or times[-3] < t[-1]:  # the spline's ends are out of sight
        side = -side
        angles.append(side * rng.uniform(*ends))
        # Between its ends the spline is much like half a wave of a sine.
        times.append(times[-1] + 0.5 * np.pi * abs(angles[-1] - angles[-2]) / rng.uniform(*peaks))
    return np.asarray(_DEGREE * CubicSpline(times, angles)(t))
