"""The gallery's linear problems by filterpy and by this library: lines, processor seconds, results.

`python -m sigmaslam_benchmarks.filters.gallery_peers` prints the table of docs/benchmarks/filters.md. Both get the same
numbers; lines are those of the functions below.
"""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable

import numpy as np
import torch
from filterpy.kalman import FixedLagSmoother, IMMEstimator
from filterpy.kalman import KalmanFilter as PeerFilter

from sigmaslam_filters import (
    Gaussian,
    InteractingMultipleModels,
    KalmanFilter,
    LinearMeasurement,
    LinearMotion,
    UnscentedKalmanFilter,
)
from sigmaslam_filters.core.noise_covariance import as_noise
from sigmaslam_filters.systems import constant_velocity, constant_velocity_over

TARGETS, STEPS, DT = 100, 60, 0.5
Data = dict[str, np.ndarray]
Solve = Callable[[Data], np.ndarray]


def heights(seed: int, count: int = 200) -> Data:
    """A sine that is seen at any time, with outliers and gaps marked for the problems that have them."""
    rng = np.random.default_rng(seed)
    times = np.sort(rng.uniform(0.0, 20.0, count))
    values = np.sin(times) + 0.1 * rng.normal(size=count)
    wrong = values + 5.0 * (rng.random(count) < 0.1)
    return {"times": times, "truth": np.sin(times), "values": values, "wrong": wrong, "even": 0.1 * np.arange(count)}


def targets(seed: int) -> Data:
    """Targets in the plane that accelerate from step 20 to 40: states (T, N, 4) and positions measured."""
    rng, (calm, wild) = np.random.default_rng(seed), _motions()
    state, truth = 10.0 * rng.normal(size=(TARGETS, 4)), []
    start = state
    for step in range(STEPS):
        matrix, noise = (each.numpy() for each in (wild if 20 <= step < 40 else calm))
        state = state @ matrix.T + rng.normal(size=state.shape) @ np.linalg.cholesky(noise).T
        truth.append(state)
    found = np.array(truth)
    return {"start": start, "truth": found[..., :2], "values": found[..., :2] + rng.normal(size=(STEPS, TARGETS, 2))}


def _moved(density: list[float], seconds: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrix and covariance of a constant velocity over a step."""
    motion = constant_velocity_over(torch.tensor(density, dtype=torch.float64), seconds)
    return motion.matrix, as_noise(motion.noise).covariance()


def _motions() -> tuple[tuple[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]:
    """Calm and wild."""
    return _moved([1e-3, 1e-3], DT), _moved([1.0, 1.0], DT)


def _height() -> LinearMeasurement:
    return LinearMeasurement(torch.eye(1, 2, dtype=torch.float64), 0.01 * torch.eye(1, dtype=torch.float64))


def _start(states: int = 2) -> Gaussian:
    return Gaussian(torch.zeros(states, dtype=torch.float64), torch.eye(states, dtype=torch.float64))


def _peer(dt: float) -> PeerFilter:
    """filterpy's filter of a height and its rate."""
    peer, (matrix, noise) = PeerFilter(2, 1), _moved([0.5], dt)
    peer.F, peer.Q, peer.H, peer.R = matrix.numpy(), noise.numpy(), np.eye(1, 2), 0.01 * np.eye(1)
    return peer


# Irregular times, smoothed


def irregular_ours(data: Data) -> np.ndarray:
    """The time step is an input."""
    motion, bayes = constant_velocity(torch.tensor([0.5], dtype=torch.float64)), UnscentedKalmanFilter()
    values, steps = (torch.from_numpy(each)[:, None] for each in (data["values"], np.diff(data["times"])))
    return bayes.smooth(bayes.filter(_start(), motion, _height(), values, [steps])).mean[:, 0].numpy()


def irregular_filterpy(data: Data) -> np.ndarray:
    """Matrices are set at each step and kept for the smoother."""
    peer = _peer(0.1)
    kept: list[tuple[np.ndarray, ...]] = []
    for value, step in zip(data["values"], np.diff(data["times"], prepend=data["times"][0]), strict=True):
        if kept:
            at = _peer(step)
            peer.F, peer.Q = at.F, at.Q
            peer.predict()
        peer.update(value)
        kept.append((peer.x.copy(), peer.P.copy(), peer.F, peer.Q))
    means, covariances, matrices, noises = (np.array(each) for each in zip(*kept, strict=True))
    return np.asarray(peer.rts_smoother(means, covariances, matrices, noises)[0][:, 0, 0])


# A fixed lag of ten steps


def lagged_ours(data: Data) -> np.ndarray:
    """Means of the library's smoother."""
    motion, kalman = constant_velocity_over(torch.tensor([0.5], dtype=torch.float64), 0.1), KalmanFilter()
    track = kalman.filter(_start(), motion, _height(), torch.from_numpy(data["values"])[:, None])
    return kalman.smooth(track, lag=10).mean[:, 0].numpy()


def lagged_filterpy(data: Data) -> np.ndarray:
    """It gives no covariances."""
    peer, like = FixedLagSmoother(2, 1, N=10), _peer(0.1)
    peer.F, peer.Q, peer.H, peer.R = like.F, like.Q, like.H, like.R
    smoothed, _ = peer.smooth_batch(data["values"], N=10)
    return np.asarray(smoothed[:, 0, 0])


# Outliers


def gated_ours(data: Data) -> np.ndarray:
    """A gate of 99.9 %."""
    motion, kalman = constant_velocity_over(torch.tensor([0.5], dtype=torch.float64), 0.1), KalmanFilter()
    values = torch.from_numpy(data["wrong"])[:, None]
    return kalman.filter(_start(), motion, _height(), values, gate=0.999).filtered.mean[:, 0].numpy()


def gated_filterpy(data: Data) -> np.ndarray:
    """The distance is that of an update, which is taken back."""
    peer, means = _peer(0.1), []
    for k, value in enumerate(data["wrong"]):
        if k:
            peer.predict()
        before = peer.x.copy(), peer.P.copy()
        peer.update(value)
        if peer.mahalanobis**2 > 10.83:
            peer.x, peer.P = before
        means.append(peer.x[0, 0])
    return np.array(means)


# Many targets by two interacting motions


def targets_ours(data: Data) -> np.ndarray:
    """All as one batch."""
    turn = torch.tensor([[0.97, 0.03], [0.03, 0.97]], dtype=torch.float64)
    imm = InteractingMultipleModels(KalmanFilter(), [LinearMotion(*each) for each in _motions()], turn)
    see = LinearMeasurement(torch.eye(2, 4, dtype=torch.float64), torch.eye(2, dtype=torch.float64))
    eye = torch.eye(4, dtype=torch.float64).expand(TARGETS, 4, 4)
    mixture, means = imm.start(Gaussian(torch.from_numpy(data["start"]), eye)), []
    for value in torch.from_numpy(data["values"]):
        mixture = imm.update(imm.predict(mixture), see, value)
        means.append(imm.gaussian(mixture).mean[:, :2])
    return torch.stack(means).numpy()


def targets_filterpy(data: Data) -> np.ndarray:
    """One after the other."""
    turn, means = np.array([[0.97, 0.03], [0.03, 0.97]]), np.zeros((STEPS, TARGETS, 2))
    for target in range(TARGETS):
        peers = []
        for matrix, noise in _motions():
            peer = PeerFilter(4, 2)
            peer.F, peer.Q, peer.H, peer.R = matrix.numpy(), noise.numpy(), np.eye(2, 4), np.eye(2)
            peer.x = data["start"][target][:, None].copy()
            peers.append(peer)
        imm = IMMEstimator(peers, np.array([0.5, 0.5]), turn)
        for step in range(STEPS):
            imm.predict()
            imm.update(data["values"][step, target][:, None])
            means[step, target] = imm.x[:2, 0]
    return means


PROBLEMS: dict[str, tuple[Callable[[int], Data], Solve, Solve]] = {
    "irregular times, smoothed": (heights, irregular_ours, irregular_filterpy),
    "fixed lag": (lambda seed: _evenly(heights(seed)), lagged_ours, lagged_filterpy),
    "outliers": (lambda seed: _evenly(heights(seed)), gated_ours, gated_filterpy),
    f"{TARGETS} targets, IMM": (targets, targets_ours, targets_filterpy),
}


def _evenly(data: Data) -> Data:
    """The same noise at even times."""
    truth = np.sin(data["even"])
    moved = {name: data[name] - data["truth"] + truth for name in ("values", "wrong")}
    return {**data, **moved, "truth": truth, "times": data["even"]}


def compare(seed: int = 0) -> list[str]:
    """Rows of the table."""
    rows = []
    for title, (make, ours, peer) in PROBLEMS.items():
        data, cells = make(seed), []
        for solve in (ours, peer):
            solve(data)
            begun = time.process_time()
            found = solve(data)
            seconds = time.process_time() - begun
            lines = len(inspect.getsource(solve).splitlines()) - 2
            error = np.sqrt(np.mean((found - data["truth"]) ** 2))
            cells.append(f"{lines} | {seconds:.3f} | {error:.4f}")
        rows.append(f"| {title} | {' | '.join(cells)} |")
    return rows


if __name__ == "__main__":
    print("\n".join(compare()))
