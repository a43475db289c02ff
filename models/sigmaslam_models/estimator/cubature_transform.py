"""Unscented transforms that export to ONNX: the cubature set.

What the graph of the tracker's prediction is made of (`pose_prediction`). The general library begins with `bayes`; it
calls LAPACK, for which ONNX has no operators.

The deviations of a symmetric set come in pairs +-sqrt(n) l_i of equal weight 1 / (2n). Rotating each pair by 45 degrees
splits what a function makes of it into an odd part (n columns, the statistical linearisation) and an even part
(n columns, the error of that linearisation); their squares add up to the covariance.
"""

from __future__ import annotations

import torch
from torch import Tensor


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
