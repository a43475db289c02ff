"""Smooth, seeded camera paths: sums of sinusoids along a curve, so that every derivative is smooth too."""

import numpy as np

from sigmaslam.synthetic.worlds import street_line


def room_flight(rng: np.random.Generator, frames: int, fps: float) -> np.ndarray:
    """A hand-held walk through the middle of `room_scene`, 0.3-0.8 m/s and up to about 20 deg/s.

    Args:
        rng: source of all randomness.
        frames: number of poses.
        fps: poses per second.
    Returns:
        (frames, 4, 4) T_world_camera; camera x right, y down, z forward; world z up.
    """
    time = np.arange(frames) / fps
    # A closed curve of mutually prime frequencies, walked at a speed that itself varies smoothly.
    phases = rng.uniform(0, 2 * np.pi, 4)

    def curve(s: np.ndarray) -> np.ndarray:
        x = 1.3 * np.sin(2 * s + phases[0]) + 0.3 * np.sin(5 * s + phases[1])
        y = 0.6 * np.sin(3 * s + phases[2])
        z = 1.5 + 0.2 * np.sin(5 * s + phases[3])
        return np.stack([x, y, z], axis=-1)

    grid = np.linspace(0, 2 * np.pi, 20001)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve(grid), axis=0), axis=1))])
    speed, swing, rate = rng.uniform(0.5, 0.58), rng.uniform(0.1, 0.16), 2 * np.pi * rng.uniform(0.3, 0.5)
    phase = rng.uniform(0, 2 * np.pi)
    walked = speed * time + swing / rate * (np.sin(rate * time + phase) - np.sin(phase))
    laps, rest = np.divmod(walked, arc[-1])
    position = curve(np.interp(rest, arc, grid) + 2 * np.pi * laps)
    position += _waves(rng, time, np.array([0.004, 0.004, 0.006]), 1.8)

    degree = np.pi / 180
    yaw = rng.uniform(-np.pi, np.pi) + _waves(rng, time, np.array([22.0, 1.6]) * degree, 0.09, 0.45).sum(-1)
    pitch = -6 * degree + _waves(rng, time, np.array([5.0, 0.6]) * degree, 0.2, 0.9).sum(-1)
    roll = _waves(rng, time, np.array([4.0, 0.5]) * degree, 0.22, 1.1).sum(-1)
    return _poses(position, yaw, pitch, roll)


def street_drive(rng: np.random.Generator, frames: int, fps: float) -> np.ndarray:
    """A drive along `street_line` through its bend, 5-9 m/s, 1.65 m above the ground.

    Args:
        rng: source of all randomness.
        frames: number of poses.
        fps: poses per second.
    Returns:
        (frames, 4, 4) T_world_camera; camera x right, y down, z forward; world z up.
    """
    time = np.arange(frames) / fps
    speed, swing, rate = rng.uniform(6.6, 7.4), rng.uniform(0.8, 1.5), 2 * np.pi * rng.uniform(0.08, 0.15)
    phase = rng.uniform(0, 2 * np.pi)
    arc = speed * time + swing / rate * (np.sin(rate * time + phase) - np.sin(phase))
    on_line, heading = street_line(arc)
    left = np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    aside, up = 0.35 * _waves(rng, time, np.ones(1), 0.12), 1.65 + 0.012 * _waves(rng, time, np.ones(1), 1.3)
    position = np.concatenate([on_line + aside * left, up], axis=-1)
    degree = np.pi / 180
    yaw = heading + _waves(rng, time, np.array([0.8]) * degree, 0.2).sum(-1)
    pitch = _waves(rng, time, np.array([0.5, 0.15]) * degree, 0.5, 1.7).sum(-1)
    roll = _waves(rng, time, np.array([0.5, 0.1]) * degree, 0.4, 1.4).sum(-1)
    return _poses(position, yaw, pitch, roll)


def _waves(rng: np.random.Generator, time: np.ndarray, amplitudes: np.ndarray, *frequencies: float) -> np.ndarray:
    """(frames, n) sinusoids of given amplitudes and of about the given frequencies (Hz), random phases."""
    hertz = np.broadcast_to(np.array(frequencies), amplitudes.shape) * rng.uniform(0.85, 1.15, amplitudes.shape)
    phases = rng.uniform(0, 2 * np.pi, amplitudes.shape)
    waves: np.ndarray = amplitudes * np.sin(2 * np.pi * hertz * time[:, None] + phases)
    return waves


def _poses(position: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Poses (frames, 4, 4) from angles (frames,): yaw about world z, pitch up, roll about the view."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    cr, sr = np.cos(roll)[:, None], np.sin(roll)[:, None]
    zero = np.zeros_like(yaw)
    forward = np.stack([cy * cp, sy * cp, sp], axis=-1)
    level = np.stack([sy, -cy, zero], axis=-1)
    down = np.cross(forward, level)
    T = np.tile(np.eye(4), (len(yaw), 1, 1))
    T[:, :3, 0] = cr * level + sr * down
    T[:, :3, 1] = cr * down - sr * level
    T[:, :3, 2] = forward
    T[:, :3, 3] = position
    return T
