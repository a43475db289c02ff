"""Quantiles of chi-square, and the squared errors that are held against them."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

# 99.9 % of squared errors of a pose (6 degrees of freedom) are below: "three sigma".
WITHIN_3_SIGMA = float(chi2.ppf(0.999, 6))


def squared_sigmas(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (...,) of errors (..., n) by their covariances (..., n, n)."""
    whitened = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.einsum("...i,...i->...", errors, whitened))


def chi_square_quantile(probability: float, freedom: int) -> float:
    """Of the sum of `freedom` squared standard normal numbers."""
    return float(chi2.ppf(probability, freedom))


def chi_square_median(freedom: int) -> float:
    """Of the sum of `freedom` squared standard normal numbers."""
    return chi_square_quantile(0.5, freedom)
