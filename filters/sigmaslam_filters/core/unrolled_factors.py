"""Factorisations of small matrices, unrolled: one vector operation over the whole batch for each entry or row.

LAPACK takes a batch one matrix at a time and spends microseconds on each; for matrices up to `ROWS` and batches from
`BATCH` on, plain arithmetic over the batch is many times faster, the more so when torch.compile fuses it.
Shapes are (..., rows, columns) as everywhere, but the memory of what is made here is batch-last: a slice `[..., i, j]`
is contiguous.
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sigmaslam_filters.core.plain_factors import is_exporting

ROWS = 8
BATCH = 128
# With more columns than this the unrolled program would be too long.
COLUMNS = 32


def is_small(matrix: Tensor, columns: int = 0) -> bool:
    """Whether (..., rows, columns) is worth unrolling: few rows, and many of them (or compiled)."""
    if is_exporting() or matrix.shape[-2] > ROWS or max(columns, matrix.shape[-1]) > COLUMNS:
        return False
    return torch.compiler.is_compiling() or math.prod(matrix.shape[:-2]) >= BATCH


def assemble(rows: Sequence[Tensor]) -> Tensor:
    """Rows (..., c) into a matrix (..., len(rows), c) with batch-last memory."""
    return torch.stack([row.movedim(-1, 0) for row in rows], dim=0).movedim((0, 1), (-2, -1))


def join(matrices: Sequence[Tensor]) -> Tensor:
    """Matrices (..., r, c_i) side by side, (..., r, sum c_i), with batch-last memory."""
    first = [matrix.movedim((-2, -1), (0, 1)) for matrix in matrices]
    return torch.cat(first, dim=1).movedim((0, 1), (-2, -1))


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Product of (..., r, k) and (..., k, c), a sum of outer products."""
    # Rows and columns first: what is computed then has the batch last in memory, whatever the arguments have.
    batch = torch.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    a = left.expand(*batch, *left.shape[-2:]).movedim((-2, -1), (0, 1))
    b = right.expand(*batch, *right.shape[-2:]).movedim((-2, -1), (0, 1))
    total = a[:, 0, None] * b[None, 0]
    for k in range(1, left.shape[-1]):
        total = total + a[:, k, None] * b[None, k]
    return total.movedim((0, 1), (-2, -1))


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix (..., r, k) times vector (..., k), column by column."""
    return multiply(matrix, vector.unsqueeze(-1))[..., 0]


def cholesky(matrix: Tensor, tolerance: float) -> tuple[Tensor, Tensor]:
    """Lower factor of positive semidefinite matrices.

    Args:
        matrix: (..., n, n); the lower triangle is read.
        tolerance: a pivot below this share of its diagonal entry is an exact zero: its column is dropped.
    Returns:
        (..., n, n) factor, and (...,) whether the matrix is positive semidefinite and finite.
    """
    size = matrix.shape[-1]
    healthy = torch.ones_like(matrix[..., 0, 0], dtype=torch.bool)

    def scaled(j: int, column: list[Tensor]) -> list[Tensor]:
        nonlocal healthy
        pivot = column[0]
        floor = tolerance * matrix[..., j, j].abs()
        kept = pivot > floor
        healthy = healthy & (pivot >= -floor)  # False for NaN as well
        dropped = ~kept
        inverse = torch.rsqrt(pivot.masked_fill(dropped, 1.0)).masked_fill(dropped, 0.0)
        for i, entry in enumerate(column[1:], start=j + 1):
            # What a dropped pivot leaves below it must vanish too, else the matrix is indefinite.
            allowed = tolerance * (matrix[..., i, i] * matrix[..., j, j]).abs()
            healthy = healthy & (kept | (entry * entry <= allowed))
        return [entry * inverse for entry in column]

    entries = [[matrix[..., i, j] for j in range(i + 1)] for i in range(size)]
    return _from_lower(_factored(entries, scaled)), healthy


def whiten(stacked: Tensor, noise: Tensor) -> Tensor:
    """L^-1 stacked (..., n, k), for the lower factor L of positive definite noise (..., n, n); nothing is checked."""
    size = noise.shape[-1]
    entries = noise.flatten(-2).unsqueeze(-1).split(1, dim=-2)

    def scaled(j: int, column: list[Tensor]) -> list[Tensor]:
        root = torch.sqrt(column[0])
        return [root, *(entry / root for entry in column[1:])]

    lower = _factored([[entries[size * i + j] for j in range(i + 1)] for i in range(size)], scaled)
    return torch.cat(_substituted(lower, list(stacked.split(1, dim=-2)), regular=True), dim=-2)


def triangularise(pieces: Sequence[Tensor], diagonal: Tensor | None) -> Tensor:
    """Lower factor L of A A^T for A = [pieces side by side, diag(diagonal)], without forming A A^T.

    Args:
        pieces: (..., n, c_i) each.
        diagonal: (..., n), or None.
    Returns:
        (..., n, n) lower triangular with a non-negative diagonal.
    """
    rows: list[_Row] = [[] for _ in range(pieces[0].shape[-2])]
    for piece in pieces:
        for row, parts in zip(rows, _parts(piece), strict=True):
            row.extend(parts)
    if diagonal is not None:
        for i, row in enumerate(rows):
            row.extend(diagonal[..., i : i + 1] if k == i else None for k in range(len(rows)))
    return _from_lower(_orthogonalise(rows))


def stacked_update(white: Tensor, size: int, prior: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Posterior from the triangular factor of the stacked system [W, e; I, 0], see `sigmaslam_filters.core.solve`.

    The same as triangularising [W^T, I] with one more row, but no intermediate matrix is assembled, so that
    torch.compile makes one loop of it.

    Args:
        white: (..., m, k + 1) white deviations, the last `size` of k odd, and the white innovation.
        size: n.
        prior: (..., n, n) lower root of the prior covariance.
    Returns:
        mean of zeta (..., n), lower root of the posterior covariance (..., n, n), lower root of zeta's information
        (..., n, n), sqrt(1 + NIS) (...,), and the pivots (..., k), whose squares have the product |I + W W^T|.
    """
    count = white.shape[-1] - 1
    one = torch.ones_like(white[..., 0, :1])
    rows: list[_Row] = [
        [*parts, *(one if k == i else None for k in range(count + 1))] for i, parts in enumerate(_parts(white.mT))
    ]
    triangle = _orthogonalise(rows)
    first = count - size
    root = [row[first:] for row in triangle[first:count]]
    projected = triangle[count]
    mean: list[Tensor] = projected[first:count]
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            mean[i] = mean[i] - root[k][i] * mean[k]
        mean[i] = mean[i] / root[i][i]
    # Columns of L G^-T; its rows are then made triangular.
    columns: list[Tensor] = []
    for j in range(size):
        column = prior[..., :, j]
        for k in range(j):
            column = column - columns[k] * root[j][k].unsqueeze(-1)
        columns.append(column / root[j][j].unsqueeze(-1))
    if torch.compiler.is_compiling():
        spread: list[_Row] = [[column[..., i : i + 1] for column in columns] for i in range(size)]
    else:
        spread = _parts(assemble(columns).mT)
    pivots = torch.stack([triangle[j][j] for j in range(count)], dim=0).movedim(0, -1)
    zeta = torch.stack(mean, dim=0).movedim(0, -1)
    return zeta, _from_lower(_orthogonalise(spread)), _from_lower(root), projected[count], pivots


def solve_lower(factor: Tensor, right: Tensor, regular: bool) -> Tensor:
    """L^-1 B by forward substitution; rows of zero pivots give zero, or if the factor should be regular, no number.

    Args:
        factor: (..., n, n) lower triangular.
        right: (..., n, c).
    """
    size = range(factor.shape[-1])
    lower = [[factor[..., i, k, None] for k in range(i + 1)] for i in size]
    return assemble(_substituted(lower, [right[..., i, :] for i in size], regular))


def solve_lower_transposed(factor: Tensor, right: Tensor) -> Tensor:
    """L^-T B by backward substitution; rows of zero pivots give zero. Shapes as `solve_lower`."""
    size = factor.shape[-1]
    rows: list[Tensor] = [right[..., i, :] for i in range(size)]
    for i in reversed(range(size)):
        for k in range(i + 1, size):
            rows[i] = rows[i] - factor[..., k, i, None] * rows[k]
        rows[i] = rows[i] * _reciprocal(factor[..., i, i, None])
    return assemble(rows)


def known_lower(factor: Tensor) -> Tensor:
    """A lower triangular (..., n, n); compiled code is told of its zeros, which it need not read."""
    if not torch.compiler.is_compiling() or factor.shape[-1] > ROWS:
        return factor
    return _from_lower([[factor[..., i, j] for j in range(i + 1)] for i in range(factor.shape[-1])])


# A row in parts (..., c_i); None is a part that is known to be zero.
_Row = list[Tensor | None]


def _parts(matrix: Tensor) -> list[_Row]:
    """The rows of (..., r, c), each as one part; as its entries when compiling, so that all of it fuses."""
    rows = range(matrix.shape[-2])
    if torch.compiler.is_compiling():
        return [[matrix[..., i, k : k + 1] for k in range(matrix.shape[-1])] for i in rows]
    return [[matrix[..., i, :]] for i in rows]


def _orthogonalise(rows: list[_Row]) -> list[list[Tensor]]:
    """Lower triangle L of A = L Q by modified Gram-Schmidt on the rows of A.

    As an orthogonal triangularisation its triangular factor is backward stable (Björck 1967), and it is nothing but
    dot products and sums of rows.
    """
    factor: list[list[Tensor]] = [[] for _ in rows]
    rows = list(rows)
    for j, row in enumerate(rows):
        squared = _dot(row, row)
        inverse = _inverse_root(squared)
        factor[j].append(squared * inverse)
        scale = inverse.unsqueeze(-1)
        unit = [None if part is None else part * scale for part in row]
        for i in range(j + 1, len(rows)):
            length = _dot(rows[i], unit)
            factor[i].append(length)
            rows[i] = [_minus(part, length, direction) for part, direction in zip(rows[i], unit, strict=True)]
    return factor


def _factored(entries: list[list[Tensor]], scaled: Callable[[int, list[Tensor]], list[Tensor]]) -> list[list[Tensor]]:
    """Entries of the lower factor.

    Args:
        entries: of the lower triangle of a matrix, row by row, of any shape.
        scaled: makes of the number of a column and its entries, from the pivot on, those of the factor.
    """
    size = len(entries)
    remainder = [list(row) for row in entries]
    for j in range(size):
        for i, entry in enumerate(scaled(j, [row[j] for row in remainder[j:]]), start=j):
            remainder[i][j] = entry
        for i in range(j + 1, size):
            for k in range(j + 1, i + 1):
                remainder[i][k] = remainder[i][k] - remainder[i][j] * remainder[k][j]
    return remainder


def _substituted(lower: list[list[Tensor]], rows: list[Tensor], regular: bool) -> list[Tensor]:
    """Rows of L^-1 B, from entries of L that broadcast against the rows of B; see `solve_lower`."""
    solved: list[Tensor] = []
    for row, (*known, pivot) in zip(rows, lower, strict=True):
        for left, above in zip(known, solved, strict=True):
            row = row - left * above
        solved.append(row / pivot if regular else row * _reciprocal(pivot))
    return solved


def _dot(left: _Row, right: _Row) -> Tensor:
    """Dot product of two rows given in the same parts."""
    total = None
    for a, b in zip(left, right, strict=True):
        if a is None or b is None:
            continue
        product = a * b
        term = product[..., 0] if product.shape[-1] == 1 else product.sum(dim=-1)
        total = term if total is None else total + term
    assert total is not None
    return total


def _minus(part: Tensor | None, length: Tensor, direction: Tensor | None) -> Tensor | None:
    if direction is None:
        return part
    taken = length.unsqueeze(-1) * direction
    return -taken if part is None else part - taken


def _inverse_root(square: Tensor) -> Tensor:
    """1 / sqrt(x) such that x times it is 0 for an exact 0, whose gradient is 0 as well; NaN stays NaN."""
    if square.requires_grad:
        zero = square == 0
        return torch.rsqrt(square.masked_fill(zero, 1.0)).masked_fill(zero, 0.0)
    return torch.rsqrt(square.clamp_min(torch.finfo(square.dtype).tiny))


def _reciprocal(pivot: Tensor) -> Tensor:
    """1 / pivot, and 0 for a pivot that is exactly 0 (a direction that is known)."""
    zero = pivot == 0
    if pivot.requires_grad:
        pivot = pivot.masked_fill(zero, 1.0)
    return (1.0 / pivot).masked_fill(zero, 0.0)


def _from_lower(entries: list[list[Tensor]]) -> Tensor:
    """Entries (...,) of a lower triangle, row by row, into a matrix (..., n, n) with batch-last memory."""
    size = len(entries)
    zero = torch.zeros_like(entries[0][0])
    flat = [entries[i][j] if j <= i else zero for i in range(size) for j in range(size)]
    return torch.stack(flat, dim=0).unflatten(0, (size, size)).movedim((0, 1), (-2, -1))
