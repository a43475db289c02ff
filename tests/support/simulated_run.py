"""Run folders of a simulated drive: a stereo camera among landmarks, tracked with drift."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from sigmaslam.bundle_adjustment.track_file import Tracks
from sigmaslam.geometry.se3 import rotation_exp, se3_exp, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_tum

INTRINSICS = np.array([400.0, 410.0, 320.0, 240.0, 0.2])
WIDTH, HEIGHT = 640, 480
OFFSET = 0.3
SIGMA = np.array([0.3, 0.25, 0.2])


@dataclass(frozen=True, slots=True)
class Simulation:
    """A drive and what a tracker made of it.

    Attributes:
        truth: poses of the left camera in every frame.
        tracked: the same with drift.
        covariances: (N, 6, 6) what the tracker says of its drift.
        tracks: observations by every third frame.
        exact: (O, 3) the measurements without noise.
    """

    truth: Trajectory
    tracked: Trajectory
    covariances: np.ndarray
    tracks: Tracks
    exact: np.ndarray = field(repr=False)

    def write(self, run: Path) -> Path:
        """Writes what `sigmaslam map refine` reads; returns the folder."""
        run.mkdir(parents=True)
        write_tum(run / "trajectory.tum", self.tracked)
        np.save(run / "covariance.npy", self.covariances)
        np.savez_compressed(run / "tracks.npz", **{name: getattr(self.tracks, name) for name in Tracks.__slots__})
        return run

    def with_measurement(self, measurement: np.ndarray) -> Simulation:
        return replace(self, tracks=replace(self.tracks, measurement=measurement))


def simulate(
    seed: int,
    keyframes: int = 12,
    per_keyframe: int = 60,
    noise: float = 1.0,
    depths: tuple[float, float] = (2.0, 12.0),
    without_disparity: float = 0.0,
    drift: float = 1.0,
    most_views: int = 8,
    break_at: int | None = None,
) -> Simulation:
    """Drives forward on a winding path.

    Args:
        seed: of everything.
        keyframes: every third frame is one, and one more frame follows the last.
        per_keyframe: observations of each keyframe.
        noise: factor on what `SIGMA` says; the covariances stay, unless it is zero.
        depths: of landmarks when first seen, metres, evenly in inverse depth.
        without_disparity: share of observations whose disparity is NaN.
        drift: factor on the tracker's.
        most_views: of a landmark.
        break_at: the keyframe at which all tracks end and new ones begin.
    """
    rng = np.random.default_rng(seed)
    count = 3 * keyframes - 1
    truth, tracked, covariances = _drive(rng, count, drift)
    R_rectified_left = rotation_exp(np.array([0.01, -0.02, 0.015]))
    T_left_rectified = np.eye(4)
    T_left_rectified[:3, :3] = R_rectified_left.T
    T_world_rectified = truth @ T_left_rectified

    frame, landmark, exact = [], [], []
    points, views, number = np.zeros((0, 3)), np.zeros(0, np.int64), 0
    first = 0  # landmarks before this are not tracked any more
    for k in range(keyframes):
        T = T_world_rectified[3 * k]
        if k == break_at:
            first = len(points)
        _, seen = _project(T, points)
        seen &= (views < most_views) & (np.arange(len(points)) >= first)
        old = np.flatnonzero(seen)[:per_keyframe]
        fresh = _new_points(rng, T, per_keyframe - len(old), depths)
        number = len(points)
        points, views = np.concatenate([points, fresh]), np.concatenate([views, np.zeros(len(fresh), np.int64)])
        seen = np.concatenate([old, np.arange(number, len(points))])
        views[seen] += 1
        frame += [3 * k] * len(seen)
        landmark += (1000 + 7 * seen).tolist()
        exact.append(_project(T, points[seen])[0])
    measurement = np.concatenate(exact)
    measurement[:, 2] += OFFSET
    exact = measurement.copy()

    # Every observation with a covariance of its own, u and disparity correlated.
    root = np.tile(np.diag(SIGMA), (len(measurement), 1, 1))
    root[:, 2, 0] = 0.5 * SIGMA[2]
    root *= rng.uniform(0.7, 1.4, (len(root), 1, 1))
    measurement += noise * np.einsum("oij,oj->oi", root, rng.normal(size=measurement.shape))
    measurement[rng.uniform(size=len(measurement)) < without_disparity, 2] = np.nan
    covariance = root @ root.transpose(0, 2, 1)
    covariance[np.isnan(measurement[:, 2]), 2] = np.nan
    times = 10.0 + 0.1 * np.arange(count)
    tracks = Tracks(
        np.array(frame), np.array(landmark), measurement, covariance, INTRINSICS, R_rectified_left, np.array([0.1, 0.1])
    )
    return Simulation(Trajectory(times, truth), Trajectory(times, tracked), covariances, tracks, exact)


def _drive(rng: np.random.Generator, count: int, drift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    sigma = drift * np.array([0.005, 0.005, 0.01, 0.001, 0.001, 0.001])
    phase = np.arange(count - 1) / 6.0
    steps = np.zeros((count - 1, 6))
    steps[:, 0], steps[:, 2] = 0.05 * np.sin(phase), 0.12
    steps[:, 3], steps[:, 4] = 0.01 * np.cos(1.3 * phase), 0.02 * np.sin(0.7 * phase)
    truth, tracked, covariances = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
    for step in se3_exp(steps):
        truth.append(truth[-1] @ step)
        tracked.append(tracked[-1] @ step @ se3_exp(rng.normal(size=6) * sigma))
        covariances.append(covariances[-1] + np.diag(sigma**2))
    return np.stack(truth), np.stack(tracked), np.stack(covariances)


def _project(T_world_camera: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(u, v, disparity) and whether it is in the image, at least half a metre away."""
    fx, fy, cx, cy, baseline = INTRINSICS
    T = se3_inverse(T_world_camera)
    X, Y, Z = (points @ T[:3, :3].T + T[:3, 3]).T
    near = Z < 0.5
    Z = np.where(near, 1.0, Z)
    u, v = fx * X / Z + cx, fy * Y / Z + cy
    inside = (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
    return np.column_stack([u, v, fx * baseline / Z]), inside & ~near


def _new_points(rng: np.random.Generator, T: np.ndarray, count: int, depths: tuple[float, float]) -> np.ndarray:
    fx, fy, cx, cy, _ = INTRINSICS
    Z = 1.0 / rng.uniform(1.0 / depths[1], 1.0 / depths[0], count)
    u, v = rng.uniform(0, WIDTH, count), rng.uniform(0, HEIGHT, count)
    points = np.column_stack([(u - cx) / fx * Z, (v - cy) / fy * Z, Z])
    return points @ T[:3, :3].T + T[:3, 3]
