"""An exact inertial sensor on a smooth motion."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import RotationSpline

from sigmaslam.geometry.inertial_sensor import InertialSamples, InertialSensor
from sigmaslam.geometry.se3 import rotation_exp, rotation_log

GRAVITY = np.array([0.0, 0.0, -9.80665])
SENSOR = InertialSensor(np.eye(4), 1.7e-4, 2e-3, 2e-5, 3e-3)
# Half the step of central differences, seconds: their error is some 1e-9.
_HALF = 1e-4


class Motion:
    """Positions and rotations through random knots half a second apart.

    Args:
        seed: of the knots.
        seconds: duration.
        size: of places, metres, and turns, radians.
    """

    def __init__(self, seed: int, seconds: float = 5.0, size: float = 0.3) -> None:
        from scipy.spatial.transform import Rotation

        rng = np.random.default_rng(seed)
        t = np.arange(-1.0, seconds + 1.5, 0.5)
        self.place = CubicSpline(t, size * rng.normal(size=(len(t), 3)))
        self.rotation = RotationSpline(t, Rotation.from_rotvec(size * rng.normal(size=(len(t), 3))))

    def poses(self, t: np.ndarray) -> np.ndarray:
        """(N, 4, 4) T_world_sensor."""
        T = np.tile(np.eye(4), (len(t), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = self.rotation(t).as_matrix(), self.place(t)
        return T

    def measure(self, t: np.ndarray) -> InertialSamples:
        """Rate and specific force without errors."""
        R = self.rotation(t).as_matrix()
        before, after = (self.rotation(t + h).as_matrix() for h in (-_HALF, _HALF))
        rate = rotation_log(before.transpose(0, 2, 1) @ after) / (2 * _HALF)
        force = np.einsum("nji,nj->ni", R, self.place(t, 2) - GRAVITY)
        return InertialSamples(t, rate, force)


class Halt(Motion):
    """The same, which slows down from 1.5 s on and rests from 2.5 s on."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        t = np.arange(-1.0, 6.5, 0.01)
        share = np.clip(t - 1.5, 0.0, 1.0)
        rate = 1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        passed = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))] - 1.0
        self.place, self.rotation = CubicSpline(t, self.place(passed)), RotationSpline(t, self.rotation(passed))


def turned(R: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) turned from the right."""
    return np.asarray(R @ rotation_exp(vector))
