"""Noise of repeated sightings, and how a filter learns its size from the innovations."""

import torch
from torch import Tensor

CORRELATION_SECONDS = 5.0
"""Time constant of a sighting's error: until the view of a landmark has changed, its errors are much the same."""
STUDENT_DOF = 4.0
"""Degrees of freedom of a sighting's noise, the usual choice where they are not estimated (Lange et al. 1989)."""
LEARNING_RATE = 0.02
"""Share of what is known about the size of the noise that one new sighting replaces: about 50 count."""


def repetition(since: Tensor, correlation: float = CORRELATION_SECONDS) -> Tensor:
    """By how much the variance of a sighting grows because the landmark was seen shortly before, (...,).

    Of errors that a first-order Markov process makes, n at a spacing with correlation rho tell as much as
    n (1 - rho) / (1 + rho) independent ones do; each stands for its share.

    Args:
        since: (...,) seconds since the sighting before; infinite for none.
        correlation: the process's time constant, seconds.
    """
    rho = torch.exp(-since.clamp_min(1e-3) / correlation)
    return (1.0 + rho) / (1.0 - rho)


def learned_scale(
    scale: Tensor, innovation: Tensor, predicted: Tensor, nominal: Tensor, share: Tensor, present: Tensor
) -> Tensor:
    """Variances (..., m) in units of those a sensor was said to have: what innovations have beyond the belief's part.

    Args:
        scale: (..., m) before these sightings.
        innovation: (..., L, m).
        predicted: (..., L, m) variance of the belief's part of it.
        nominal: (..., L, m) variance of the noise that was expected.
        share: (..., L) how much of a new sighting each one is; less than 1 for repetitions and outliers.
        present: (..., L) whether there is one.
    """
    total = predicted + nominal
    surplus = (innovation.square() / total - 1.0) * nominal / total
    surplus = torch.where(present[..., None], surplus * share[..., None], 0.0).sum(dim=-2)
    # As an exponent it stays positive; bounded, so that one step with many sightings does not decide all.
    return scale * torch.exp((LEARNING_RATE * surplus).clamp(-0.5, 0.5))
