"""Residuals of (u, v, disparity) in units of their noise, with weights for tails longer than a Gaussian's."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.estimation.small_triangular import solve_lower

# A disparity that is not there: its variance, pixels squared.
UNKNOWN_VARIANCE = 1e12
# Errors of right matches have longer tails than a Gaussian's: degrees of freedom of the Student-t that is fitted.
# 4 and 1 are no better on rendered streets.
STUDENT_FREEDOM = 2.0
# What so many agree on is no matter of a few outliers.
_NEARLY_ALL = 0.95
# Right matches are not worse than three times the standard deviation that they claim, all together.
_MAX_SCALE = 9.0


def mask_missing(residual: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, 3) without the disparities that are not there, and covariances to match."""
    missing = ~np.isfinite(residual[:, 2])
    residual = np.where(np.isfinite(residual), residual, 0.0)
    noise = noise.copy()
    noise[missing, 2, :] = 0.0
    noise[missing, :, 2] = 0.0
    noise[missing, 2, 2] = UNKNOWN_VARIANCE
    return residual, noise


def common_scale(squared: np.ndarray, components: np.ndarray) -> float:
    """Factor, 1 or more, by which all variances together are too small: of a blurred image, say.

    The median tells how far the residuals scatter before any gate. It is believed where nearly all agree once their
    variances are scaled by it; where they do not, the errors are those of a part: outliers among good matches. Where
    it is large nothing fits.

    Args:
        squared: (M,) squared lengths of whitened residuals.
        components: (M,) how many numbers each residual has.
    """
    if not len(squared):
        return 1.0
    ratio = squared / CHI_SQUARE_MEDIAN[components]
    # Half of them are expected above 1; by chance no more than three standard deviations of that count besides.
    if (ratio > 1.0).sum() <= 0.5 * len(ratio) + 1.5 * np.sqrt(len(ratio)):
        return 1.0
    factor = float(np.median(ratio))
    agreeing = float((squared <= factor * CHI_SQUARE_999[components]).mean())
    return factor if factor <= _MAX_SCALE and agreeing >= _NEARLY_ALL else 1.0


def whiten(stacked: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Rows (3 M, k) of stacked (M, 3, k) in units of the noise (M, 3, 3)."""
    return np.asarray(solve_lower(np.linalg.cholesky(noise), stacked).reshape(-1, stacked.shape[2]))


def student_weight(squared: np.ndarray, components: np.ndarray, freedom: float = STUDENT_FREEDOM) -> np.ndarray:
    """Weights (M,) that make least squares the fit of a Student-t, from squared lengths of whitened residuals.

    The weighted information of such a fit is more than the estimate's precision, (nu + p + 2) / (nu + p) times as much
    where errors are Student-t: the weights are that much smaller, which hardly moves the estimate.
    """
    whole = freedom + components
    return whole**2 / ((whole + 2.0) * (freedom + squared))
