"""What `predict` and `update` return."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from sigmaslam.filters.factors import multiply, square
from sigmaslam.filters.gaussian import Gaussian
from sigmaslam.filters.noise import Noise
from sigmaslam.filters.sigma_points import Columns
from sigmaslam.filters.updates import Form


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """What `predict` returns.

    Attributes:
        belief: the predicted belief.
        healthy: (...,) bool, False for elements that the policy on failure had to deal with.
    """

    belief: Gaussian
    healthy: Tensor
    _prior_root: Tensor = field(repr=False)
    _columns: Columns = field(repr=False)
    _noise: Noise | None = field(repr=False)
    _noise_matrix: Tensor | None = field(repr=False)

    @property
    def cross_covariance(self) -> Tensor:
        """Covariance (..., n, n) of the prior state (rows) with the predicted one."""
        return self._prior_root @ self._columns.odd.mT

    def joint_root(self) -> tuple[Tensor, list[Tensor], Tensor]:
        """Deviations of the predicted state from the prior's (..., n, n), all others (..., n, c), the prior's root."""
        others = [] if self._columns.even is None else [self._columns.even]
        if self._columns.negative is not None:
            raise ValueError("a smoother needs sigma weights that are not negative, such as those of cubature()")
        if self._noise is not None:
            factor = self._noise.factor()
            others.append(factor if self._noise_matrix is None else multiply(self._noise_matrix, factor))
        return self._columns.odd, others, self._prior_root


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What `update` returns; all but the belief is of the first linearisation, the one at the prior.

    Attributes:
        belief: the posterior.
        innovation: (..., m) measured minus expected, zero where masked.
        nis: (...,) normalised innovation squared.
        log_likelihood: (...,) of the measurement.
        healthy: (...,) bool, False for elements that the policy on failure had to deal with.
        form: how it was computed, see `sigmaslam.filters.updates`.
        count: components that took part, (...,) or a number: the degrees of freedom of the NIS.
    """

    belief: Gaussian
    innovation: Tensor
    nis: Tensor
    log_likelihood: Tensor
    healthy: Tensor
    form: Form
    count: Tensor | int
    _columns: Columns = field(repr=False)
    _noise: Noise | None = field(repr=False)
    _prior_root: Tensor = field(repr=False)

    @property
    def innovation_covariance(self) -> Tensor:
        """S (..., m, m), formed when asked for; unit rows where masked."""
        S = square(self._columns.all())
        if self._columns.negative is not None:
            S = S - square([self._columns.negative])
        return S if self._noise is None else S + self._noise.covariance()

    @property
    def gain(self) -> Tensor:
        """Kalman gain (..., n, m), formed when asked for, at a cost of m^3."""
        cross = self._prior_root @ self._columns.odd.mT
        return torch.linalg.solve(self.innovation_covariance, cross.mT).mT
