"""Unscented prediction and update that export to ONNX: the cubature set, and a low-rank measurement update.

What the tracker's graphs are made of (`stereo_pose`). The general library begins with `bayes`; it calls LAPACK, for
which ONNX has no operators.

The deviations of a symmetric set come in pairs +-sqrt(n) l_i of equal weight 1 / (2n). Rotating each pair by 45 degrees
splits what a function makes of it into an odd part (n columns, the statistical linearisation) and an even part
(n columns, the error of that linearisation); both enter the update exactly, and an iterated update needs no more.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam.filters.linalg import cholesky, inverse_and_log_determinant, invert_lower

Residual = Callable[[Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class WhitenedUpdate:
    """Posterior of a standard-normal prior in whitened coordinates, x = x0 [+] L zeta.

    Attributes:
        mean: (n,) posterior mean of zeta.
        covariance: (n, n) posterior covariance of zeta.
        residual: (M,) whitened residual at the posterior mean.
        nis: () normalised innovation squared e^T S^-1 e of the first linearisation, the one at the prior.
        log_likelihood: () of the same, without the noise's own normalisation (whitening leaves it to the caller).
    """

    mean: Tensor
    covariance: Tensor
    residual: Tensor
    nis: Tensor
    log_likelihood: Tensor


def sigma_offsets(factor: Tensor) -> Tensor:
    """Cubature offsets of a covariance factor, (n, k) -> (2k, n): rows +sqrt(k) l_i, then -sqrt(k) l_i."""
    columns = factor.shape[-1]
    scaled = factor.transpose(-1, -2) * _square_root(columns, factor)
    return torch.cat([scaled, -scaled], dim=-2)


def odd_and_even(samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, odd and even deviation columns of function values at the sigma points.

    Args:
        samples: (2k, ..., m) values at the points of `sigma_offsets`, in its order.
    Returns:
        mean (..., m), odd (..., m, k) and even (..., m, k); odd odd^T + even even^T is the covariance.
    """
    count = samples.shape[0] // 2
    plus, minus = samples[:count], samples[count:]
    mean = samples.mean(dim=0)
    # A constant reciprocal would be folded in float32 by the exporter: divide by the root itself.
    root = _square_root(4 * count, samples)
    odd = (plus - minus) / root
    even = (plus + minus - 2.0 * mean) / root
    return mean, odd.movedim(0, -1), even.movedim(0, -1)


def _square_root(count: int, like: Tensor) -> Tensor:
    """The root in the other's dtype: as a Python scalar the exporter would round it to float32."""
    return torch.sqrt(torch.tensor(float(count), dtype=like.dtype, device=like.device))


def covariance_of(samples: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (m,) and covariance (m, m) of function values (2k, m) at the sigma points."""
    mean, odd, even = odd_and_even(samples)
    return mean, odd @ odd.transpose(-1, -2) + even @ even.transpose(-1, -2)


def iterated_update(residual: Residual, size: int, iterations: int, like: Tensor) -> WhitenedUpdate:
    """Posterior linearisation (García-Fernández et al. 2015) in the information form; one iteration is the UKF update.

    The innovation covariance is never formed: with W the whitened deviations, everything follows from I + W^T W of
    size 2n (Barfoot & McManus 2011), so the cost is linear in the number of measurements.

    Args:
        residual: from whitened state offsets zeta (2n, n) to whitened residuals (2n, M), measured minus predicted,
            each with unit noise; a component that is missing is zero.
        size: n, the dimension of the state.
        iterations: linearisations; the second and later are at the posterior of the one before.
        like: any tensor of the state's dtype and device.
    """
    identity = torch.eye(size, dtype=like.dtype, device=like.device)
    mean = torch.zeros(size, dtype=like.dtype, device=like.device)
    spread, inverse_spread = identity, identity
    covariance = identity
    nis = log_likelihood = mean.sum()
    for iteration in range(iterations):
        expected, odd, even = odd_and_even(residual(mean + sigma_offsets(spread)))
        if iteration > 0:
            odd = odd @ inverse_spread
        # Rows, not vectors: ONNX Runtime's transpose fusion is wrong for a product with a one-dimensional operand.
        deviations = torch.cat([-odd, even], dim=-1)
        innovation = (expected - (odd * mean).sum(dim=-1)).unsqueeze(0)
        information = deviations.transpose(0, 1) @ deviations
        inverse, log_determinant = inverse_and_log_determinant(
            information + torch.eye(2 * size, dtype=information.dtype, device=information.device)
        )
        projected = innovation @ deviations
        solution = projected @ inverse
        if iteration == 0:
            nis = (innovation * innovation).sum() - (projected * solution).sum()
            log_likelihood = -0.5 * (nis + log_determinant)
        mean = solution[0, :size]
        covariance = inverse[:size, :size]
        if iteration + 1 < iterations:
            spread = cholesky(covariance)
            inverse_spread = invert_lower(spread)
    return WhitenedUpdate(mean, covariance, residual(mean.unsqueeze(0))[0], nis, log_likelihood)
