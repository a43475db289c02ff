"""One step of a robot: predict, look at the sightings, learn their noise, update; for a batch, or compiled for one."""

from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from sigmaslam_filters import BayesFilter, Diagonal, Gaussian, MeasurementModel, MotionModel, Update, several
from sigmaslam_filters.core.factors import cholesky, log_diagonal, solve_lower
from sigmaslam_filters.results import TimeUpdate
from sigmaslam_localisation.sighting_noise import STUDENT_DOF, NoiseScale


class Platform(Protocol):
    """What moves and sees: its models."""

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """Of a step."""
        ...

    def measurement(self) -> MeasurementModel:
        """Of one sighting."""
        ...

    def variance(self, value: Tensor) -> Tensor:
        """Of each component of sightings (..., m)."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class _Sighted:
    """Sightings compared with a belief: all (..., L, ·)."""

    innovation: Tensor
    covariance: Tensor
    log_determinant: Tensor
    distance: Tensor
    weight: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class RobotStep:
    """What a robot does and sees, as a function of tensors that may have a batch.

    Attributes:
        bayes: the filter.
        platform: models of the robot.
        slots: sightings that there may be at a time; 0 for a step that only moves.
    """

    bayes: BayesFilter
    platform: Platform
    slots: int

    def move(self, belief: Gaussian, path: Tensor, duration: Tensor) -> TimeUpdate:
        """The belief after a path (..., 2) of a duration (...,)."""
        return self.bayes.predict(belief, self.platform.motion(path, duration), path, duration[..., None])

    def look(
        self, belief: Gaussian, scale: Tensor, value: Tensor, position: Tensor, growth: Tensor, nominal: Tensor
    ) -> tuple[Gaussian, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The belief after sightings, and scale, NIS, weight, innovation and log-likelihood as `Localisation` has them.

        Args:
            belief: (...,).
            scale: (..., m) variance of the noise over the nominal one.
            value: (..., L, m); NaN for none.
            position: (..., L, d) inputs of the measurement.
            growth: (..., L) of the variances of repetitions.
            nominal: (..., L, m) variances at a scale of 1; anything where there is no sighting.
        """
        m, noise = value.shape[-1], NoiseScale(scale)
        there = ~value.isnan().any(dim=-1)
        expected = torch.where(there[..., None], nominal * scale[..., None, :], 1.0)
        see = several(self.platform.measurement(), self.slots)
        noisy = replace(see, noise=Diagonal((expected * growth[..., None]).flatten(-2)))
        updated = self.bayes.update(belief, noisy, value.flatten(-2), position, robust="student_t")
        sighted = _compare(updated, expected, growth, there)
        student = 0.5 * (STUDENT_DOF + m) * torch.log1p(sighted.distance / STUDENT_DOF)
        density = -0.5 * sighted.log_determinant - student
        log_likelihood = torch.where(there, density / growth, 0.0).sum(dim=-1)
        predicted = (torch.diagonal(sighted.covariance, dim1=-2, dim2=-1) - expected).clamp_min(0.0)
        learned = noise.learn(sighted.innovation, predicted, expected, sighted.weight / growth, there)
        return updated.belief, learned.scale, sighted.distance, sighted.weight, sighted.innovation, log_likelihood

    def nothing(self, steps: int, robots: int, components: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """NIS, weight, innovation and log-likelihood of steps (K, B) that see nothing."""
        shapes = [(self.slots,), (self.slots,), (self.slots, components), ()]
        nis, weight, innovation, log_likelihood = (
            torch.zeros(steps, robots, *shape, dtype=torch.float64) for shape in shapes
        )
        return nis, weight, innovation, log_likelihood


def _compare(updated: Update, expected: Tensor, growth: Tensor, there: Tensor) -> _Sighted:
    """What an update says of each sighting, with the variance (B, L, m) that it would have if it were new."""
    L, m = expected.shape[-2:]
    assert updated.weight is not None
    weight = torch.where(there, updated.weight, 1.0)
    innovation = updated.innovation.unflatten(-1, (L, m))
    blocks = updated.innovation_covariance.unflatten(-1, (L, m)).unflatten(-3, (L, m))
    used = torch.diag_embed(expected * (growth / weight)[..., None])
    covariance = torch.diagonal(blocks, dim1=-4, dim2=-2).movedim(-1, -3) - used + torch.diag_embed(expected)
    factor = cholesky(covariance)[0]
    distance = solve_lower(factor, innovation[..., None]).square().sum(dim=(-2, -1))
    return _Sighted(innovation, covariance, log_diagonal(factor), distance, weight)
