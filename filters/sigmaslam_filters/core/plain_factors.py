"""Factorisations in plain arithmetic, a few vector operations a column: what a graph without LAPACK is made of.

ONNX has no linear algebra beyond products. For matrices of up to about 64 rows a fixed sequence of operations, whose
length is the number of rows, does as well, for any batch.
"""

from collections.abc import Callable

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
    tolerance = torch.tensor(PIVOT_TOLERANCES[matrix.dtype], dtype=matrix.dtype, device=matrix.device)
    diagonal = torch.diagonal(matrix, dim1=-2, dim2=-1)
    magnitude = diagonal.abs()
    healthy = torch.ones_like(diagonal[..., 0], dtype=torch.bool)

    def scaled(j: int, pivot: Tensor, below: Tensor | None) -> tuple[Tensor, Tensor | None]:
        nonlocal healthy
        length = pivot[..., 0, 0]
        kept = length > tolerance * diagonal[..., j]
        vanishes = length >= -tolerance * magnitude[..., j]
        if below is not None:
            # What a dropped pivot leaves below it must vanish too, else the matrix is indefinite.
            allowed = tolerance * magnitude[..., j + 1 :] * magnitude[..., j : j + 1]
            vanishes = vanishes & (below[..., 0] * below[..., 0] <= allowed).all(dim=-1)
        healthy = healthy & (kept | vanishes)
        scale = torch.where(
            kept, torch.rsqrt(torch.where(kept, length, torch.ones_like(length))), torch.zeros_like(length)
        )
        scale = scale[..., None, None]
        return pivot * scale, None if below is None else below * scale

    return _by_columns(matrix, scaled), healthy


def definite_cholesky(matrix: Tensor) -> Tensor:
    """Lower factor (..., n, n) of positive definite matrices, in fewer operations: nothing is checked."""

    def scaled(j: int, pivot: Tensor, below: Tensor | None) -> tuple[Tensor, Tensor | None]:
        root = torch.sqrt(pivot)
        return root, None if below is None else below / root

    return _by_columns(matrix, scaled)


def invert(matrix: Tensor) -> Tensor:
    """Inverses of positive definite matrices (..., n, n), symmetric; ONNX Runtime has an operator for them."""
    # With a diagonal of one, rounding errors are those of a Cholesky factorisation.
    root = torch.rsqrt(torch.diagonal(matrix, dim1=-2, dim2=-1))
    scale = root.unsqueeze(-1) * root.unsqueeze(-2)
    inverse = torch.linalg.inv_ex(matrix * scale).inverse * scale
    return (inverse + inverse.mT) / 2.0


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


def _by_columns(matrix: Tensor, scaled: Callable[[int, Tensor, Tensor | None], tuple[Tensor, Tensor | None]]) -> Tensor:
    """Lower factor (..., n, n), column by column.

    Args:
        matrix: (..., n, n); the lower triangle is read.
        scaled: makes of the number of a column, its pivot (..., 1, 1) and what is below it (..., c, 1), None in the
            last, the same of the factor.
    """
    size = matrix.shape[-1]
    columns, remainder = [], matrix
    for j in range(size - 1):
        first, others = remainder.split([1, size - j - 1], dim=-1)
        root, below = scaled(j, *first.split([1, size - j - 1], dim=-2))
        assert below is not None
        columns.append(torch.nn.functional.pad(torch.cat([root, below], dim=-2), (0, 0, j, 0)))
        remainder = others[..., 1:, :] - below @ below.mT
    root, _ = scaled(size - 1, remainder, None)
    columns.append(torch.nn.functional.pad(root, (0, 0, size - 1, 0)))
    return torch.cat(columns, dim=-1)
