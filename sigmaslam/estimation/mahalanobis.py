"""Squared Mahalanobis distance: the one formula behind gates, NEES and shares inside an ellipse."""

import numpy as np


def squared_mahalanobis(residual: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(...,) squared Mahalanobis lengths of residuals (..., n) under covariances (..., n, n)."""
    return np.asarray(np.einsum("...i,...i->...", residual, np.linalg.solve(covariance, residual[..., None])[..., 0]))


def quantiles(values: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """`np.quantile` to the bit of numbers (K,) that are all finite; that takes ten times longer for a few hundred."""
    ranked, place = np.sort(values), shares * (len(values) - 1.0)
    rank = place.astype(int)
    low, high, between = ranked[rank], ranked[np.minimum(rank + 1, len(values) - 1)], place - rank
    return np.where(between < 0.5, low + (high - low) * between, high - (high - low) * (1.0 - between))
