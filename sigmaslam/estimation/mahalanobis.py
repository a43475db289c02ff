"""Squared Mahalanobis distance: the one formula behind gates, NEES and shares inside an ellipse."""

from __future__ import annotations

import numpy as np


def squared_mahalanobis(residual: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(...,) squared Mahalanobis lengths of residuals (..., n) under covariances (..., n, n)."""
    return np.asarray(np.einsum("...i,...i->...", residual, np.linalg.solve(covariance, residual[..., None])[..., 0]))
