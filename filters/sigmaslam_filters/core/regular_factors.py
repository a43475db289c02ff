"""Factors and inverses of positive definite matrices, which export to ONNX in few operators.

`torch.linalg.inv_ex` becomes ONNX Runtime's own operator `Inverse`; a Cholesky factor has no operator, and is unrolled
over its columns.
"""

from __future__ import annotations

import torch
from torch import Tensor


def cholesky(matrix: Tensor) -> Tensor:
    """Lower factor L (..., n, n) of positive definite matrices (..., n, n), L L^T = matrix."""
    size = matrix.shape[-1]
    columns, remainder = [], matrix
    for j in range(size - 1):
        first, others = remainder.split([1, size - j - 1], dim=-1)
        pivot, below = first.split([1, size - j - 1], dim=-2)
        root = torch.sqrt(pivot)
        below = below / root
        columns.append(torch.nn.functional.pad(torch.cat([root, below], dim=-2), (0, 0, j, 0)))
        remainder = others[..., 1:, :] - below @ below.mT
    columns.append(torch.nn.functional.pad(torch.sqrt(remainder), (0, 0, size - 1, 0)))
    return torch.cat(columns, dim=-1)


def whiten(stacked: Tensor, noise: Tensor) -> Tensor:
    """L^-1 stacked (..., n, k), for the lower factor L of the noise (..., n, n): n is small."""
    size = noise.shape[-1]
    entries = noise.flatten(-2).unsqueeze(-1).split(1, dim=-2)
    lower: list[list[Tensor]] = []
    rows: list[Tensor] = []
    for i, row in enumerate(stacked.split(1, dim=-2)):
        known: list[Tensor] = []
        for j in range(i + 1):
            entry = entries[size * i + j]
            for left, above in zip(known, lower[j] if j < i else known, strict=False):
                entry = entry - left * above
            known.append(entry / lower[j][j] if j < i else torch.sqrt(entry))
        lower.append(known)
        for left, above in zip(known, rows, strict=False):
            row = row - left * above
        rows.append(row / known[i])
    return torch.cat(rows, dim=-2)


def invert(matrix: Tensor) -> Tensor:
    """Inverses of positive definite matrices (..., n, n), symmetric."""
    # With a diagonal of one, rounding errors are those of a Cholesky factorisation.
    root = torch.rsqrt(torch.diagonal(matrix, dim1=-2, dim2=-1))
    scale = root.unsqueeze(-1) * root.unsqueeze(-2)
    inverse = torch.linalg.inv_ex(matrix * scale).inverse * scale
    return (inverse + inverse.mT) / 2.0
