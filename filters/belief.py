"""Degree of belief in an estimate, the last line of the chapter's filter algorithms (Tables 9.1 and 9.2)."""

from __future__ import annotations

import torch
from torch import Tensor


def degree_of_belief(covariance: Tensor) -> Tensor:
    """Bel = 1 - ||P||_2^(1/2), clipped to [0, 1]: one minus the largest standard deviation in any direction.

    Tables 9.1 and 9.2 speak of the determinant where their formula has the 2-norm; the formula is what is built.

    The number means nothing without its unit: it is 0 from one unit of standard deviation on, one metre or one radian,
    say. The caller chooses the block of the posterior covariance and says which block, and in which unit, wherever the
    belief is shown. A block that mixes units (metres and radians) mixes them in the norm too: scale it first, or ask
    for each part on its own.

    Args:
        covariance: (..., n, n) symmetric, in the square of one unit. Only the lower triangle is read.
    Returns:
        (...,) belief in [0, 1]: NaN where the covariance has a NaN, 0 where it has an infinity but no NaN. The
        gradient is that of the formula where 0 < Bel < 1; it is zero where the belief is clipped and for P = 0, at
        which the root has none.
    Raises:
        ValueError: the last two dimensions are not a square of at least 1 by 1.
    """
    if covariance.ndim < 2 or covariance.shape[-1] != covariance.shape[-2] or covariance.shape[-1] == 0:
        raise ValueError(
            f"covariance must be (..., n, n) with n > 0, not {tuple(covariance.shape)}; "
            "a single variance is a (1, 1) matrix"
        )
    lower = covariance.tril()
    is_nan = lower.isnan().flatten(-2).any(dim=-1)
    finite = lower.isfinite().flatten(-2).all(dim=-1)
    # The solver raises for the whole batch at the first matrix that is not finite.
    regular = torch.where(finite[..., None, None], covariance, 0.0)
    # The spectral norm of a symmetric matrix is its largest eigenvalue in size.
    norm = torch.linalg.eigvalsh(regular).abs().amax(dim=-1)
    partial = finite & (norm > 0) & (norm < 1)
    inside = 1.0 - torch.where(partial, norm, 1.0).sqrt()
    certain = finite & (norm == 0)
    belief = torch.where(partial, inside, certain.to(inside.dtype))
    return torch.where(is_nan, torch.nan, belief)
