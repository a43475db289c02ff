"""Maximum likelihood of a pendulum's noise: 500 readings of its shadow, gradients through the compiled filter.

`python examples/filters/learn_noise.py` prints what a gradient costs, compiled and not, and what was learned.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sigmaslam_filters import (
    Diagonal,
    Event,
    Gaussian,
    MeasurementModel,
    MotionModel,
    Track,
    UnscentedKalmanFilter,
    compile_filter,
    stack,
)

DOUBLE = torch.float64
SECONDS = torch.tensor([0.0125], dtype=DOUBLE)
TRUTH = torch.tensor([0.1, 0.3], dtype=DOUBLE)  # rad/s per square root of a second, and of the shadow
FILTER = UnscentedKalmanFilter(iterations=1)
Filtered = Callable[[Gaussian, Sequence[Event]], Track]


def swing(state: Tensor, seconds: Tensor) -> Tensor:
    """Angle and rate (..., 2) after a time (..., 1)."""
    dt = seconds[..., 0]
    return stack([state[..., 0] + state[..., 1] * dt, state[..., 1] - 9.81 * torch.sin(state[..., 0]) * dt])


def shadow(state: Tensor) -> Tensor:
    """Of a pendulum of one metre."""
    return torch.sin(state[..., :1])


def simulate(steps: int = 500, seed: int = 0) -> Tensor:
    """Readings (steps, 1)."""
    normal = torch.randn(steps, 2, generator=torch.Generator().manual_seed(seed), dtype=DOUBLE)
    state, values = torch.tensor([1.5, 0.0], dtype=DOUBLE), []
    for first, second in normal:
        values.append(shadow(state) + TRUTH[1] * first)
        state = swing(state, SECONDS) + torch.stack([0.0 * second, TRUTH[0] * SECONDS[0].sqrt() * second])
    return torch.stack(values)


def log_likelihood(logarithm: Tensor, values: Tensor, filtered: Filtered) -> Tensor:
    """Of logarithms (2,) of the deviations in `TRUTH`."""
    process, noise = (2.0 * logarithm).exp()
    # The angle's noise is small, not zero, so that a covariance never is singular.
    motion = MotionModel(swing, Diagonal(process * SECONDS * torch.tensor([1e-4, 1.0], dtype=DOUBLE)))
    see = MeasurementModel(shadow, Diagonal(noise[None]))
    events = [Event(motion if k else None, see, value, SECONDS if k else ()) for k, value in enumerate(values)]
    start = Gaussian(torch.tensor([1.5, 0.0], dtype=DOUBLE), 0.01 * torch.eye(2, dtype=DOUBLE))
    return filtered(start, events).log_likelihood.sum()


def gradient(logarithm: Tensor, values: Tensor, filtered: Filtered) -> tuple[Tensor, float]:
    """The gradient (2,), and the seconds of processor time that it took."""
    leaf = logarithm.clone().requires_grad_()
    begun = time.process_time()
    (found,) = torch.autograd.grad(log_likelihood(leaf, values, filtered), leaf)
    return found, time.process_time() - begun


def learn(values: Tensor, filtered: Filtered, steps: int = 60) -> Tensor:
    """Deviations (2,) of the largest likelihood."""
    logarithm = torch.tensor([0.0, 0.0], dtype=DOUBLE, requires_grad=True)
    optimiser = torch.optim.Adam([logarithm], lr=0.1)
    for _ in range(steps):
        optimiser.zero_grad()
        (-log_likelihood(logarithm, values, filtered)).backward()
        optimiser.step()
    return logarithm.detach().exp()


def main() -> None:
    """Times and learns."""
    values, fast = simulate(), compile_filter(FILTER)
    at = torch.tensor([-1.0, -1.0], dtype=DOUBLE)
    gradient(at, values, fast.filter_events)  # compiles
    compiled = [gradient(at, values, fast.filter_events) for _ in range(7)]
    expected, seconds = gradient(at, values, FILTER.filter_events)
    milliseconds = 1e3 * sorted(each for _, each in compiled)[3]
    off = float((compiled[0][0] - expected).abs().max() / expected.abs().max())
    print(f"a gradient: {milliseconds:.1f} ms compiled, {1e3 * seconds:.0f} ms uncompiled, apart by {off:.0e}")
    print(f"learned {learn(values, fast.filter_events).tolist()}, true {TRUTH.tolist()}")


if __name__ == "__main__":
    main()
