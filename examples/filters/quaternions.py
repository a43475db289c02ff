"""Quaternions in a UKF: attitude by a gyroscope and two directions. `python examples/filters/quaternions.py`."""

from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters import SO3, Diagonal, Gaussian, MeasurementModel, MotionModel, UnscentedKalmanFilter

DOUBLE = torch.float64
SPACE = SO3("right")  # points are unit quaternions x, y, z, w; covariances are 3 x 3
DOWN_AND_NORTH = torch.tensor([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]], dtype=DOUBLE)


def turned_back(quaternion: Tensor, vector: Tensor) -> Tensor:
    """A vector of the world as the body sees it."""
    axis, scalar = -quaternion[..., :3], quaternion[..., 3:]
    cross = 2.0 * torch.linalg.cross(axis, vector.expand_as(axis), dim=-1)
    return vector + scalar * cross + torch.linalg.cross(axis, cross, dim=-1)


def see(quaternion: Tensor) -> Tensor:
    """Down and north in the body, (..., 6)."""
    return torch.cat([turned_back(quaternion, each) for each in DOWN_AND_NORTH], dim=-1)


def run(axes: Any = None) -> dict[str, float]:
    """From an attitude known to 60 degrees; NEES is of 3."""
    generator, steps = torch.Generator().manual_seed(2), 200
    normal = torch.randn(steps, 9, generator=generator, dtype=DOUBLE)
    k = torch.arange(steps, dtype=DOUBLE)
    gyro = torch.stack([0.02 * torch.sin(k / 20), 0.02 * torch.cos(k / 30), torch.full_like(k, 0.03)], dim=-1)
    truth, attitudes = SPACE.retract(torch.tensor([0.0, 0, 0, 1], dtype=DOUBLE), normal[0, :3]), []
    for at in range(steps):
        truth = SPACE.retract(truth, gyro[at] + 0.002 * normal[at, 6:])
        attitudes.append(truth)
    true = torch.stack(attitudes)
    ukf = UnscentedKalmanFilter(SPACE)
    motion = MotionModel(SPACE.retract, Diagonal(torch.full((3,), 0.002**2, dtype=DOUBLE)))
    camera = MeasurementModel(see, Diagonal(torch.full((6,), 0.1**2, dtype=DOUBLE)))
    start = Gaussian(torch.tensor([0.0, 0, 0, 1], dtype=DOUBLE), torch.eye(3, dtype=DOUBLE))
    track = ukf.filter(start, motion, camera, see(true) + 0.1 * normal[:, :6], [gyro[1:]])
    error = SPACE.local(track.filtered.mean, true)
    nees = (error * torch.linalg.solve(track.filtered.covariance, error)).sum(dim=-1)
    if axes is not None:
        axes.semilogy(k, error.norm(dim=-1), k, 3 * track.filtered.covariance.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt())
    return {"rms at the end [rad]": float(error[100:].square().sum(-1).mean().sqrt()), "NEES": float(nees.mean())}


if __name__ == "__main__":
    print(run())
