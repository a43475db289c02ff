"""One step of a robot: predict, look at the sightings, learn their noise, update; for a batch, or compiled for one."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters import BayesFilter, Diagonal, Gaussian, several
from sigmaslam_filters.core.factors import cholesky, log_diagonal, solve_lower
from sigmaslam_filters.results import TimeUpdate
from sigmaslam_localisation.sighting_noise import STUDENT_DOF, learned_scale
from sigmaslam_localisation.stereo_points import StereoBody
from sigmaslam_localisation.wheeled_robot import WheeledRobot

Platform = WheeledRobot | StereoBody
"""What moves and sees."""


@dataclass(frozen=True, slots=True, eq=False)
class RobotStep:
    """What a robot does and sees, as a function of tensors that may have a batch.

    Attributes:
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
        L, m = value.shape[-2:]
        there = ~value.isnan().any(dim=-1)
        expected = torch.where(there[..., None], nominal * scale[..., None, :], 1.0)
        see = several(self.platform.measurement(), self.slots)
        noisy = replace(see, noise=Diagonal((expected * growth[..., None]).flatten(-2)))
        updated = self.bayes.update(belief, noisy, value.flatten(-2), position, robust="student_t")
        assert updated.weight is not None
        weight = torch.where(there, updated.weight, 1.0)
        innovation = updated.innovation.unflatten(-1, (L, m))
        # Each sighting's covariance with the noise that it would have if it were new.
        blocks = updated.innovation_covariance.unflatten(-1, (L, m)).unflatten(-3, (L, m))
        blocks = torch.diagonal(blocks, dim1=-4, dim2=-2).movedim(-1, -3)
        covariance = blocks - torch.diag_embed(expected * (growth / weight)[..., None]) + torch.diag_embed(expected)
        factor = cholesky(covariance)[0]
        distance = solve_lower(factor, innovation[..., None]).square().sum(dim=(-2, -1))
        student = 0.5 * (STUDENT_DOF + m) * torch.log1p(distance / STUDENT_DOF)
        log_likelihood = torch.where(there, (-0.5 * log_diagonal(factor) - student) / growth, 0.0).sum(dim=-1)
        predicted = (torch.diagonal(covariance, dim1=-2, dim2=-1) - expected).clamp_min(0.0)
        learned = learned_scale(scale, innovation, predicted, expected, weight / growth, there)
        return updated.belief, learned, distance, weight, innovation, log_likelihood
