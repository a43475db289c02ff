"""Residuals of (u, v, disparity), with weights for tails longer than a Gaussian's."""

from __future__ import annotations

import torch
from torch import Tensor

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN

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


def common_scale(squared: Tensor, components: Tensor, usable: Tensor) -> Tensor:
    """Factor (), 1 or more, by which all variances together are too small: of a blurred image, say.

    The median tells how far the residuals scatter before any gate. It is believed where nearly all agree once their
    variances are scaled by it; where they do not, the errors are those of a part: outliers among good matches. Where
    it is large nothing fits.

    Args:
        squared: (M,) squared lengths of whitened residuals.
        components: (M,) how many numbers each residual has.
        usable: (M,) bool, those that count.
    """
    counts = usable.to(squared.dtype)
    count = counts.sum()
    ratio = squared / chi_square(CHI_SQUARE_MEDIAN, components)
    ordered = torch.sort(torch.where(usable, ratio, torch.full_like(ratio, float("inf")))).values
    number = usable.to(torch.int64).sum()
    middle = torch.stack([(number - 1).clamp_min(0) // 2, number // 2])
    factor = ordered.index_select(0, middle).sum() / 2.0
    # Half of them are expected above 1; by chance no more than three standard deviations of that count besides.
    scattered = ((ratio > 1.0).to(squared.dtype) * counts).sum() > 0.5 * count + 1.5 * torch.sqrt(count)
    agrees = (squared <= factor * chi_square(CHI_SQUARE_999, components)).to(squared.dtype)
    nearly_all = torch.tensor(ACCEPTANCE.scaled_agreement, dtype=squared.dtype, device=squared.device)
    believed = scattered & (factor <= ACCEPTANCE.max_noise_scale) & ((agrees * counts).sum() >= nearly_all * count)
    return torch.where(believed, factor, torch.ones_like(factor))


def student_weight(squared: Tensor, components: Tensor | float, freedom: Tensor) -> Tensor:
    """Weights (M,) that make least squares the fit of a Student-t, from squared lengths of whitened residuals.

    The weighted information of such a fit is more than the estimate's precision, (nu + p + 2) / (nu + p) times as much
    where errors are Student-t: the weights are that much smaller, which hardly moves the estimate.
    """
    whole = freedom + components
    return whole * whole / ((whole + 2.0) * (freedom + squared))


def chi_square(quantiles: object, components: Tensor) -> Tensor:
    """(M,) quantiles, of a table by degrees of freedom, for so many components (M,), 2 or 3."""
    two, three = torch.tensor(quantiles, dtype=components.dtype, device=components.device)[2:4].unbind(0)
    return torch.where(components > 2.0, three, two)
