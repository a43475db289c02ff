"""SO(3) and SE(3) as matrices: exponential and logarithm that export to ONNX in float64, in few operators.

What the tracker's graphs are made of. `lie_groups` has the same maps by quaternions, up to half a turn and with
derivatives to round-off; a test compares the two. They are written twice because with the series of `lie_groups`, and
its arc tangent, which ONNX Runtime lacks in float64, the tracker's graphs take 5 to 10 % longer. Here the angle comes
from Newton steps on sine and cosine. Tangent order: (translation, rotation).
"""

import torch
from torch import Tensor

_SMALL = 1e-3  # radians; below it the series are exact to round-off in float64

# The exporter takes Python scalars through float32: every scalar here is a small integer or a power of two, and a
# third is written as a division by three.


# Row k is the cross-product matrix of the k-th unit vector, row by row.
_CROSS = ((0, 0, 0, 0, 0, -1, 0, 1, 0), (0, 0, 1, 0, 0, 0, -1, 0, 0), (0, -1, 0, 1, 0, 0, 0, 0, 0))


def skew(vector: Tensor) -> Tensor:
    """Cross-product matrix, (..., 3) -> (..., 3, 3)."""
    cross = torch.tensor(_CROSS, dtype=vector.dtype, device=vector.device)
    return (vector @ cross).unflatten(-1, (3, 3))


def _coefficients(squared: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin(a)/a, (1 - cos(a))/a^2 and (a - sin(a))/a^3 from a^2."""
    small = squared < _SMALL * _SMALL
    safe = torch.where(small, torch.ones_like(squared), squared)
    angle = torch.sqrt(safe)
    half = torch.sin(0.5 * angle) / angle
    sine = torch.sin(angle)
    first = torch.where(small, 1.0 - squared / 6.0, sine / angle)
    second = torch.where(small, 0.5 - squared / 24.0, 2.0 * half * half)
    third = torch.where(small, (1.0 - squared / 20.0) / 6.0, (angle - sine) / (angle * safe))
    return first, second, third


def exp_se3(tangent: Tensor) -> Tensor:
    """Rigid motions from twists, (..., 6) -> (..., 4, 4)."""
    translation, rotation = tangent[..., :3], tangent[..., 3:]
    squared = (rotation * rotation).sum(dim=-1)
    first, second, third = (c[..., None, None] for c in _coefficients(squared))
    K = skew(rotation)
    K2 = K @ K
    identity = torch.eye(3, dtype=tangent.dtype, device=tangent.device)
    R = identity + first * K + second * K2
    V = identity + second * K + third * K2
    t = V @ translation.unsqueeze(-1)
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=tangent.dtype, device=tangent.device)
    return torch.cat([torch.cat([R, t], dim=-1), bottom.expand(*R.shape[:-2], 1, 4)], dim=-2)


def log_se3(transform: Tensor) -> Tensor:
    """Twists of rigid motions that turn by less than pi, (..., 4, 4) -> (..., 6)."""
    R, t = transform[..., :3, :3], transform[..., :3, 3]
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    cosine = 0.5 * torch.sqrt((1.0 + trace).clamp_min(1e-12))
    axis_sine = torch.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], dim=-1
    ) / (4.0 * cosine.unsqueeze(-1))
    squared_sine = (axis_sine * axis_sine).sum(dim=-1)
    tiny = squared_sine < 1e-14
    sine = torch.sqrt(torch.where(tiny, torch.ones_like(squared_sine), squared_sine))
    half = sine
    for _ in range(4):  # each step turns an error e into about e^3 / 6
        half = half + (sine * torch.cos(half) - cosine * torch.sin(half))
    stretch = torch.where(tiny, 2.0 + squared_sine / 3.0, 2.0 * half / sine)
    rotation = stretch.unsqueeze(-1) * axis_sine
    squared = (rotation * rotation).sum(dim=-1)
    first, second, _ = _coefficients(squared)
    small = squared < _SMALL * _SMALL
    safe = torch.where(small, torch.ones_like(squared), squared)
    inverse_term = torch.where(small, (1.0 + squared / 60.0) / 12.0, (1.0 - 0.5 * first / second) / safe)
    K = skew(rotation)
    identity = torch.eye(3, dtype=R.dtype, device=R.device)
    V_inverse = identity - 0.5 * K + inverse_term[..., None, None] * (K @ K)
    return torch.cat([(V_inverse @ t.unsqueeze(-1)).squeeze(-1), rotation], dim=-1)


def invert_se3(transform: Tensor) -> Tensor:
    """Inverse of rigid motions, (..., 4, 4)."""
    R_transposed = transform[..., :3, :3].transpose(-1, -2)
    t = -R_transposed @ transform[..., :3, 3:]
    return torch.cat([torch.cat([R_transposed, t], dim=-1), transform[..., 3:, :]], dim=-2)


def adjoint_se3(transform: Tensor) -> Tensor:
    """Matrix that carries a twist through a rigid motion, (..., 4, 4) -> (..., 6, 6)."""
    R, t = transform[..., :3, :3], transform[..., :3, 3]
    upper = torch.cat([R, skew(t) @ R], dim=-1)
    return torch.cat([upper, torch.cat([torch.zeros_like(R), R], dim=-1)], dim=-2)
