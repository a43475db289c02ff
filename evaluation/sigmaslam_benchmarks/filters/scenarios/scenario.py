"""A scenario is data and models; `run` sends a filter through all its runs as one batch."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from sigmaslam_filters import BayesFilter, Gaussian, LinearMeasurement, LinearMotion, MeasurementModel, MotionModel
from sigmaslam_filters.consistency import nees


@dataclass(frozen=True, slots=True, eq=False)
class Scenario:
    """Simulated runs of one system.

    Attributes:
        truth: (T, runs, p) states.
        values: (T, runs, m) measurements; NaN throughout at a step without one.
        prior: belief of each run before the first motion.
        motion: None if there is none.
        measurement: of every step.
        motion_inputs: (T, ...) each; element k leads to step k.
        position: components of the state that are its position, in metres unless the scenario says otherwise.
    """

    truth: Tensor
    values: Tensor
    prior: Gaussian
    motion: LinearMotion | MotionModel | None
    measurement: LinearMeasurement | MeasurementModel
    motion_inputs: tuple[Tensor, ...] = ()
    position: tuple[int, ...] = (0,)


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What a filter made of a scenario.

    Attributes:
        estimate: (T, runs, p) means after each step.
        covariance: (T, runs, n, n) in the chart at the mean.
        error: (T, runs, n) truth minus estimate, in the same chart.
        nees: (T, runs) with n degrees of freedom; NaN where the covariance is singular.
        position_error: (T, runs, d) truth minus estimate.
        healthy: (T, runs) bool.
    """

    estimate: Tensor
    covariance: Tensor
    error: Tensor
    nees: Tensor
    position_error: Tensor
    healthy: Tensor

    @property
    def rmse_by_run(self) -> Tensor:
        """(runs,) root mean square length of the position error over the steps."""
        return self.position_error.square().sum(dim=-1).mean(dim=0).sqrt()

    @property
    def rmse(self) -> float:
        """Root mean square length of the position error over steps and runs."""
        return float(self.position_error.square().sum(dim=-1).mean().sqrt())


def run(scenario: Scenario, bayes: BayesFilter) -> Outcome:
    """A filter on all runs of a scenario.

    Raises:
        FilterError: a run fails and the filter's policy is to raise.
    """
    belief = scenario.prior
    beliefs, healthy = [], []
    for step, value in enumerate(scenario.values):
        well = torch.ones(belief.batch_shape, dtype=torch.bool)
        if scenario.motion is not None:
            moved = bayes.predict(belief, scenario.motion, *(given[step] for given in scenario.motion_inputs))
            belief, well = moved.belief, well & moved.healthy
        if not bool(value.isnan().all()):
            seen = bayes.update(belief, scenario.measurement, value)
            belief, well = seen.belief, well & seen.healthy
        beliefs.append(belief)
        healthy.append(well)
    estimate = torch.stack([belief.mean for belief in beliefs])
    covariance = torch.stack([belief.covariance for belief in beliefs])
    error = scenario.truth - estimate if bayes.space is None else bayes.space.local(estimate, scenario.truth)
    position = list(scenario.position)
    return Outcome(
        estimate,
        covariance,
        error,
        nees(error, covariance),
        (scenario.truth - estimate)[..., position],
        torch.stack(healthy),
    )


def normal(generator: Generator, *shape: int) -> Tensor:
    """Standard normal float64 numbers."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def matrix(*rows: Sequence[float]) -> Tensor:
    """A float64 matrix."""
    return torch.tensor(rows, dtype=torch.float64)
