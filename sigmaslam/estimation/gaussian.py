"""Gaussians of a state as arrays: square roots, regression, and parts that are copied."""

import numpy as np

# Standard deviation of a normal distribution over the median of its absolute values.
_SIGMA_PER_MEDIAN = 1.4826


def robust_sigma(residual: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Standard deviation of residuals about zero, of which less than half may be wrong; NaN is left out."""
    return np.asarray(_SIGMA_PER_MEDIAN * np.nanmedian(np.abs(residual), axis=axis))


def matrix_root(covariance: np.ndarray) -> np.ndarray:
    """A with A A^T = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def project_covariance(slope: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance that slopes (M, 3, n) make of a covariance."""
    return np.asarray(slope @ covariance @ slope.transpose(0, 2, 1))


def append_moved(factor: np.ndarray, part: slice, step_covariance: np.ndarray) -> np.ndarray:
    """Factor of a state with one part (6) of it once more behind the rest, moved by an independent step."""
    size, columns = factor.shape
    grown = np.zeros((size + 6, columns + 6))
    grown[:size, :columns] = factor
    grown[size:, :columns] = factor[part]
    grown[size:, columns:] = matrix_root(step_covariance)
    return grown


def renew_part(covariance: np.ndarray, part: slice, renewal: np.ndarray) -> np.ndarray:
    """The covariance with one part of the state replaced by an independent one of covariance `renewal`."""
    renewed = covariance.copy()
    renewed[part, :] = renewed[:, part] = 0.0
    renewed[part, part] = renewal
    return renewed


def replace_part(covariance: np.ndarray, part: slice, other: slice) -> np.ndarray:
    """The covariance as if one part of the state were the same as another of its size."""
    replaced = covariance.copy()
    replaced[part, :], replaced[:, part] = replaced[other, :], replaced[:, other]
    replaced[part, part] = replaced[other, other]
    return replaced


def step_with(covariance: np.ndarray, part: slice, index: int, change: float) -> np.ndarray:
    """By how much a part of a state moves when one of its numbers is known to be another; not where it is known."""
    variance = covariance[index, index]
    if variance <= 0.0:
        return np.zeros_like(covariance[part, index])
    return np.asarray(covariance[part, index] / variance * change)


def at_most(covariance: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """The covariance (n, n), cut in the directions in which it is larger than another one, which is regular."""
    root = np.linalg.cholesky(limit)
    values, vectors = np.linalg.eigh(np.linalg.solve(root, np.linalg.solve(root, covariance).T))
    cut = root @ vectors
    return np.asarray((cut * np.minimum(values, 1.0)) @ cut.T)


def regression(cross: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """cross covariance^-1 (n, k), with the pseudo-inverse in units of the standard deviations where it is singular."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    sigma = np.where(sigma > 0.0, sigma, 1.0)
    correlation = covariance / np.outer(sigma, sigma)
    return np.asarray((cross / sigma) @ np.linalg.pinv(correlation, rcond=1e-12, hermitian=True) / sigma)
