"""Missing data: NaN is not measured, the rest of the value is. `python examples/filters/missing_data.py`."""

from typing import Any

import torch

from sigmaslam_filters import Gaussian, KalmanFilter, LinearMeasurement, LinearMotion

DOUBLE = torch.float64


def run(axes: Any = None) -> dict[str, float]:
    """A place x, y and its velocity; y is missing for a while, then both are."""
    generator, eye, dt = torch.Generator().manual_seed(1), torch.eye(2, dtype=DOUBLE), 0.1
    k = torch.arange(100, dtype=DOUBLE)
    truth = torch.stack([0.3 * k * dt, torch.sin(k * dt)], dim=-1)
    values = truth + 0.1 * torch.randn(100, 2, generator=generator, dtype=DOUBLE)
    values[30:50, 1], values[70:85] = torch.nan, torch.nan
    matrix = torch.kron(torch.tensor([[1.0, dt], [0.0, 1.0]], dtype=DOUBLE), eye)
    noise = torch.kron(torch.tensor([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], dtype=DOUBLE), 0.3 * eye)
    place = LinearMeasurement(torch.eye(2, 4, dtype=DOUBLE), 0.01 * eye)
    kf, start = KalmanFilter(), Gaussian(torch.zeros(4, dtype=DOUBLE), torch.eye(4, dtype=DOUBLE))
    track = kf.filter(start, LinearMotion(matrix, noise), place, values)
    smoothed = kf.smooth(track)
    error, sigma = smoothed.mean[:, 1] - truth[:, 1], smoothed.covariance[:, 1, 1].sqrt()
    if axes is not None:
        axes.plot(k * dt, values[:, 1], ".", k * dt, smoothed.mean[:, 1])
        axes.fill_between(k * dt, smoothed.mean[:, 1] - 3 * sigma, smoothed.mean[:, 1] + 3 * sigma, alpha=0.2)
    return {
        "components measured": float(track.count.sum()),
        "rms where y is missing [m]": float(error[30:50].square().mean().sqrt()),
        "sigmas": float((error / sigma).square().mean().sqrt()),
    }


if __name__ == "__main__":
    print(run())
