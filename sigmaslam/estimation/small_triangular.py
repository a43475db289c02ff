"""Batches of small triangular systems by substitution: faster than a LAPACK call for each matrix."""

from __future__ import annotations

import numpy as np


def solve_lower(lower: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions (M, k, n) of lower (M, k, k) x = right (M, k, n), lower triangular with a diagonal that is not zero."""
    solution = np.empty(right.shape)
    for i in range(lower.shape[1]):
        row = right[:, i]
        for j in range(i):
            row = row - lower[:, i, j, None] * solution[:, j]
        solution[:, i] = row / lower[:, i, i, None]
    return solution
