"""Triangular factors of covariances, by LAPACK or unrolled, whichever suits the shapes; bad elements are flagged.

No function here raises for one bad element of a batch or adds anything to a diagonal (R8).
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor
from torch.autograd import forward_ad

from sigmaslam_filters.core import plain_factors, unrolled_factors


def cholesky(matrix: Tensor) -> tuple[Tensor, Tensor | None]:
    """Lower factor L, L L^T = matrix, of positive semidefinite matrices.

    Args:
        matrix: (..., n, n) symmetric; the lower triangle is read. Exactly known or copied directions are allowed.
    Returns:
        (..., n, n) lower triangular factor; (...,) bool, True where the matrix is positive semidefinite and finite, or
        None where that is known to hold for all. Where it does not, the factor is arbitrary.
    """
    tolerance = plain_factors.PIVOT_TOLERANCES[matrix.dtype]
    if plain_factors.is_exporting():
        return plain_factors.cholesky(matrix)
    if unrolled_factors.is_small(matrix):
        return unrolled_factors.cholesky(matrix, tolerance)
    factor, failure = torch.linalg.cholesky_ex(matrix)
    if may_look(matrix):
        if not bool(failure.any()):
            return factor, None
    elif torch.compiler.is_compiling():
        return factor, failure == 0
    # LAPACK knows positive definite matrices only.
    healthy = failure == 0
    lower, restored = plain_factors.cholesky(matrix)
    return torch.where(healthy[..., None, None], factor, lower), healthy | restored


def may_look(array: Tensor) -> bool:
    """Whether control flow may depend on values: on a CPU a look is cheap, elsewhere it waits or breaks a graph."""
    return array.device.type == "cpu" and not is_traced() and not is_mapped()


def is_mapped() -> bool:
    """Whether this runs within a transform of torch.func, such as vmap, in which values may not be looked at."""
    return torch._C._functorch.maybe_current_level() is not None


def is_traced() -> bool:
    """Whether a graph is made of what is called, and values are not there to be looked at."""
    return torch.compiler.is_compiling() or plain_factors.is_exporting()


def is_differentiated(array: Tensor) -> bool:
    """Whether derivatives of what is made of this will be asked for, backward or forward."""
    if torch.is_grad_enabled() and array.requires_grad:
        return True
    return forward_ad.unpack_dual(array).tangent is not None


def triangularise(pieces: Sequence[Tensor], diagonal: Tensor | None = None) -> Tensor:
    """Lower factor L, L L^T = A A^T for A = [pieces side by side, diag(diagonal)], by QR of A^T.

    A A^T is never formed, so float32 keeps its seven digits of the *root* (R7).

    Args:
        pieces: (..., n, c_i) each, broadcastable in their leading dimensions.
        diagonal: (..., n), or None.
    Returns:
        (..., n, n) lower triangular with a non-negative diagonal; NaN where a piece has one.
    """
    pieces = _broadcast(pieces, None if diagonal is None else diagonal.shape[:-1])
    size = pieces[0].shape[-2]
    columns = 0 if plain_factors.is_exporting() else sum(piece.shape[-1] for piece in pieces)
    if unrolled_factors.is_small(pieces[0], columns):
        return unrolled_factors.triangularise(pieces, diagonal)
    if diagonal is not None:
        pieces = _broadcast([*pieces, torch.diag_embed(diagonal)])
        columns += size
    stacked = torch.cat(pieces, dim=-1) if len(pieces) > 1 else pieces[0]
    if plain_factors.is_exporting():
        return plain_factors.triangularise(stacked)
    # Derivatives need Q; without them it need not be formed.
    mode = "reduced" if is_differentiated(stacked) else "r"
    upper = torch.linalg.qr(stacked.mT, mode=mode).R
    # Signs of a QR are arbitrary. A root does not mind, but sigma points should not depend on the form.
    sign = 1.0 - 2.0 * torch.signbit(torch.diagonal(upper, dim1=-2, dim2=-1)).to(upper.dtype)
    lower = (upper * sign.unsqueeze(-1)).mT
    return torch.nn.functional.pad(lower, (0, size - columns)) if columns < size else lower


def solve_lower(factor: Tensor, right: Tensor, regular: bool = False) -> Tensor:
    """L^-1 B for lower triangular L (..., n, n) and B (..., n, c).

    A zero pivot is a known direction, of which nothing is asked; with `regular` it is an error, and the result is not
    finite.
    """
    if plain_factors.is_exporting():
        return plain_factors.solve_lower(factor, right, regular)
    if unrolled_factors.is_small(factor, right.shape[-1]):
        return unrolled_factors.solve_lower(factor, right, regular)
    return torch.linalg.solve_triangular(factor if regular else _without_zero_pivots(factor), right, upper=False)


def solve_lower_transposed(factor: Tensor, right: Tensor) -> Tensor:
    """L^-T B for lower triangular L (..., n, n) and B (..., n, c); a zero pivot is a known direction."""
    if plain_factors.is_exporting():
        return plain_factors.solve_lower_transposed(factor, right)
    if unrolled_factors.is_small(factor, right.shape[-1]):
        return unrolled_factors.solve_lower_transposed(factor, right)
    return torch.linalg.solve_triangular(_without_zero_pivots(factor).mT, right, upper=True)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Matrix product (..., r, k) @ (..., k, c)."""
    if unrolled_factors.is_small(left, right.shape[-1]) or (
        left.shape[-2] <= unrolled_factors.ROWS and unrolled_factors.is_small(right)
    ):
        return unrolled_factors.multiply(left, right)
    return left @ right


def square(pieces: Sequence[Tensor]) -> Tensor:
    """A A^T for A = [pieces side by side], pieces (..., n, c_i) -> (..., n, n)."""
    total = None
    for piece in pieces:
        part = unrolled_factors.multiply(piece, piece.mT) if unrolled_factors.is_small(piece) else piece @ piece.mT
        total = part if total is None else total + part
    assert total is not None
    return total


def apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Matrix times vector, (..., r, k), (..., k) -> (..., r)."""
    if unrolled_factors.is_small(matrix) or (
        matrix.shape[-2] <= unrolled_factors.ROWS and unrolled_factors.is_small(vector.unsqueeze(-2))
    ):
        return unrolled_factors.apply(matrix, vector)
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def finite(vector: Tensor, matrix: Tensor) -> Tensor | None:
    """Whether all entries of (..., n) and (..., r, c) are finite, (...,) bool, or None if all elements' are."""
    # A sum of finite entries is finite unless it overflows, and what is not finite does not cancel against itself.
    if may_look(vector) and math.isfinite(float(vector.detach().sum() + matrix.detach().sum())):
        return None
    total = vector.sum(dim=-1) + matrix.sum(dim=(-2, -1))
    return total - total == 0


def nonnegative(variance: Tensor, tolerance: float = 0.0) -> Tensor | None:
    """Whether none of (..., n) is negative, (...,) bool, or None if so for all elements; NaN is not sound.

    Down to the tolerance, as a share of the largest, a negative one is taken for round-off of zero.
    """
    if may_look(variance) and variance.numel() and float(variance.detach().amin()) >= 0:
        return None
    floor = -tolerance * variance.abs().amax(dim=-1, keepdim=True) if tolerance else 0.0
    return (variance >= floor).all(dim=-1)


def both(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """Conjunction of flags (...,), of which None is all true."""
    if first is None or second is None:
        return second if first is None else first
    return first & second


def log_diagonal(factor: Tensor) -> Tensor:
    """Logarithm of the determinant of L L^T, (..., n, n) -> (...,)."""
    return 2.0 * torch.log(torch.diagonal(factor, dim1=-2, dim2=-1)).sum(dim=-1)


def identity(size: int, like: Tensor) -> Tensor:
    """Identity (n, n) of the other's dtype and device."""
    if is_traced():
        return torch.eye(size, dtype=like.dtype, device=like.device)
    return _kept_identity(size, like.dtype, like.device)


@lru_cache(maxsize=64)
def _kept_identity(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.eye(size, dtype=dtype, device=device)


def _broadcast(pieces: Sequence[Tensor], other: torch.Size | None = None) -> list[Tensor]:
    """Matrices (..., r, c_i) with one batch shape, that of the other included."""
    batches = [piece.shape[:-2] for piece in pieces] + ([other] if other is not None else [])
    if all(batch == batches[0] for batch in batches):
        return list(pieces)
    batch = torch.broadcast_shapes(*batches)
    return [piece.expand(*batch, *piece.shape[-2:]) for piece in pieces]


def _without_zero_pivots(factor: Tensor) -> Tensor:
    """The factor with ones for zero pivots: their columns are zero, so no other unknown changes."""
    diagonal = torch.diagonal(factor, dim1=-2, dim2=-1)
    if may_look(factor) and bool(diagonal.all()):
        return factor
    return factor + torch.diag_embed((diagonal == 0).to(factor.dtype))
