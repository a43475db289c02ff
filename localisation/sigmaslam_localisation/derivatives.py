"""Derivatives of a wheeled robot's motion and sightings in the tangents of its state, for the extended filter."""

import torch
from torch import Tensor

SERIES_BELOW = 1e-2
"""Radians of a turn, below which differences that cancel are taken from their series."""


def motion_slope(state: Tensor, path: Tensor, duration: Tensor) -> Tensor:
    """Of `WheeledRobot.motion` by the state's tangent and the noise, (..., n, n + 2), at no noise.

    Args:
        state: (..., n) with the pose and seven constants first; all that follows stands still.
        path: (..., 2) metres and radians.
        duration: (..., 1) seconds.
    """
    size, seconds = state.shape[-1], duration[..., 0]
    distance = path[..., 0] * (1.0 + state[..., 3]) + seconds * state[..., 5]
    turn = path[..., 1] * (1.0 + state[..., 4]) + seconds * state[..., 6]
    sine, cosine = torch.sin(state[..., 7]), torch.cos(state[..., 7])
    zero = torch.zeros_like(distance)
    # By speed scale, turn scale, speed offset, turn offset, drift, and the two noises.
    of_twist = _matrix(
        [
            [path[..., 0] * cosine, zero, seconds * cosine, zero, -distance * sine, cosine, zero],
            [path[..., 0] * sine, zero, seconds * sine, zero, distance * cosine, sine, zero],
            [zero, path[..., 1], zero, seconds, zero, zero, torch.ones_like(zero)],
        ]
    )
    by_twist, by_pose = _exponential_slopes(distance * cosine, distance * sine, turn)
    moved = by_twist @ of_twist
    slope = torch.eye(size, size + 2, dtype=state.dtype).repeat(*moved.shape[:-2], 1, 1)
    slope[..., :3, :3] = by_pose
    slope[..., :3, 3:8] = moved[..., :5]
    slope[..., :3, size:] = moved[..., 5:]
    return slope


def _exponential_slopes(x: Tensor, y: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Of pose * Exp(x, y, turn), in the tangent there: by the twist, and by the pose's own tangent, (..., 3, 3)."""
    small = turn.abs() < SERIES_BELOW
    safe = torch.where(small, 1.0, turn)
    # sin(t) / t, (1 - cos(t)) / t, and what is left of 1 - sin(t) / t after a division by t.
    s = torch.sinc(turn / torch.pi)
    half = torch.sinc(turn / (2.0 * torch.pi))
    c = 0.5 * turn * half * half
    rest = torch.where(small, turn / 6.0 - turn**3 / 120.0, (1.0 - s) / safe)
    bend = 0.5 * half * half
    zero, one = torch.zeros_like(turn), torch.ones_like(turn)
    by_twist = _matrix([[s, c, rest * x - bend * y], [-c, s, bend * x + rest * y], [zero, zero, one]])
    sine, cosine = torch.sin(turn), torch.cos(turn)
    back_x, back_y = -(s * x + c * y), -(s * y - c * x)
    by_pose = _matrix([[cosine, sine, back_y], [-sine, cosine, -back_x], [zero, zero, one]])
    return by_twist, by_pose


def sighting_slope(state: Tensor, landmark: Tensor, seen: Tensor, lever: float) -> tuple[Tensor, Tensor]:
    """Of metres ahead and to the left, (9.45), by the state's tangent (..., 2, 10), and by the landmark (..., 2, 2).

    Args:
        state: (..., n), at least the pose and seven constants.
        landmark: (..., 2) its place.
        seen: (..., 2) what the state says of it.
        lever: metres by which the sensor stands ahead.
    """
    x, y = landmark[..., 0] - state[..., 0], landmark[..., 1] - state[..., 1]
    heading, offset, scale = state[..., 2], state[..., 8], 1.0 + state[..., 9]
    in_body = torch.cos(heading) * x + torch.sin(heading) * y, torch.cos(heading) * y - torch.sin(heading) * x
    of_body = scale[..., None, None] * _rotation(offset)
    zero, one = torch.zeros_like(in_body[0]), torch.ones_like(in_body[0])
    by_pose = of_body @ _matrix([[-one, zero, in_body[1]], [zero, -one, -in_body[0]]])
    by_offset, by_scale = torch.stack([-seen[..., 1], seen[..., 0]], dim=-1), seen / scale[..., None]
    none = torch.zeros(*by_pose.shape[:-1], 5, dtype=state.dtype)
    by_state = torch.cat([by_pose, none, by_offset[..., None], by_scale[..., None]], dim=-1)
    return by_state, of_body @ _rotation(-heading)


def polar_slope(seen: Tensor) -> Tensor:
    """Of distance and bearing by metres ahead and to the left (..., 2), (..., 2, 2)."""
    ahead, left = seen[..., 0], seen[..., 1]
    squared = ahead * ahead + left * left
    distance = torch.sqrt(squared)
    return _matrix([[ahead / distance, left / distance], [-left / squared, ahead / squared]])


def _rotation(angle: Tensor) -> Tensor:
    sine, cosine = torch.sin(angle), torch.cos(angle)
    return _matrix([[cosine, -sine], [sine, cosine]])


def _matrix(rows: list[list[Tensor]]) -> Tensor:
    """Components (...,) into matrices (..., rows, columns)."""
    return torch.stack([torch.stack(list(torch.broadcast_tensors(*row)), dim=-1) for row in rows], dim=-2)
