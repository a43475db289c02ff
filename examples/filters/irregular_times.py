"""Irregular time steps: a height seen at any time. `python examples/filters/irregular_times.py`."""

from typing import Any

import torch

from sigmaslam_filters import Gaussian, LinearMeasurement, UnscentedKalmanFilter
from sigmaslam_filters.systems import constant_velocity

DOUBLE = torch.float64


def run(axes: Any = None) -> dict[str, float]:
    """Error and error in sigmas of the height; the time step is an input of the motion."""
    generator = torch.Generator().manual_seed(0)
    times = 10.0 * torch.rand(60, generator=generator, dtype=DOUBLE).sort().values
    truth = torch.sin(times)
    values = truth + 0.1 * torch.randn(60, generator=generator, dtype=DOUBLE)
    motion = constant_velocity(torch.tensor([0.5], dtype=DOUBLE))  # white acceleration, m^2/s^3
    height = LinearMeasurement(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), torch.tensor([[0.01]], dtype=DOUBLE))
    ukf, start = UnscentedKalmanFilter(), Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
    smoothed = ukf.smooth(ukf.filter(start, motion, height, values[:, None], [times.diff()[:, None]]))
    error, sigma = smoothed.mean[:, 0] - truth, smoothed.covariance[:, 0, 0].sqrt()
    if axes is not None:
        axes.plot(times, values, ".", times, smoothed.mean[:, 0])
        axes.fill_between(times, smoothed.mean[:, 0] - 3 * sigma, smoothed.mean[:, 0] + 3 * sigma, alpha=0.2)
    return {"rms [m]": float(error.square().mean().sqrt()), "sigmas": float((error / sigma).square().mean().sqrt())}


if __name__ == "__main__":
    print(run())
