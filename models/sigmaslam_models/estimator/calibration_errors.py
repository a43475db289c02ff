"""What errors of a stereo calibration do to the measurements of a rectified pair."""

import torch
from torch import Tensor


def unmodelled_errors(intrinsics: Tensor, uvd: Tensor) -> Tensor:
    """By how much each error that `StereoTransfer` does not have, of size one, changes what is measured of points.

    Args:
        intrinsics: (5,) fx, fy, cx, cy, fx baseline.
        uvd: (..., 3) (u, v, disparity).
    Returns:
        (..., 3, 9) to first order, in the order of `sigmaslam.estimation.calibration_errors.ERRORS`.
    """
    fx = intrinsics[0]
    across, down, x, y, disparity = _places(intrinsics, uvd)
    x_right, y_squared = x - disparity / fx, y * y
    squared = x * x + y_squared
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    lens, right_lens = x * squared, x_right * (x_right * x_right + y_squared)
    in_u = [zero] * 4 + [across, one, zero, lens, zero]
    in_v = [zero] * 4 + [down, zero, one, down * squared / fx, zero]
    in_disparity = [y, x_right, y_squared, right_lens, disparity, zero, zero, lens - right_lens, disparity]
    return torch.stack([*in_u, *in_v, *in_disparity], dim=-1).unflatten(-1, (3, len(in_u)))


def view_turns(intrinsics: Tensor, uvd: Tensor) -> Tensor:
    """By how much a turn of the view about its axes, of one pixel in the centre, changes what is measured of points.

    Args:
        intrinsics: (5,) fx, fy, cx, cy, fx baseline.
        uvd: (M, 3) (u, v, disparity).
    Returns:
        (M, 3, 3) to first order.
    """
    fx, fy = intrinsics[:2].unbind(0)
    _, _, x, y, disparity = _places(intrinsics, uvd)
    share, zero, ratio = disparity / fx, torch.zeros_like(x), fy / fx
    in_u, in_v = [-x * y, 1.0 + x * x, -y], [-ratio * (1.0 + y * y), ratio * x * y, ratio * x]
    return torch.stack([*in_u, *in_v, -share * y, share * x, zero], dim=-1).unflatten(-1, (3, 3))


def _places(intrinsics: Tensor, uvd: Tensor) -> tuple[Tensor, ...]:
    """Columns and rows from the centre, pixels and normalised, and disparities."""
    fx, fy, cx, cy = intrinsics[:4].unbind(0)
    u, v, disparity = uvd.unbind(-1)
    across, down = u - cx, v - cy
    return across, down, across / fx, down / fy, disparity
