"""Random numbers, beliefs and models that the tests of the filters share; no randomness but from a seed."""

from __future__ import annotations

import torch
from torch import Tensor

from sigmaslam_filters import BlockDiagonal, Dense, Diagonal, Gaussian, MeasurementModel, MotionModel
from sigmaslam_filters.core.noise_covariance import Noise


def random_numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def tensor(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def covariances(*shape: int, seed: int = 0, scale: float = 1.0) -> Tensor:
    """Correlated covariances (..., n, n), well conditioned."""
    root = random_numbers(*shape, shape[-1], seed=seed) / shape[-1] ** 0.5
    return scale * (root @ root.mT + 0.2 * torch.eye(shape[-1], dtype=torch.float64))


def beliefs(*shape: int, seed: int = 0, scale: float = 1.0) -> Gaussian:
    """Correlated beliefs of batch shape[:-1] in R^n."""
    return Gaussian(random_numbers(*shape, seed=seed), covariances(*shape, seed=seed + 1, scale=scale))


def bent_motion(size: int, seed: int = 0, scale: float = 0.1) -> MotionModel:
    """x' = A x + 0.2 sin(B x) + w with a correlated Q."""
    A = torch.eye(size, dtype=torch.float64) + 0.2 * random_numbers(size, size, seed=seed)
    B = random_numbers(size, size, seed=seed + 1)
    return MotionModel(lambda x: _bent(x, A, B), covariances(size, seed=seed + 2, scale=scale))


def bent_measurement(
    size: int, measurements: int, noise: Noise | Tensor | None = None, seed: int = 0
) -> MeasurementModel:
    """z = H x + 0.2 sin(B x) + v with a correlated R unless the noise is given."""
    H, B = (random_numbers(measurements, size, seed=seed + k) for k in range(2))
    given = covariances(measurements, seed=seed + 2, scale=0.1) if noise is None else noise
    return MeasurementModel(lambda x: _bent(x, H, B), given)


def _bent(x: Tensor, A: Tensor, B: Tensor) -> Tensor:
    A, B = A.to(x), B.to(x)
    return x @ A.mT + 0.2 * torch.sin(x @ B.mT)


def noises(measurements: int, seed: int = 0) -> dict[str, Noise]:
    """One noise of each kind for an even number of measurements, correlated where the kind can be."""
    return {
        "diagonal": Diagonal(0.05 + random_numbers(measurements, seed=seed).square()),
        "blocks": BlockDiagonal(covariances(measurements // 2, 2, seed=seed, scale=0.3)),
        "dense": Dense(covariances(measurements, seed=seed, scale=0.3)),
    }
