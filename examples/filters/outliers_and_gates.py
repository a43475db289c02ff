"""Outliers and gates: one fix in ten is 5 m off. `python examples/filters/outliers_and_gates.py`."""

from typing import Any

import torch

from sigmaslam_filters import Gaussian, KalmanFilter, LinearMeasurement
from sigmaslam_filters.systems import constant_velocity_over

DOUBLE = torch.float64


def run(axes: Any = None) -> dict[str, float]:
    """Error of the position without any, with a gate, and with robust weights."""
    generator, dt = torch.Generator().manual_seed(4), 0.1
    k = torch.arange(200, dtype=DOUBLE)
    truth = torch.sin(k * dt)[:, None]
    values = truth + 0.1 * torch.randn(200, 1, generator=generator, dtype=DOUBLE)
    values += 5.0 * (torch.rand(200, 1, generator=generator, dtype=DOUBLE) < 0.1)
    motion = constant_velocity_over(torch.tensor([0.5], dtype=DOUBLE), dt)
    place = LinearMeasurement(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), torch.tensor([[0.01]], dtype=DOUBLE))
    kf, start = KalmanFilter(), Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))
    found = {}
    for name, options in {"plain": {}, "gate 0.999": {"gate": 0.999}, "Student's t": {"robust": "student_t"}}.items():
        mean = kf.filter(start, motion, place, values, **options).filtered.mean[:, :1]
        found[f"rms, {name} [m]"] = float((mean - truth).square().mean().sqrt())
        if axes is not None:
            axes.plot(k * dt, mean, lw=1, label=name)
    if axes is not None:
        axes.plot(k * dt, values, ".", ms=3)
        axes.legend()
    return found


if __name__ == "__main__":
    print(run())
