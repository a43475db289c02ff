"""Factorisations in plain arithmetic, a few vector operations a column: what a graph without LAPACK is made of.

ONNX has no linear algebra beyond products. For matrices of up to about 64 rows a fixed sequence of operations, whose
length is the number of rows, does as well, for any batch.
"""

from __future__ import annotations

import torch
from torch import Tensor

PIVOT_TOLERANCES = {torch.float64: 1e-13, torch.float32: 2e-6}
"""A pivot below this share of its diagonal entry is round-off of an exact zero: a clone is a copy of a pose, a first
pose is known. Its column is dropped. The factor is then that of the semidefinite matrix itself, nothing is added."""


class _Exporting:
    """Whether a graph is being traced; `traced_for_export` sets it."""

    active = False


class traced_for_export:  # noqa: N801 - a context, used like a function
    """Within it the linear algebra of the filters is plain arithmetic, as in `torch.export`."""

    def __enter__(self) -> None:
        self._before = _Exporting.active
        _Exporting.active = True

    def __exit__(self, *exception: object) -> None:
        _Exporting.active = self._before


def is_exporting() -> bool:
    """Whether a graph is traced that LAPACK will not be part of."""
    return _Exporting.active or torch.compiler.is_exporting()


def cholesky(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Lower factor L of a symmetric positive semidefinite matrix, L L^T = matrix.

    Args:
        matrix: (..., n, n). Only the lower triangle is read. Rows and columns may be zero or copies of others.
    Returns:
        (..., n, n) lower triangular, with zero columns where a pivot vanishes; (...,) bool, whether the matrix is
        positive semidefinite.
    """
    size = matrix.shape[-1]
    remainder = matrix
    columns = []
    tolerance = torch.tensor(PIVOT_TOLERANCES[matrix.dtype], dtype=matrix.dtype, device=matrix.device)
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    below = torch.ones(size, size, dtype=matrix.dtype, device=matrix.device).tril()
    healthy = torch.ones_like(diagonal[..., 0], dtype=torch.bool)
    for j in range(size):
        pivot = remainder[..., j, j]
        kept = pivot > tolerance * diagonal[..., j]
        scale = torch.where(
            kept, torch.rsqrt(torch.where(kept, pivot, torch.ones_like(pivot))), torch.zeros_like(pivot)
        )
        # What a dropped pivot leaves below it must vanish too, else the matrix is indefinite.
        magnitude = diagonal.abs()
        left = remainder[..., :, j] * below[:, j]
        allowed = tolerance * magnitude * magnitude[..., j : j + 1]
        vanishes = (pivot >= -tolerance * magnitude[..., j]) & (left * left <= allowed).all(dim=-1)
        healthy = healthy & (kept | vanishes)
        column = remainder[..., :, j] * below[:, j] * scale.unsqueeze(-1)
        columns.append(column)
        if j + 1 < size:
            remainder = remainder - column.unsqueeze(-1) * column.unsqueeze(-2)
    return torch.stack(columns, dim=-1), healthy


def triangularise(matrix: Tensor) -> Tensor:
    """Lower factor L of A A^T by modified Gram-Schmidt on the rows of A (..., n, c); its diagonal is not negative."""
    size = matrix.shape[-2]
    below = torch.ones(size, size, dtype=matrix.dtype, device=matrix.device).tril()
    columns = []
    remainder = matrix
    for j in range(size):
        row = remainder[..., j : j + 1, :]
        squared = (row * row).sum(dim=-1, keepdim=True)
        zero = squared == 0
        inverse = torch.rsqrt(torch.where(zero, torch.ones_like(squared), squared))
        unit = row * inverse
        column = (remainder * unit).sum(dim=-1)
        columns.append(column * below[:, j])
        if j + 1 < size:
            remainder = remainder - column.unsqueeze(-1) * unit
    return torch.stack(columns, dim=-1)


def solve_lower(factor: Tensor, right: Tensor, regular: bool) -> Tensor:
    """L^-1 B for (..., n, n) and (..., n, c); rows of zero pivots give zero, or if `regular`, no number."""
    rows = []
    remainder = right
    for j in range(factor.shape[-1]):
        pivot = factor[..., j : j + 1, j : j + 1]
        row = remainder[..., j : j + 1, :] / pivot if regular else remainder[..., j : j + 1, :] * _reciprocal(pivot)
        rows.append(row)
        remainder = remainder - factor[..., :, j : j + 1] * row
    return torch.cat(torch.broadcast_tensors(*rows), dim=-2)


def solve_lower_transposed(factor: Tensor, right: Tensor) -> Tensor:
    """L^-T B for (..., n, n) and (..., n, c); rows of zero pivots give zero."""
    rows = []
    remainder = right
    for j in reversed(range(factor.shape[-1])):
        row = remainder[..., j : j + 1, :] * _reciprocal(factor[..., j : j + 1, j : j + 1])
        rows.append(row)
        remainder = remainder - factor[..., j, :].unsqueeze(-1) * row
    return torch.cat(torch.broadcast_tensors(*rows[::-1]), dim=-2)


def _reciprocal(pivot: Tensor) -> Tensor:
    """1 / pivot, and 0 for a pivot that is exactly 0."""
    zero = pivot == 0
    return torch.where(zero, torch.zeros_like(pivot), 1.0 / torch.where(zero, torch.ones_like(pivot), pivot))
