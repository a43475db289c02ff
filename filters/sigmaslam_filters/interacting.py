"""Several motions of which one holds at a time, and which one may change: the interacting multiple model."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.core.factors import square
from sigmaslam_filters.core.tensors import shapes_of
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import AnyMeasurement, AnyMotion
from sigmaslam_filters.robust import Robust


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Mixture:
    """A belief for each of M motions, and how probable it is that the motion holds.

    Attributes:
        beliefs: M of them, batch (...,).
        probability: (..., M).
        log_likelihood: of the last measurement, (...,); zero before the first.
    """

    beliefs: Sequence[Gaussian]
    probability: Tensor
    log_likelihood: Tensor

    __repr__ = shapes_of


@dataclass(frozen=True, slots=True, eq=False)
class InteractingMultipleModels:
    """One filter with several motions (Blom & Bar-Shalom 1988); all states are of one space.

    Attributes:
        bayes: the filter of each.
        motions: M of them.
        transition: (M, M) probability to change from motion i (row) to j from one step to the next; rows add up to 1.
    """

    bayes: BayesFilter
    motions: Sequence[AnyMotion]
    transition: Tensor

    def __post_init__(self) -> None:
        count, shape = len(self.motions), tuple(self.transition.shape)
        if shape != (count, count):
            raise ValueError(f"transition is {shape}, but {count} motions need {count} x {count}")
        if not torch.allclose(self.transition.sum(dim=-1), torch.ones_like(self.transition[0]), atol=1e-5):
            raise ValueError(f"rows of the transition must add up to 1, got {self.transition.sum(dim=-1).tolist()}")
        if (self.transition < 0).any():
            raise ValueError(f"the transition has a negative probability: {self.transition.tolist()}")

    def start(self, belief: Gaussian, probability: Tensor | None = None) -> Mixture:
        """The same belief (...,) for all motions, which are equally probable unless (..., M) is given."""
        count = len(self.motions)
        if probability is None:
            probability = torch.full_like(self.transition[0], 1.0 / count)
        total = probability.sum(dim=-1)
        if probability.shape[-1:] != (count,) or not torch.allclose(total, torch.ones_like(total)):
            raise ValueError(f"{count} probabilities that add up to 1 are needed, got {probability.tolist()}")
        probability = probability.expand(*belief.batch_shape, count)
        return Mixture([belief] * count, probability, torch.zeros_like(probability[..., 0]))

    def predict(self, mixture: Mixture, *inputs: Tensor) -> Mixture:
        """Mixes the beliefs by who may have been whom, and moves each by its motion."""
        joint = mixture.probability.unsqueeze(-1) * self.transition
        probability = joint.sum(dim=-2)
        # What is impossible is mixed anyhow, by the transition alone.
        share = torch.where(probability.unsqueeze(-2) > 0, joint / probability.unsqueeze(-2), self.transition)
        share = share / share.sum(dim=-2, keepdim=True)
        mixed = [self._mixed(mixture.beliefs, share[..., j], j) for j in range(len(self.motions))]
        moved = [
            self.bayes.predict(belief, motion, *inputs).belief
            for belief, motion in zip(mixed, self.motions, strict=True)
        ]
        return Mixture(moved, probability, torch.zeros_like(mixture.log_likelihood))

    def update(
        self,
        mixture: Mixture,
        measurement: AnyMeasurement,
        value: Tensor,
        *inputs: Tensor,
        gate: float | None = None,
        robust: Robust | None = None,
    ) -> Mixture:
        """Updates each belief, and each motion's probability by the likelihood that it gives the measurement.

        A motion whose update failed, where failures are held, is as probable as a measurement that nothing explains
        leaves it, unless all failed: then nothing was learned.
        """
        updates = [
            self.bayes.update(belief, measurement, value, *inputs, gate=gate, robust=robust)
            for belief in mixture.beliefs
        ]
        likelihood = torch.stack([update.log_likelihood for update in updates], dim=-1)
        healthy = torch.stack([update.healthy.expand(likelihood.shape[:-1]) for update in updates], dim=-1)
        likelihood = torch.where(healthy | ~healthy.any(dim=-1, keepdim=True), likelihood, -torch.inf)
        log_joint = torch.log(mixture.probability) + likelihood
        total = torch.logsumexp(log_joint, dim=-1)
        return Mixture([update.belief for update in updates], torch.exp(log_joint - total.unsqueeze(-1)), total)

    def gaussian(self, mixture: Mixture) -> Gaussian:
        """Mean and covariance of the mixture."""
        return self._mixed(mixture.beliefs, mixture.probability, 0)

    def _mixed(self, beliefs: Sequence[Gaussian], weight: Tensor, first: int) -> Gaussian:
        """The Gaussian with the moments of a mixture of weights (..., M), on a manifold in the chart at its mean."""
        linearisation, reference = self.bayes.linearisation, beliefs[first].mean
        chart = linearisation.chart
        parts = weight.unbind(dim=-1)

        def offset(belief: Gaussian, point: Tensor) -> Tensor:
            return belief.mean - point if chart is None else chart(belief.mean, point)

        shifts = [part.unsqueeze(-1) * offset(belief, reference) for part, belief in zip(parts, beliefs, strict=True)]
        mean = linearisation.retract(reference, torch.stack(shifts).sum(dim=0))
        covariance = torch.zeros_like(beliefs[first].covariance)
        for part, belief in zip(parts, beliefs, strict=True):
            apart = offset(belief, mean).unsqueeze(-1)
            if chart is None:
                inside = belief.covariance
            else:
                # About its own mean, but seen from the mixture's.
                inside = square(linearisation.carry(belief.mean, None, belief.factor, mean))
            covariance = covariance + part[..., None, None] * (inside + apart @ apart.mT)
        return Gaussian(mean, covariance, is_symmetric=True)
