"""What a function makes of uncertainty: means and covariances to first and second order (9.35), (9.36)."""

from collections.abc import Callable
from typing import Literal

import numpy as np

# Differences are taken over this many standard deviations, so that they are as exact as the propagation needs them.
_STEP = 1e-3


def propagate(
    function: Callable[[np.ndarray], np.ndarray], mean: np.ndarray, covariance: np.ndarray, order: Literal[1, 2] = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of a function of Gaussians.

    First order is J P J^T (9.35). Second order adds what the second derivatives H make of a Gaussian: half the trace of
    H_a P to the mean, half the trace of H_a P H_b P to the covariance. Derivatives are central differences along the
    columns of a root of the covariance.

    Args:
        function: of (..., n), gives (..., m); it is called once with many more leading dimensions.
        mean, covariance: (..., n), (..., n, n); one covariance serves all.
        order: 1 or 2.
    Returns:
        (..., m) and (..., m, m).
    """
    covariance = np.broadcast_to(covariance, (*mean.shape, mean.shape[-1]))
    values, vectors = np.linalg.eigh(covariance)
    columns = np.moveaxis(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :], -1, 0) * _STEP
    middle = function(mean)
    plus, minus = function(mean + columns), function(mean - columns)
    slopes = (plus - minus) / (2.0 * _STEP)  # (n, ..., m)
    spread = np.einsum("i...a,i...b->...ab", slopes, slopes)
    if order == 1:
        return np.asarray(middle), np.asarray(spread)
    bend = (plus + minus - 2.0 * middle) / _STEP**2
    count = len(columns)
    spread = spread + 0.5 * np.einsum("i...a,i...b->...ab", bend, bend)
    rows, others = np.triu_indices(count, 1)
    if len(rows):
        # f(x + a + b) - f(x + a) - f(x + b) + f(x), averaged with its mirror image.
        both = columns[rows] + columns[others]
        mixed = function(mean + both) + function(mean - both) + 2.0 * middle
        mixed = (mixed - plus[rows] - plus[others] - minus[rows] - minus[others]) / (2.0 * _STEP**2)
        spread = spread + np.einsum("i...a,i...b->...ab", mixed, mixed)
    return np.asarray(middle + 0.5 * bend.sum(axis=0)), np.asarray(spread)
