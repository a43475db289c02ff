"""A tracker that drifts exactly as it says, and a location sensor with its own clock, world and mount."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.fusion.readings import Locations
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse
from sigmaslam.slam.tracker import CalibrationEstimate, Estimate

FRAME = 0.05


def estimate_of(timestamp: float, pose: np.ndarray, covariance: np.ndarray, status: str = "tracking") -> Estimate:
    return Estimate(timestamp, pose, covariance, covariance, status, 1.0, 100, 100, 1.0, 1, CalibrationEstimate(0.0, 0.1))


@dataclass(frozen=True)
class Drive:
    """True poses as a function of time, in the first pose's frame."""

    seed: int
    scale: float = 1.0

    def pose(self, time: np.ndarray) -> np.ndarray:
        phase = np.random.default_rng(self.seed).uniform(0, 2 * np.pi, 6)
        rate = np.array([0.5, 0.4, 0.3, 0.6, 0.5, 0.4])
        size = np.array([1.0, 0.8, 0.6, 0.4, 0.5, 0.4]) * np.repeat([self.scale, 1.0], 3)

        def at(t: np.ndarray) -> np.ndarray:
            return np.asarray(se3_exp(size * np.sin(rate * np.asarray(t)[..., None] + phase)))

        return np.asarray(se3_inverse(at(np.zeros(1)))[0] @ at(time))


def drifting_estimates(drive: Drive, frames: int, sigma: np.ndarray, seed: int) -> list[Estimate]:
    """Estimates whose errors are a random walk in the camera's frame, with steps of `sigma` (6,)."""
    random = np.random.default_rng(seed)
    times = FRAME * np.arange(frames)
    true = drive.pose(times)
    error, spread, estimates = np.eye(4), np.zeros((6, 6)), []
    for k, T in enumerate(true):
        if k:
            adjoint = se3_adjoint(T)
            error = error @ se3_exp(adjoint @ (sigma * random.standard_normal(6)))
            spread = spread + adjoint @ np.diag(sigma**2) @ adjoint.T
        pose = error @ T
        back = se3_adjoint(se3_inverse(pose))
        estimates.append(estimate_of(times[k], pose, back @ spread @ back.T, "tracking" if k else "starting"))
    return estimates


def sense(
    poses: np.ndarray,
    times: np.ndarray,
    seed: int,
    sigma: float,
    turn: float | None = None,
    mount: np.ndarray | None = None,
    wrong: float = 0.0,
) -> Locations:
    """Readings of a sensor on what has these poses (N, 4, 4), in a world that lies anywhere.

    Args:
        poses, times: of what the sensor is on.
        seed: of its noise and world.
        sigma: metres; turn: radians, None for a sensor of positions.
        mount: (4, 4) where on it the sensor is.
        wrong: share of readings that are off by ten sigmas and more.
    """
    random = np.random.default_rng(seed)
    A = se3_exp(np.concatenate([random.uniform(-50, 50, 3), random.uniform(-1.5, 1.5, 3)]))
    marks = A @ poses @ (np.eye(4) if mount is None else mount)
    count = len(times)
    positions = marks[:, :3, 3] + sigma * random.standard_normal((count, 3))
    gross = random.random(count) < wrong
    positions[gross] += 30 * sigma * random.standard_normal((int(gross.sum()), 3))
    covariances = np.tile(sigma**2 * np.eye(3), (count, 1, 1))
    rotations = None
    if turn is not None:
        noise = np.concatenate([np.zeros((count, 3)), turn * random.standard_normal((count, 3))], axis=1)
        rotations = (marks @ se3_exp(noise))[:, :3, :3]
        covariances = np.tile(np.diag(np.repeat([sigma, turn], 3) ** 2), (count, 1, 1))
    return Locations(times, positions, rotations, covariances)
