"""A whole sequence by `filter`, by a loop around a compiled step, and by `compile_filter`: the same filters."""

from collections.abc import Callable

import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_benchmarks.filters.extended import robot_models

BATCHES = (1, 10, 100, 10_000)
STEPS = 100
_SEED = 0
Beliefs = tuple[Tensor, Tensor]
"""Means (T, ..., 3) and covariances (T, ..., 3, 3) after each measurement."""


def make(batch: int, steps: int = STEPS) -> dict[str, Callable[[], Beliefs]]:
    """A robot (x, y, heading) that drives, and sees range and bearing of another landmark in each step, in float64.

    Args:
        batch: robots; 1 is one without a batch dimension.
        steps: measurements.
    """
    generator = torch.Generator().manual_seed(_SEED)

    def draw(*shape: int) -> Tensor:
        numbers = torch.randn(*shape[:1], batch, *shape[1:], generator=generator, dtype=torch.float64)
        return numbers[:, 0] if batch == 1 else numbers

    motion, see = robot_models()
    ukf = filters.UnscentedKalmanFilter(iterations=1, on_failure="hold")
    controls, landmarks = 0.1 * draw(steps - 1, 2), 5.0 * draw(steps, 2)
    states = [draw(1, 3)[0]]
    for control in controls:
        states.append(motion.function(states[-1], control))
    values = see.function(torch.stack(states), landmarks) + draw(steps, 2) * torch.tensor([0.1, 0.01]).double()
    prior = filters.Gaussian(states[0], 0.01 * torch.eye(3, dtype=torch.float64))

    def step(mean: Tensor, covariance: Tensor, value: Tensor, control: Tensor, landmark: Tensor) -> tuple[Tensor, ...]:
        seen = ukf.update(filters.Gaussian(mean, covariance), see, value, landmark)
        moved = ukf.predict(seen.belief, motion, control)
        held = seen.healthy & moved.healthy
        return moved.belief.mean, moved.belief.covariance, seen.belief.mean, seen.belief.covariance, held

    compiled_step = filters.compile_step(step)
    compiled = filters.compile_filter(ukf, motion, see)

    def by_filter() -> Beliefs:
        with torch.inference_mode():
            track = ukf.filter(prior, motion, see, values, [controls], [landmarks])
        return track.filtered.mean, track.filtered.covariance

    def by_steps() -> Beliefs:
        belief = prior if batch == 1 else prior.batch_last()
        mean, covariance = belief.mean, belief.covariance
        means, covariances = [], []
        with torch.inference_mode():
            for k in range(steps):
                given = values[k], controls[min(k, steps - 2)], landmarks[k]
                mean, covariance, after, covariance_after, _ = compiled_step(mean, covariance, *given)
                means.append(after)
                covariances.append(covariance_after)
            return torch.stack(means), torch.stack(covariances)

    def by_compiled_filter() -> Beliefs:
        track = compiled(prior, values, [controls], [landmarks])
        return track.filtered.mean, track.filtered.covariance

    return {"`filter`": by_filter, "loop around `compile_step`": by_steps, "`compile_filter`": by_compiled_filter}
