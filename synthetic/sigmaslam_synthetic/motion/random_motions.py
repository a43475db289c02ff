"""Seeded motions of cameras and tools: hand-held, flown, driven, endoscopic.

Cameras look along z with x right and y down; the world's z is up. All start at 0 and end at `duration` seconds, and
are smooth to the angular acceleration, see `Path`.
"""

from dataclasses import replace
from pathlib import Path as FilePath
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, RotationSpline

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.readers.trajectory_files import read_kitti
from sigmaslam_synthetic.geometry import arc_length
from sigmaslam_synthetic.motion.paths import (
    KNOT_INTERVAL,
    LARGEST_NOISE,
    Path,
    carried_frames,
    integral,
    interval,
    noise,
    padded_clock,
    path_through,
    place_stops,
    smooth_to_rate,
    view_rotations,
    wandering_curve,
)

CAMERA_HEIGHT = 1.65
"""Of KITTI's cameras above the road, metres."""

_GRAVITY = 9.81
_DEGREE = np.pi / 180


class FreeSpace(NamedTuple):
    """Free space, upright.

    Attributes:
        centre: (x, y, z) metres.
        half: half of its size along x, y, z, metres.
    """

    centre: tuple[float, float, float]
    half: tuple[float, float, float]


def hand_held(rng: np.random.Generator, duration: float, box: FreeSpace) -> Path:
    """A camera that is carried by a walking person, who looks all around.

    Walks at 0.3-0.8 m/s, slower where the way turns back, with the bounce and sway of steps, up to 40 deg/s, with
    tremor of the hand (0.15 degrees, 0.3 mm rms).

    Args:
        duration: seconds.
        box: that the camera stays in.
    """
    t, inside = padded_clock(duration)
    base = rng.uniform(0.42, 0.62)
    swing = min(base - 0.32, 0.74 - base) / LARGEST_NOISE
    speed = base + swing * noise(rng, t, 1, 0.1, 0.5)[:, 0]
    walked = integral(t, speed)
    # Room for the steps (to 2 cm) and the tremor, less where the box is small.
    half = np.array(box.half)
    step = np.minimum(0.9 * half / 2, [0.012, 0.012, rng.uniform(0.008, 0.02)])
    tremor = np.minimum(0.1 * half / LARGEST_NOISE, 0.0003)
    room = half - step - LARGEST_NOISE * tremor
    _, curve = wandering_curve(rng, room, walked[-1] / max(room[:2].max(), 1e-9))
    route = np.stack([np.interp(walked, arc_length(curve), axis) for axis in curve.T], axis=-1)
    route = gaussian_filter1d(route, 0.4 / interval(t), axis=0, mode="nearest")
    strides = 2 * np.pi * walked / rng.uniform(1.0, 1.3)  # of two steps
    sway = np.stack([np.sin(strides), np.cos(strides), np.sin(2 * strides + 0.7)], axis=-1)
    position = route + step * sway + tremor * noise(rng, t, 3, 1.0, 5.0) + np.array(box.centre)

    turning = 60 * noise(rng, t, 1, 0.01, 0.05)[:, 0] + rng.uniform(10, 25) * noise(rng, t, 1, 0.08, 0.3)[:, 0]
    yaw, pitch = rng.uniform(-np.pi, np.pi) + _DEGREE * turning, np.full(t.shape, -6 * _DEGREE)
    pitch = pitch + _DEGREE * 4 * noise(rng, t, 1, 0.1, 0.5)[:, 0]
    roll = _DEGREE * 2.5 * noise(rng, t, 1, 0.1, 0.4)[:, 0]
    angles = smooth_to_rate(t, np.stack([yaw, pitch, roll], axis=-1), _DEGREE * rng.uniform(18, 31))
    angles = angles + _DEGREE * 0.15 / 3**0.5 * noise(rng, t, 3, 1.0, 5.0)
    return path_through(t[inside], position[inside], view_rotations(*angles[inside].T))


def drone(rng: np.random.Generator, duration: float, box: FreeSpace) -> Path:
    """A camera that is fixed to a drone: up to 2-3 m/s and 4 m/s^2, banks with its acceleration, turns at 45-90 deg/s.

    Args:
        duration: seconds.
        box: that the camera stays in; in a small one the drone is slower, as its acceleration is bounded.
    """
    t, inside = padded_clock(duration)
    half = np.array(box.half)
    # A slow way through the box, and quick dodges of up to half a metre.
    dodge = np.minimum(0.25 * half / LARGEST_NOISE, 0.14)
    u, curve = wandering_curve(rng, 0.98 * half - LARGEST_NOISE * dodge, 3.0 * (t[-1] - t[0]) / half.max())
    velocity = np.gradient(curve, u, axis=0)
    acceleration = np.gradient(velocity, u, axis=0)
    fastest, hardest = (np.linalg.norm(x, axis=1).max() for x in (velocity, acceleration))
    tempo = min(rng.uniform(1.8, 2.5) / fastest, (2.0 / hardest) ** 0.5)  # of u; acceleration goes with its square
    position = CubicSpline(u, curve)(tempo * (t - t[0])) + dodge * noise(rng, t, 3, 0.2, 0.5)
    push = np.gradient(np.gradient(position, t, axis=0), t, axis=0)

    turning = rng.uniform(40, 90) * noise(rng, t, 1, 0.03, 0.2)
    yaw = smooth_to_rate(t, _DEGREE * turning, _DEGREE * rng.uniform(45, 88))[:, 0] + rng.uniform(-np.pi, np.pi)
    ahead = push[:, 0] * np.cos(yaw) + push[:, 1] * np.sin(yaw)
    right = push[:, 0] * np.sin(yaw) - push[:, 1] * np.cos(yaw)
    lift = _GRAVITY + push[:, 2]
    vibration = _DEGREE * 0.1 * noise(rng, t, 2, 2.0, 5.0)
    pitch = -np.arctan2(ahead, lift) + _DEGREE * rng.uniform(-20, 0) + vibration[:, 0]
    roll = np.arctan2(right, np.hypot(lift, ahead)) + vibration[:, 1]
    position = position + np.array(box.centre)
    return path_through(t[inside], position[inside], view_rotations(yaw[inside], pitch[inside], roll[inside]))


def drive(rng: np.random.Generator, duration: float) -> Path:
    """The left camera of a car in a town, with the statistics of KITTI's ground truth.

    Starts over the origin along world x, with the camera `CAMERA_HEIGHT` above the road; the road goes up and down.

    Measured on KITTI odometry 04, 05, 07, 10 (530 s, by differences at 10 Hz, yaw rate smoothed over 0.2 s, speed
    over 0.3 s); median of the four or range: speed median 7-9 m/s in town and 14 on an open road, 95 % below 11-14;
    acceleration 1.0 m/s^2 rms, 1-99 % -2.9 to 2.4; 3.3-4.4 turns a minute of 77-107 degrees, 4 s each above 8 deg/s,
    peaks of 20-34 deg/s at 3-5 m/s; between turns half of the yaw rates are within 1-2 deg/s; 3 stops, of 7 s;
    pitch -1.2 degrees to the road, +0.3 degrees per m/s^2, and above its 2 s mean 0.35 degrees rms (half below, half
    above 0.5 Hz; 1.5 deg/s rms); roll 0.48 degrees rms (mostly 0.1-0.5 Hz; 1.3 deg/s rms); height 1-3 cm rms within
    1 s, mostly below 0.5 Hz; slope 1.1-1.6 degrees rms.

    Args:
        duration: seconds.
    """
    ease = rng.uniform(6.0, 7.5)
    lights = min(int(rng.poisson(0.35 / 60 * duration)), int(0.4 * duration / (ease + 8)))
    holds = rng.uniform(4.0, 9.0, lights)
    moving = duration - float(holds.sum()) - lights * ease
    open_road = rng.random() < 0.2
    cruise = rng.uniform(13, 16) if open_road else rng.uniform(7.8, 11.5)
    t, inside = padded_clock(moving, 0.1)

    # The road, by its length s: bends of turns at junctions, and soft ones between.
    s = np.arange(0.0, 1.3 * cruise * (t[-1] - t[0]) + 100, 0.25)
    bend = 0.004 * noise(rng, s, 1, 1 / 250, 1 / 60)[:, 0] * (0.3 if open_road else 1.0)
    allowed = cruise * (1 + (0.02 if open_road else 0.14) * noise(rng, s, 1, 1 / 400, 1 / 80)[:, 0])
    at = 0.0
    while not open_road:
        at += 45 + rng.exponential(50)
        if at > s[-1]:
            break
        angle = rng.choice([-1, 1]) * rng.normal(90, 8) * _DEGREE
        length = rng.uniform(22, 30)
        x = np.clip((s - at) / length, -0.5, 0.5)
        bend += angle / length * (1 + np.cos(2 * np.pi * x)) * (np.abs(x) < 0.5)
        allowed = np.where(np.abs(x) < 0.25, np.minimum(allowed, rng.uniform(3.2, 5.0)), allowed)
        at += length
    allowed = np.minimum(np.maximum(allowed, 2.0), np.sqrt(2.6 / np.maximum(np.abs(bend), 1e-6)))
    square = allowed**2
    gain, brake = rng.uniform(1.6, 2.3), rng.uniform(2.0, 2.9)  # m/s^2
    for k in range(1, len(s)):
        square[k] = min(square[k], square[k - 1] + 2 * gain * 0.25)
    for k in range(len(s) - 2, -1, -1):
        square[k] = min(square[k], square[k + 1] + 2 * brake * 0.25)
    passing = np.concatenate([[0.0], np.cumsum(0.25 / np.sqrt(0.5 * (square[1:] + square[:-1])))])
    driven = gaussian_filter1d(np.interp(t - t[0], passing, s), 0.45 / 0.1, mode="nearest")

    heading = np.interp(driven, s, integral(s, bend))
    slope = _DEGREE * 1.2 * noise(rng, driven, 1, 1 / 500, 1 / 120)[:, 0]
    speed = np.gradient(driven, t)
    ground = integral(t, (speed * np.stack([np.cos(heading), np.sin(heading), np.tan(slope)])).T)
    lever = 1.7 * np.stack([np.cos(heading), np.sin(heading), np.tan(slope)], axis=-1)  # from rear axle to camera
    bounce = 0.008 * noise(rng, t, 1, 0.2, 0.6)[:, 0] + 0.002 * noise(rng, t, 1, 0.8, 2.0)[:, 0]
    position = ground + lever + np.array([0.0, 0.0, 1.0]) * bounce[:, None]
    nod = 0.24 * noise(rng, t, 1, 0.1, 0.5) + 0.22 * noise(rng, t, 1, 0.5, 1.5) + 0.06 * noise(rng, t, 1, 1.5, 2.5)
    lean = 0.45 * noise(rng, t, 1, 0.1, 0.5) + 0.12 * noise(rng, t, 1, 0.8, 2.0)
    pitch = slope + _DEGREE * (rng.normal(-1.2, 0.2) + nod[:, 0] + 0.3 * np.gradient(speed, t))
    roll = _DEGREE * (1.2 * noise(rng, driven, 1, 1 / 500, 1 / 120) + lean)[:, 0]
    position, rotations = _from_origin(position[inside], view_rotations(heading, pitch, roll)[inside])
    return replace(path_through(t[inside], position, rotations), stops=place_stops(rng, 0.0, moving, holds, ease))


def drive_profile(path: str | FilePath, duration: float, rng: np.random.Generator) -> Path:
    """A random stretch of a real drive, from a KITTI pose file.

    The positions are smoothed over 0.7 s, by centimetres: at 10 Hz their second differences are noise of 10 m/s^2.

    Args:
        path: rows of 12 numbers, T_first_camera; 10 Hz, or as times.txt beside it says.
        duration: seconds.
        rng: source of the choice of the stretch.
    Returns:
        The path in a world with z up, which starts over the origin along world x, `CAMERA_HEIGHT` above the ground.
    Raises:
        InputError: the file cannot be read, a line is wrong, or the drive is shorter than `duration`.
    """
    drive = read_kitti(path)
    times = drive.timestamps - drive.timestamps[0]
    if len(drive) < 4 or not 0 < duration <= times[-1]:
        raise InputError(
            f"{path}: the drive of {len(drive)} lines lasts {times[-1]:.1f} s, {duration} s were asked for; "
            "ask for less, or give a longer file"
        )
    first = int(rng.integers(np.searchsorted(times, times[-1] - duration, side="right")))
    last = int(np.searchsorted(times, times[first] + duration)) + 1
    world = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # of KITTI's first camera
    smooth = savgol_filter(drive.positions, min(7, len(drive) - 1 + len(drive) % 2), 2, axis=0)
    position, rotations = _from_origin(smooth[first:last] @ world.T, world @ drive.rotations[first:last])
    return path_through(times[first:last] - times[first], position, rotations)


def insertion(rng: np.random.Generator, duration: float, centreline: np.ndarray, radius: float) -> Path:
    """An endoscope in a tube: 5-20 mm/s in, now and then back; steers, rolls, trembles and is moved by breathing.

    Args:
        duration: seconds; where the end of the tube is reached, the way goes back and forth.
        centreline: (K, 3) points on the tube's axis from its mouth inwards, metres.
        radius: of the tube, metres; the camera stays within 0.6 of it.
    """
    knots = np.asarray(centreline, dtype=np.float64)
    axis = CubicSpline(arc_length(knots), knots)
    length = float(axis.x[-1])
    along = np.linspace(0, length, 500)
    frames = carried_frames(axis(along, 1))

    t, inside = padded_clock(duration)
    base = rng.uniform(0.008, 0.016)
    pieces = np.cumsum(rng.uniform(4.0, 10.0, int(duration / 4) + 8)) - 10
    backwards = np.append(rng.random(len(pieces)) < 0.25, False)[np.searchsorted(pieces, t)]
    speed = base * (1 + 0.25 / LARGEST_NOISE * noise(rng, t, 1, 0.1, 0.5)[:, 0]) * np.where(backwards, -0.8, 1.0)
    margin = 0.06 * length
    run = length - 2 * margin
    place = integral(t, speed) + rng.uniform(0.0, 0.4) * run
    place = margin + run - np.abs(run - np.mod(place, 2 * run))  # there and back
    place = gaussian_filter1d(place, 0.6 / interval(t), mode="nearest")

    aside = 0.35 * radius / LARGEST_NOISE / 2**0.5 * noise(rng, t, 2, 0.03, 0.2)
    breath = min(0.0015, 0.12 * radius) * np.sin(2 * np.pi * (rng.uniform(0.2, 0.3) * t + rng.random()))
    tremor = min(0.0001, 0.02 * radius / LARGEST_NOISE) * noise(rng, t, 3, 1.0, 5.0)
    ahead = Rotation.from_matrix(frames)
    frame = RotationSpline(along, ahead)(np.minimum(place + min(1.5 * radius, margin), length))
    lateral = frame.as_matrix()[:, :, :2] @ aside[..., None]
    push = rng.standard_normal(3)
    push /= np.linalg.norm(push)
    position = axis(place) + lateral[..., 0] + breath[:, None] * push + tremor
    steering = _DEGREE * np.concatenate([6 * noise(rng, t, 2, 0.05, 0.3), 25 * noise(rng, t, 1, 0.01, 0.08)], axis=-1)
    steering = steering + _DEGREE * 0.15 * noise(rng, t, 3, 1.0, 5.0)
    rotations = (frame * Rotation.from_rotvec(steering)).as_matrix()
    return path_through(t[inside], position[inside], rotations[inside])


def inspect(rng: np.random.Generator, duration: float, distance: float, extent: float) -> Path:
    """A camera that hovers over the surface z = 0 and looks down at it, slanted to 25 degrees, with slow roll.

    Args:
        duration: seconds.
        distance: mean height above the surface, metres; it varies by a quarter.
        extent: half of the side of the square, about the origin, above which it stays, metres.
    """
    t, inside = padded_clock(duration)
    reach = np.array([extent, extent, 0.25 * distance]) * 0.97 / LARGEST_NOISE
    position = reach * noise(rng, t, 3, 0.02, 0.1) + np.array([0.0, 0.0, distance])
    position += np.minimum(0.03 * reach, 0.0002) * noise(rng, t, 3, 1.0, 5.0)
    slant = 25 / LARGEST_NOISE / 2**0.5 * noise(rng, t, 2, 0.03, 0.15)
    roll = 20 * noise(rng, t, 1, 0.01, 0.08) + rng.uniform(-180, 180)
    tremor = 0.15 * noise(rng, t, 3, 1.0, 5.0)
    down = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    turn = Rotation.from_euler("z", _DEGREE * roll) * down
    tilt = Rotation.from_rotvec(_DEGREE * np.concatenate([slant, np.zeros_like(roll)], axis=-1))
    rotations = (turn * tilt * Rotation.from_rotvec(_DEGREE * tremor)).as_matrix()
    return path_through(t[inside], position[inside], rotations[inside])


def tool(rng: np.random.Generator, duration: float, centre: tuple[float, float, float], reach: float) -> Path:
    """A rigid instrument that is moved about, with rests of 1-3 s; T_world_tool is a turn of 10-50 degrees or so.

    Args:
        duration: seconds.
        centre: of its motion, metres.
        reach: it stays within this distance of the centre, metres.
    """
    ease = 0.8
    holds = rng.uniform(1.0, 3.0, int(duration / 10))
    moving = duration - float(holds.sum()) - len(holds) * ease
    t, inside = padded_clock(moving)
    aside = noise(rng, t, 3, 0.08, 0.5)
    position = np.array(centre) + 0.97 * reach / np.linalg.norm(aside, axis=1).max() * aside
    turning = noise(rng, t, 3, 0.05, 0.3) * rng.uniform(8, 20, 3) + 0.2 * noise(rng, t, 3, 1.0, 5.0)
    path = path_through(t[inside], position[inside], rotation_exp(_DEGREE * turning)[inside])
    return replace(path, stops=place_stops(rng, 0.0, moving, holds, ease))


def pure_rotation(rng: np.random.Generator, duration: float, position: tuple[float, float, float]) -> Path:
    """A camera that turns at one place, up to 40 deg/s.

    Args:
        duration: seconds.
        position: (x, y, z) metres.
    """
    t, inside = padded_clock(duration)
    turning = np.array([60.0, 10.0, 5.0]) * noise(rng, t, 3, 0.02, 0.2) + [rng.uniform(-180, 180), 0, 0]
    angles = smooth_to_rate(t, _DEGREE * turning, _DEGREE * rng.uniform(25, 39))
    fixed = np.broadcast_to(np.array(position, dtype=np.float64), (len(t), 3))
    return path_through(t[inside], fixed[inside], view_rotations(*angles[inside].T))


def closed_loop(rng: np.random.Generator, duration: float, box: FreeSpace) -> Path:
    """A camera that looks ahead on a round course and ends at its start, with the same pose and velocity.

    Args:
        duration: seconds of a round; with the box it makes the speed, which varies by a quarter.
        box: that the course fills.
    """
    knots = max(8, int(np.ceil(duration / KNOT_INTERVAL)))
    t = np.linspace(0.0, duration, knots + 1)
    angle = np.linspace(0, 2 * np.pi, 2001)
    phases = rng.uniform(0, 2 * np.pi, 3)
    course = 0.97 * np.stack([0.85 * np.cos(angle), 0.85 * np.sin(angle), 0.6 * np.sin(angle + phases[2])], axis=-1)
    course += 0.97 * 0.12 * np.stack([np.cos(2 * angle + phases[i]) for i in range(3)], axis=-1)
    course = np.array(box.half) * course * [1.0, rng.choice([-1.0, 1.0]), 1.0]
    course[-1] = course[0]
    arc = arc_length(course)
    around = CubicSpline(arc, course, bc_type="periodic")
    place = t / duration + 0.25 / (2 * np.pi * 3) * np.sin(2 * np.pi * 3 * t / duration + phases[0])
    place = arc[-1] * (place - place[0])

    def sway(channels: int, low: float, high: float) -> np.ndarray:
        # Whole cycles in the duration, so that it closes.
        lowest = max(1, round(low * duration))
        cycles = rng.integers(lowest, max(lowest, round(high * duration)) + 1, channels)
        return np.asarray(np.sin(2 * np.pi * (cycles * t[:, None] / duration + rng.random(channels))))

    forward = around(np.mod(place, arc[-1]), 1)
    yaw = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    turned = (yaw[-1] - yaw[0]) * t / duration
    smooth = gaussian_filter1d((yaw - turned)[:-1], min(0.7, 0.05 * duration) / interval(t), mode="wrap")
    yaw = turned + np.append(smooth, smooth[0]) + _DEGREE * 4 * sway(1, 0.1, 0.4)[:, 0]
    pitch, roll = (_DEGREE * np.array([3.0, 2.0]) * sway(2, 0.1, 0.4) + _DEGREE * 0.15 * sway(2, 1.0, 3.0)).T
    position = around(np.mod(place, arc[-1])) + np.array(box.centre)
    rotations = view_rotations(yaw, pitch, roll)
    position[-1], rotations[-1] = position[0], rotations[0]
    return path_through(t, position, rotations)


def rolling(rng: np.random.Generator, duration: float, box: FreeSpace) -> Path:
    """A level camera on a robot with wheels, which looks where it drives: round courses at 0.3-0.5 m/s.

    Args:
        duration: seconds.
        box: that the course fills, at the height of its centre.
    """
    t, inside = padded_clock(duration)
    angle = np.linspace(0, 2 * np.pi, 2001)
    # The first harmonic outweighs the second, so that the course never turns on the spot.
    course = 0.97 * np.stack([0.85 * np.cos(angle), 0.85 * np.sin(angle)], axis=-1)
    course += 0.97 * 0.12 * np.cos(2 * angle[:, None] + rng.uniform(0, 2 * np.pi, 2))
    course = np.array(box.half[:2]) * course * [1.0, rng.choice([-1.0, 1.0])]
    course[-1] = course[0]
    arc = arc_length(course)
    around = CubicSpline(arc, course, bc_type="periodic")
    speed = rng.uniform(0.36, 0.44) + 0.06 / LARGEST_NOISE * noise(rng, t, 1, 0.05, 0.2)[:, 0]
    place = np.mod(rng.uniform(0, arc[-1]) + integral(t, speed), arc[-1])
    ahead = around(place, 1)
    yaw, level = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), np.zeros_like(t)
    position = np.column_stack([around(place), level]) + np.array(box.centre)
    return path_through(t[inside], position[inside], view_rotations(yaw[inside], level[inside], level[inside]))


def _from_origin(position: np.ndarray, rotations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same motion, begun over the origin at `CAMERA_HEIGHT` with a view along world x."""
    forward = rotations[0, :, 2]
    turn = rotation_exp(np.array([0.0, 0.0, -np.arctan2(forward[1], forward[0])]))
    return (position - position[0]) @ turn.T + np.array([0.0, 0.0, CAMERA_HEIGHT]), turn @ rotations
