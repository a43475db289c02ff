"""A rigid motion as a C2 spline through timed poses, and what generators of motions are made of."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rigid_motion, rotation_log
from sigmaslam_synthetic.geometry import carried_normals


class Stop(NamedTuple):
    """A rest in the course of a path.

    Attributes:
        at: seconds on the path's own clock (that of its knots) at which it stands still.
        hold: seconds of rest, in which the speed is exactly zero.
        ease: seconds over which the speed falls before it and rises after it; of these, half is lost each.
    """

    at: float
    hold: float
    ease: float


class BodyMotion(NamedTuple):
    """How a body moves at N times.

    Attributes:
        rotation: (N, 3, 3) R_world_body.
        rate, rate_change: (N, 3) angular rate and acceleration in the body's frame, rad/s and rad/s^2.
        velocity, acceleration: (N, 3) of its origin in the world, m/s and m/s^2.
    """

    rotation: np.ndarray
    rate: np.ndarray
    rate_change: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


@dataclass(frozen=True, eq=False)
class Path:
    """A smooth rigid motion, of a camera or of a body.

    Position, velocity and acceleration are continuous, and so are orientation, angular rate and angular
    acceleration. One knot is rest. Outside its time the path stays at its first or last pose.

    Attributes:
        times: (K,) seconds, strictly increasing; knots turn less than 180 degrees from one to the next.
        positions: (K, 3) origin of the body in the world, metres.
        rotations: (K, 3) rotation vectors of T_world_body, radians; any of the equal ones will do.
        stops: rests, which lengthen the path by hold + ease each; in order, and at least an ease apart.

    Raises:
        ValueError: a shape is wrong, a number is not finite, times do not increase, or stops overlap.
    """

    times: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    stops: tuple[Stop, ...] = ()

    def __post_init__(self) -> None:
        for name in ("times", "positions", "rotations"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if not np.isfinite(array).all():
                raise ValueError(f"{name} of a path must be finite numbers")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        knots = len(self.times) if self.times.ndim == 1 else 0
        if knots < 1 or self.positions.shape != (knots, 3) or self.rotations.shape != (knots, 3):
            raise ValueError(
                "a path needs times (K,), positions (K, 3), rotations (K, 3) with K >= 1; "
                f"got {self.times.shape}, {self.positions.shape}, {self.rotations.shape}"
            )
        if np.any(np.diff(self.times) <= 0):
            raise ValueError("times of a path must increase strictly")
        object.__setattr__(self, "stops", tuple(Stop(*map(float, stop)) for stop in self.stops))
        ends = [(self.times[0], 0.0), *((s.at, s.ease) for s in self.stops), (self.times[-1], 0.0)]
        for (before, ease_before), (after, ease_after) in pairwise(ends):
            if self.stops and after - before < 0.5 * (ease_before + ease_after) - 1e-9:
                raise ValueError(f"stops of a path need their ease between them; {before} and {after} s are too close")

    @classmethod
    def from_poses(cls, times: np.ndarray, T_world_body: np.ndarray) -> Self:
        """The path through poses (K, 4, 4) at times (K,)."""
        T_world_body = np.asarray(T_world_body, dtype=np.float64)
        return cls(times, T_world_body[:, :3, 3], rotation_log(T_world_body[:, :3, :3]))

    @property
    def start(self) -> float:
        """Seconds of the first pose."""
        return float(self.times[0])

    @property
    def end(self) -> float:
        """Seconds of the last pose, stops included."""
        return float(self.times[-1]) + sum(stop.hold + stop.ease for stop in self.stops)

    def poses(self, t: np.ndarray | float) -> np.ndarray:
        """T_world_body at times t (...,), seconds -> (..., 4, 4) float64."""
        t = np.asarray(t, dtype=np.float64)
        clock = np.clip(self._knot_clock(t.ravel()), self.times[0], self.times[-1])
        if self._splines is None:
            R = Rotation.from_rotvec(self.rotations[0].copy()).as_matrix()
            place = np.tile(self.positions, (clock.size, 1))
        else:
            position, rotation = self._splines
            R, place = rotation(clock).as_matrix(), position(clock)
        return rigid_motion(R, place).reshape(*t.shape, 4, 4)

    def motion(self, t: np.ndarray) -> BodyMotion:
        """Exact derivatives of `poses` at times t (N,), seconds; zero outside of the path's time."""
        clock = self._knot_clock(t)
        inside = (clock >= self.times[0]) & (clock <= self.times[-1])
        speed, change = (np.where(inside, each, 0.0)[:, None] for each in self._clock_rates(t))
        rotation = self.poses(t)[:, :3, :3]
        if self._splines is None:
            return BodyMotion(rotation, *np.zeros((4, len(t), 3)))
        position, turn = self._splines
        velocity, rate = position(clock, 1), turn(clock, 1)
        return BodyMotion(
            rotation,
            rate * speed,
            turn(clock, 2) * speed**2 + rate * change,
            velocity * speed,
            position(clock, 2) * speed**2 + velocity * change,
        )

    def to_json(self) -> dict[str, Any]:
        """Lists of numbers, from which `from_json` makes the same path to the last bit."""
        return {
            "times": self.times.tolist(),
            "positions": self.positions.tolist(),
            "rotations": self.rotations.tolist(),
            "stops": [list(stop) for stop in self.stops],
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """The path that `to_json` wrote."""
        stops = tuple(Stop(*stop) for stop in content["stops"])
        return cls(content["times"], content["positions"], content["rotations"], stops)

    @cached_property
    def _splines(self) -> tuple[CubicSpline, RotationSpline] | None:
        if len(self.times) == 1:
            return None
        rotations = RotationSpline(self.times, Rotation.from_rotvec(self.rotations.copy()))
        return CubicSpline(self.times, self.positions), rotations

    def _knot_clock(self, t: np.ndarray) -> np.ndarray:
        """Times on the knots' clock: behind t by what was rested so far, with continuous jerk."""
        behind = np.zeros_like(t)
        rested = 0.0
        for at, hold, ease in self.stops:
            since = t - (at + rested - 0.5 * ease)  # seconds since the speed began to fall
            if ease > 0:
                # The share of the speed is 1 - h(x) as it falls and h(x) as it rises; h = 10x^3 - 15x^4 + 6x^5.
                fall, rise = (np.clip(x / ease, 0.0, 1.0) for x in (since, since - ease - hold))
                behind += ease * (_integrated_step(fall) + rise - _integrated_step(rise))
            behind += np.clip(since - ease, 0.0, hold)
            rested += hold + ease
        return t - behind

    def _clock_rates(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second derivative of the knots' clock by t."""
        speed, change, rested = np.ones_like(t), np.zeros_like(t), 0.0
        for at, hold, ease in self.stops:
            since = t - (at + rested - 0.5 * ease)
            for sign, x in ((-1.0, since), (1.0, since - ease - hold)):
                x = np.clip(x / ease, 0.0, 1.0) if ease > 0 else (x >= 0).astype(float)
                speed += sign * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
                change += sign * 30.0 * x**2 * (1.0 - x) ** 2 / (ease or 1.0)
            rested += hold + ease
        return speed, change


def _integrated_step(x: np.ndarray) -> np.ndarray:
    """Integral from 0 to x, in [0, 1], of the step 10x^3 - 15x^4 + 6x^5."""
    return x**4 * (2.5 - 3.0 * x + x**2)


def at_rest(pose: np.ndarray, duration: float) -> Path:
    """A body that stays at T_world_body (4, 4) from 0 to `duration` seconds."""
    return Path.from_poses(np.array([0.0, duration]), np.stack([pose, pose]))


def with_stops(path: Path, rng: np.random.Generator, stops: int, ease: float = 1.0) -> Path:
    """The same way with rests of 1-3 s at random places; it takes the longer by `hold + ease` each.

    Args:
        path: without stops.
        stops: how many.
        ease: seconds over which the speed falls to zero and over which it rises again.
    Raises:
        ValueError: the path has stops already, or is too short for so many.
    """
    if path.stops:
        raise ValueError("the path has stops already; add all at once")
    return replace(path, stops=place_stops(rng, path.start, path.end, rng.uniform(1.0, 3.0, stops), ease))


def place_stops(rng: np.random.Generator, start: float, end: float, holds: np.ndarray, ease: float) -> tuple[Stop, ...]:
    """Stops of those holds (n,) at random times between start and end, which are on the knots' clock.

    Raises:
        ValueError: there is no room for so many.
    """
    slack = end - start - len(holds) * ease
    if slack < 0:
        raise ValueError(f"{len(holds)} stops of ease {ease} s do not fit into {end - start:.3g} s; give fewer")
    places = start + np.sort(rng.uniform(0, slack, len(holds))) + ease * (np.arange(len(holds)) + 0.5)
    return tuple(Stop(float(at), float(hold), float(ease)) for at, hold in zip(places, holds, strict=True))


KNOT_INTERVAL = 0.04
"""Seconds between the knots of what trembles: five in a period of the fastest tremor, 5 Hz."""

WAVES = 6
LARGEST_NOISE = (2.0 * WAVES) ** 0.5
"""Bound of `noise`, which has unit variance."""


def noise(rng: np.random.Generator, t: np.ndarray, channels: int, low: float, high: float) -> np.ndarray:
    """Smooth noise of unit variance, never above `LARGEST_NOISE`: sums of `WAVES` sinusoids of equal amplitude.

    Args:
        t: (N,) seconds (or metres, or any parameter).
        channels: how many, independent.
        low, high: band of the frequencies, which are uniform in their logarithm, in cycles per unit of t.
    Returns:
        (N, channels).
    """
    frequencies = np.exp(rng.uniform(np.log(low), np.log(high), (channels, WAVES)))
    phases = rng.uniform(0, 2 * np.pi, (channels, WAVES))
    waves = np.sin(2 * np.pi * frequencies * t[:, None, None] + phases)
    return np.asarray((2.0 / WAVES) ** 0.5 * waves.sum(axis=-1))


def smooth_to_rate(t: np.ndarray, signals: np.ndarray, rate: float) -> np.ndarray:
    """Signals (N, n) at even times t (N,), smoothed in time until their joint rate is nowhere above `rate`."""
    step = t[1] - t[0]
    sigma = 0.15
    smooth = signals
    while np.linalg.norm(np.diff(smooth, axis=0), axis=1).max() > rate * step:
        smooth = gaussian_filter1d(signals, sigma / step, axis=0, mode="nearest")
        sigma *= 1.25
    return smooth


def view_rotations(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """R_world_camera of a camera (x right, y down, z forward) in a world with z up.

    Args:
        yaw: (N,) heading of the view, from world x to world y, radians.
        pitch: (N,) elevation of the view.
        roll: (N,) turn about the view, positive as the right side sinks.
    Returns:
        (N, 3, 3).
    """
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll)[:, None], np.sin(roll)[:, None]
    forward = np.stack([cy * cp, sy * cp, sp], axis=-1)
    level = np.stack([sy, -cy, np.zeros_like(yaw)], axis=-1)
    down = np.cross(forward, level)
    return np.stack([cr * level + sr * down, cr * down - sr * level, forward], axis=-1)


def path_through(t: np.ndarray, position: np.ndarray, rotations: np.ndarray) -> Path:
    """The path through positions (K, 3) with rotation matrices (K, 3, 3)."""
    return Path(t, position, rotation_log(rotations))


def padded_clock(duration: float, spacing: float = KNOT_INTERVAL) -> tuple[np.ndarray, slice]:
    """Even times (N,), about `spacing` apart, from 3 s before 0 to 3 s after `duration`; the slice from 0 to it.

    What is smoothed over time on the padded clock has no ends within the slice.
    """
    if not duration > 0:
        raise InputError(f"the duration of a path is {duration} s; give more than 0")
    steps = max(8, int(np.ceil(duration / spacing)))
    pad = int(np.ceil(3.0 / (duration / steps)))
    t = duration / steps * np.arange(-pad, steps + pad + 1)
    t[pad + steps] = duration
    return t, slice(pad, pad + steps + 1)


def interval(t: np.ndarray) -> float:
    """Seconds between even times (N,)."""
    return float(t[1] - t[0])


def integral(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The integral of y (N,) or (N, n) over x (N,) from its start, by trapezoids."""
    return np.asarray(cumulative_trapezoid(y, x, axis=0, initial=0.0))


def wandering_curve(rng: np.random.Generator, half: np.ndarray, sizes: float) -> tuple[np.ndarray, np.ndarray]:
    """A curve (N, 3) that fills +-half and is at least `sizes` times its largest half long; its parameter (N,)."""
    if not half.max() > 0.02:
        raise InputError(f"the free box is +-{np.round(half, 3)} m; give room to move in, 0.02 m or more")
    # Half a cycle, about twice the half size, takes 0.5 to 1.7 of the parameter.
    u = np.arange(0.0, max(4.0, 1.5 * sizes), 0.01)
    curve = noise(rng, u, 3, 0.3, 0.9)
    return u, half * curve / np.abs(curve).max(axis=0)


def carried_frames(tangents: np.ndarray) -> np.ndarray:
    """Frames (N, 3, 3) whose third axes are the tangents (N, 3), carried from one to the next without twist."""
    tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
    axis = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    x = carried_normals(tangents, np.cross(axis, tangents[0]))
    return np.stack([x, np.cross(tangents, x), tangents], axis=-1)
