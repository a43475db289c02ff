"""A particle filter beside a UKF: the growth model, whose posterior has two modes.

`python examples/filters/particles_beside_ukf.py`; the model is that of Gordon, Salmond and Smith (1993).
"""

from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters import Diagonal, Gaussian, MeasurementModel, MotionModel, ParticleFilter, UnscentedKalmanFilter

DOUBLE, RUNS, STEPS = torch.float64, 100, 50


def grow(x: Tensor, step: Tensor) -> Tensor:
    """The next number (..., 1)."""
    return 0.5 * x + 25.0 * x / (1.0 + x * x) + 8.0 * torch.cos(1.2 * step)


def run(axes: Any = None) -> dict[str, float]:
    """Root mean square errors over runs; 1,000 particles."""
    generator = torch.Generator().manual_seed(7)
    motion = MotionModel(grow, Diagonal(torch.tensor([10.0], dtype=DOUBLE)))
    see = MeasurementModel(lambda x: x * x / 20.0, Diagonal(torch.tensor([1.0], dtype=DOUBLE)))
    start = Gaussian(torch.zeros(RUNS, 1, dtype=DOUBLE), 5.0 * torch.eye(1, dtype=DOUBLE).expand(RUNS, 1, 1))
    truth = 5.0**0.5 * torch.randn(RUNS, 1, generator=generator, dtype=DOUBLE)
    ukf, cloud = UnscentedKalmanFilter(), ParticleFilter(generator)
    belief, particles, rows = start, cloud.sample(start, 1000), []
    for at in range(STEPS):
        step = torch.full((RUNS, 1), float(at), dtype=DOUBLE)
        truth = grow(truth, step) + 10.0**0.5 * torch.randn(RUNS, 1, generator=generator, dtype=DOUBLE)
        value = truth * truth / 20.0 + torch.randn(RUNS, 1, generator=generator, dtype=DOUBLE)
        belief = ukf.update(ukf.predict(belief, motion, step).belief, see, value).belief
        particles, _ = cloud.update(cloud.predict(particles, motion, step), see, value)
        rows.append(torch.cat([truth, belief.mean, cloud.gaussian(particles).mean], dim=-1))
    true, by_ukf, by_particles = torch.stack(rows).unbind(-1)
    if axes is not None:
        for name, each in (("truth", true), ("UKF", by_ukf), ("particles", by_particles)):
            axes.plot(each[:, 0], lw=1, label=name)
        axes.legend()
    return {
        f"rms, {name}": float((each - true).square().mean().sqrt())
        for name, each in (("UKF", by_ukf), ("particles", by_particles))
    }


if __name__ == "__main__":
    print(run())
