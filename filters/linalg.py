"""Small dense linear algebra unrolled over columns.

torch.linalg has no ONNX counterpart, and for matrices of this size a fixed sequence of vector operations is as fast.
All functions take leading batch dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor

# A pivot below this share of its diagonal entry is round-off of an exact zero (a clone is a copy of the pose, a first
# pose is known): its column is dropped. The factor is then that of the semidefinite matrix itself, nothing is added.
_PIVOT_TOLERANCE = 1e-13


def cholesky(matrix: Tensor) -> Tensor:
    """Lower factor L of a symmetric positive semidefinite matrix, L L^T = matrix.

    Args:
        matrix: (..., n, n). Only the lower triangle is read. Rows and columns may be zero or copies of others.
    Returns:
        (..., n, n) lower triangular, with zero columns where a pivot vanishes.
    """
    size = matrix.shape[-1]
    rest = matrix
    columns = []
    share = _PIVOT_TOLERANCE if matrix.dtype == torch.float64 else 2e-6
    tolerance = torch.tensor(share, dtype=matrix.dtype, device=matrix.device)
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    below = torch.ones(size, size, dtype=matrix.dtype, device=matrix.device).tril()
    for j in range(size):
        pivot = rest[..., j, j]
        kept = pivot > tolerance * diagonal[..., j]
        scale = torch.where(
            kept, torch.rsqrt(torch.where(kept, pivot, torch.ones_like(pivot))), torch.zeros_like(pivot)
        )
        column = rest[..., :, j] * below[:, j] * scale.unsqueeze(-1)
        columns.append(column)
        if j + 1 < size:
            rest = rest - column.unsqueeze(-1) * column.unsqueeze(-2)
    return torch.stack(columns, dim=-1)


def inverse_and_log_determinant(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Inverse by Gauss-Jordan without pivoting, stable for I + (positive semidefinite).

    Args:
        matrix: (..., n, n) symmetric positive definite.
    Returns:
        (..., n, n) inverse and (...,) log-determinant.
    """
    size = matrix.shape[-1]
    work = matrix
    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    logs = []
    for j in range(size):
        pivot = work[..., j, j]
        logs.append(torch.log(pivot))
        # One rank-one update sweeps row, column and pivot at once: (j, j) becomes 1/p, row j is divided by p, column j
        # by -p, and the rest loses column times row over p. Row and column are cleared first: adding to and taking
        # from the pivot itself would cancel the digits of a small inverse.
        unit = identity[j]
        others = 1.0 - unit
        column = work[..., :, j] * others - unit
        row = (work[..., j, :] * others + unit) / pivot.unsqueeze(-1)
        work = work * (others.unsqueeze(-1) * others) - column.unsqueeze(-1) * row.unsqueeze(-2)
    return work, torch.stack(logs, dim=-1).sum(dim=-1)


def invert_lower(factor: Tensor) -> Tensor:
    """Inverse of a lower triangular matrix with a positive diagonal, (..., n, n)."""
    size = factor.shape[-1]
    identity = torch.eye(size, dtype=factor.dtype, device=factor.device)
    rows: list[Tensor] = []
    for j in range(size):
        known = identity[j].expand(*factor.shape[:-2], size)
        if j > 0:
            solved = torch.stack(rows, dim=-2)
            known = known - (factor[..., j, :j].unsqueeze(-2) @ solved).squeeze(-2)
        rows.append(known / factor[..., j, j].unsqueeze(-1))
    return torch.stack(rows, dim=-2)
