"""A measurement of a belief on its way through an update: look, gate, solve."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import both, finite
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.solve import Form, TangentPosterior, solve
from sigmaslam_filters.linearisation import Linearisation, LinearisedMeasurement
from sigmaslam_filters.models import AnyMeasurement, is_additive
from sigmaslam_filters.robust import Blocks, Robust, WeightedPosterior


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A measurement of a belief, as it can be looked at from anywhere.

    Attributes:
        linearisation: how it is linearised.
        inputs: of the model's function.
        value: (..., m), zero for what is missing.
        mean, root: (..., p), (..., n, n) of the prior belief.
        noise: R, with unit variance for what is missing where it is additive.
        mask: (..., m), False for what takes no part; None: all takes part.
        count: (...,) or a number, components that take part.
        usable: (...,) bool, whether the belief, the value and the noise are; None: they are for all.
        blocks: with the weights of the gate; None: neither a gate nor robust weights are asked for.
    """

    linearisation: Linearisation
    measurement: AnyMeasurement
    inputs: tuple[Tensor, ...]
    value: Tensor
    mean: Tensor
    root: Tensor
    noise: Noise
    mask: Tensor | None
    count: Tensor | int
    usable: Tensor | None
    blocks: Blocks | None = None

    @property
    def added(self) -> Noise | None:
        """The noise; None where it is not additive."""
        return self.noise if is_additive(self.measurement) else None

    def look(self, previous: TangentPosterior | None = None) -> LinearisedMeasurement:
        """From the prior, or from the posterior of the look before."""
        seen = self.linearisation.measurement(
            self.mean, self.root, self.measurement, self.noise, self.value, self.inputs, previous
        )
        if self.mask is not None:
            seen = seen.masked(self.mask, self.added is None)
        # What cannot be used is not looked at, so that it harms no derivative either.
        used = both(self.usable, finite(seen.innovation, seen.columns.odd))
        if used is None:
            return seen
        innovation = torch.where(used[..., None], seen.innovation, 0.0)
        return replace(seen, innovation=innovation, columns=seen.columns.where(used), usable=used)

    def gated(
        self, seen: LinearisedMeasurement, gate: float | None, robust: Robust | None
    ) -> "tuple[Sight, LinearisedMeasurement]":
        """Without the blocks that the gate refuses, in what is looked at and in what was seen."""
        if gate is None and robust is None:
            return self, seen
        blocks = Blocks.of(self.measurement, self.noise, self.value, self.mask, robust)
        if gate is None:
            return replace(self, blocks=blocks), seen
        blocks = blocks.gated(gate, seen.innovation, seen.columns, self.noise)
        mask = blocks.masked(self.mask)
        noise = blocks.weighted(self.noise.masked(mask))
        gated = replace(self, mask=mask, count=mask.sum(dim=-1), noise=noise, blocks=blocks)
        return gated, seen.masked(mask, False)

    def solve(self, form: Form, seen: LinearisedMeasurement) -> WeightedPosterior:
        """The posterior of what was seen, with robust weights where they are asked for."""

        def posterior(noise: Noise | None) -> TangentPosterior:
            return solve(form, seen.innovation, seen.columns, noise, self.root)

        added = self.added
        if self.blocks is None or added is None:
            return WeightedPosterior(posterior(added), added)
        return self.blocks.solve(posterior, seen.innovation, seen.columns, added)
