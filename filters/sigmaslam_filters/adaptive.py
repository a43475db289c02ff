"""Measurement noise that follows what the innovations say."""

import torch
from torch import Tensor

from sigmaslam_filters.core.noise_covariance import Dense, Diagonal
from sigmaslam_filters.results import Update


def adapted_noise(noise: Diagonal | Dense, update: Update, value: Tensor, rate: float) -> Diagonal | Dense:
    """A measurement's noise, moved towards what one update shows of it.

    That is the expected square of the noise given the measurement, e e^T + R - R S^-1 R for the posterior's residual
    e = R S^-1 (z - h): one step of expectation maximisation on a window of about 1 / rate updates (as Akhlaghi et al.
    2017), so it stays positive. Blocks of a measurement made by `several` share the noise of one, and what they show
    is averaged; a robust weight counts. The cost is that of the dense form.

    Args:
        noise: R of one of the update's blocks (..., k), or of all of it.
        update: made with that noise.
        value: (..., m) that was measured; NaN components show nothing.
        rate: share of the new in the result, between 0 and 1.
    Raises:
        ValueError: the rate is no share, or the update's noise was not additive.
    """
    if not 0.0 <= rate <= 1.0:
        raise ValueError(f"rate is {rate}; it must be between 0 and 1, such as 0.02")
    entered = update._posterior.noise
    if entered is None:
        raise ValueError("noise that is not additive cannot be adapted")
    size, R = noise.variance().shape[-1], entered.covariance()
    gain = torch.linalg.solve(update.innovation_covariance, R).mT
    residual = gain @ update.innovation.unsqueeze(-1)
    shown = Dense(residual @ residual.mT + R - gain @ R).blocks(size)
    there = torch.isfinite(value).unflatten(-1, (-1, size)) & update.healthy[..., None, None]
    if update.weight is not None:
        weight = update.weight.repeat_interleave(there.shape[-2] // update.weight.shape[-1], dim=-1).unsqueeze(-1)
        shown, there = shown * weight.unsqueeze(-1), there & (weight > 0)
    if isinstance(noise, Diagonal):
        variance = noise.variance()
        found = torch.diagonal(shown, dim1=-2, dim2=-1)
        total = torch.where(there, found, 0.0).sum(dim=-2)
        number = there.sum(dim=-2)
        return Diagonal(torch.where(number > 0, torch.lerp(variance, total / number.clamp_min(1), rate), variance))
    # Of a correlated block only a whole one shows the covariance.
    whole = there.all(dim=-1)
    number = whole.sum(dim=-1)[..., None, None]
    total = torch.where(whole[..., None, None], shown, 0.0).sum(dim=-3)
    R = noise.covariance()
    return Dense(torch.where(number > 0, torch.lerp(R, total / number.clamp_min(1), rate), R))
