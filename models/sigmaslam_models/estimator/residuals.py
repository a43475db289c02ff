"""Residuals of (u, v, disparity), of which the disparity may be missing."""

import torch
from torch import Tensor

# A disparity that is not there: its variance, pixels squared.
UNKNOWN_VARIANCE = 1e12


def mask_missing(measurement: Tensor, mean: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Residuals (M, 3) without the disparities that are not there (NaN), and covariances (M, 3, 3) to match.

    Returns:
        Residuals, covariances, and (M,) how many numbers each residual has, 2 or 3.
    """
    missing = torch.isnan(measurement)
    residual = torch.where(missing, torch.zeros_like(mean), measurement - mean)
    there = (~missing).to(noise.dtype)
    unknown = torch.tensor(UNKNOWN_VARIANCE, dtype=noise.dtype, device=noise.device)
    masked = noise * there[:, :, None] * there[:, None, :] + torch.diag_embed(missing.to(noise.dtype) * unknown)
    return residual, masked, there.sum(dim=1)


def chi_square(quantiles: object, components: Tensor) -> Tensor:
    """(M,) quantiles, of a table by degrees of freedom, for so many components (M,), 2 or 3."""
    two, three = torch.tensor(quantiles, dtype=components.dtype, device=components.device)[2:4].unbind(0)
    return torch.where(components > 2.0, three, two)
