"""Smoothing with a fixed lag: what is known a second later. `python examples/filters/fixed_lag.py`."""

from typing import Any

import torch

from sigmaslam_filters import Gaussian, KalmanFilter, LinearMeasurement
from sigmaslam_filters.systems import constant_velocity_over

DOUBLE = torch.float64


def run(axes: Any = None) -> dict[str, float]:
    """Error of the rate of a height that is seen ten times a second."""
    generator, dt = torch.Generator().manual_seed(5), 0.1
    k = torch.arange(300, dtype=DOUBLE)
    height, rate = torch.sin(k * dt)[:, None], torch.cos(k * dt)
    values = height + 0.1 * torch.randn(300, 1, generator=generator, dtype=DOUBLE)
    motion = constant_velocity_over(torch.tensor([0.5], dtype=DOUBLE), dt)
    see = LinearMeasurement(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), torch.tensor([[0.01]], dtype=DOUBLE))
    kf, start = KalmanFilter(), Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
    track = kf.filter(start, motion, see, values)
    beliefs = {"filtered": track.filtered, "lag of 1 s": kf.smooth(track, lag=10), "smoothed": kf.smooth(track)}
    if axes is not None:
        for name, belief in beliefs.items():
            axes.plot(k * dt, belief.mean[:, 1] - rate, lw=1, label=name)
        axes.legend()
    return {f"rms, {name} [m/s]": float((b.mean[:, 1] - rate).square().mean().sqrt()) for name, b in beliefs.items()}


if __name__ == "__main__":
    print(run())
