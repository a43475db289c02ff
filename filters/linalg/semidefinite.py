"""Cholesky's factor unrolled over columns.

torch.linalg has no ONNX counterpart, and for matrices of this size a fixed sequence of vector operations is as fast.
"""

from __future__ import annotations

import torch
from torch import Tensor

PIVOT_TOLERANCES = {torch.float64: 1e-13, torch.float32: 2e-6}
"""A pivot below this share of its diagonal entry is round-off of an exact zero: a clone is a copy of a pose, a first
pose is known. Its column is dropped. The factor is then that of the semidefinite matrix itself, nothing is added."""


def cholesky(matrix: Tensor) -> Tensor:
    """Lower factor L of a symmetric positive semidefinite matrix, L L^T = matrix.

    Args:
        matrix: (..., n, n). Only the lower triangle is read. Rows and columns may be zero or copies of others.
    Returns:
        (..., n, n) lower triangular, with zero columns where a pivot vanishes.
    """
    size = matrix.shape[-1]
    remainder = matrix
    columns = []
    tolerance = torch.tensor(PIVOT_TOLERANCES[matrix.dtype], dtype=matrix.dtype, device=matrix.device)
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    below = torch.ones(size, size, dtype=matrix.dtype, device=matrix.device).tril()
    for j in range(size):
        pivot = remainder[..., j, j]
        kept = pivot > tolerance * diagonal[..., j]
        scale = torch.where(
            kept, torch.rsqrt(torch.where(kept, pivot, torch.ones_like(pivot))), torch.zeros_like(pivot)
        )
        column = remainder[..., :, j] * below[:, j] * scale.unsqueeze(-1)
        columns.append(column)
        if j + 1 < size:
            remainder = remainder - column.unsqueeze(-1) * column.unsqueeze(-2)
    return torch.stack(columns, dim=-1)
