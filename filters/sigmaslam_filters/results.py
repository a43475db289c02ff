"""What `predict` and `update` return."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.factors import identity, multiply
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.solve import Form, log_likelihood
from sigmaslam_filters.core.tensors import shapes_of
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.robust import WeightedPosterior


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class TimeUpdate:
    """What `predict` returns.

    Attributes:
        belief: the predicted belief.
    """

    belief: Gaussian
    _healthy: Tensor | None = field(repr=False)
    _usable: Tensor | None = field(repr=False)
    _joint: Callable[[], tuple[Tensor, Columns]] = field(repr=False)
    _noise: Noise | None = field(repr=False)
    _noise_matrix: Tensor | None = field(repr=False)

    __repr__ = shapes_of

    @property
    def healthy(self) -> Tensor:
        """(...,) bool, False for elements that the policy on failure had to deal with."""
        return _all_of(self.belief) if self._healthy is None else self._healthy

    def joint_root(self) -> tuple[Tensor, list[Tensor], Tensor]:
        """Deviations of the predicted state from the prior's (..., n, n), all others (..., n, c), the prior's root.

        For an element that was held they stand for a state that did not move.
        """
        root, columns = self._joint()
        if columns.negative is not None:
            raise ValueError("a smoother needs sigma weights that are not negative, such as those of cubature()")
        others = columns.all()[1:]
        if self._noise is not None:
            factor = self._noise.factor()
            others.append(factor if self._noise_matrix is None else multiply(self._noise_matrix, factor))
        if self._usable is None:
            return columns.odd, others, root
        # A held state stood still: it is its own prediction.
        moved = self._usable[..., None, None]
        still = identity(root.shape[-1], root)
        others = [torch.where(moved, other, 0.0) for other in others]
        return torch.where(moved, columns.odd, still), others, torch.where(moved, root, still)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Update:
    """What `update` returns. Diagnostics are of the linearisation at the prior and are computed when asked for.

    Attributes:
        belief: the posterior.
        innovation: (..., m) measured minus expected, zero where masked.
        form: how the update was computed, see `sigmaslam_filters.core.solve`.
        count: components that took part, (...,) or a number: the degrees of freedom of the NIS. Of an element that
            was held none did, so its NIS and log-likelihood are zero.
    """

    belief: Gaussian
    innovation: Tensor
    form: Form
    count: Tensor | int
    _healthy: Tensor | None = field(repr=False)
    _usable: Tensor | None = field(repr=False)
    _posterior: WeightedPosterior = field(repr=False)
    _columns: Columns = field(repr=False)
    _prior_root: Tensor = field(repr=False)

    __repr__ = shapes_of

    @property
    def healthy(self) -> Tensor:
        """(...,) bool, False for elements that the policy on failure had to deal with."""
        return _all_of(self.belief) if self._healthy is None else self._healthy

    @property
    def nis(self) -> Tensor:
        """Normalised innovation squared e^T S^-1 e, (...,)."""
        return self._unless_held(self._posterior.solution.nis())

    @property
    def weight(self) -> Tensor | None:
        """(..., b) of blocks, from the gate and the robust weights; None: neither was asked for.

        A block took part with its noise over its weight, or not at all where that is zero. All else that an update
        says is of the noise with its weights.
        """
        return self._posterior.weight

    @property
    def log_likelihood(self) -> Tensor:
        """Of the measurement, (...,)."""
        return self._unless_held(log_likelihood(self._posterior.solution, self.count))

    def _unless_held(self, amount: Tensor) -> Tensor:
        return amount if self._usable is None else torch.where(self._usable, amount, 0.0)

    @property
    def innovation_covariance(self) -> Tensor:
        """S (..., m, m); unit rows where masked."""
        S = self._columns.covariance()
        return S if self._posterior.noise is None else S + self._posterior.noise.covariance()

    @property
    def gain(self) -> Tensor:
        """Kalman gain (..., n, m), at a cost of m^3."""
        cross = self._prior_root @ self._columns.odd.mT
        return torch.linalg.solve(self.innovation_covariance, cross.mT).mT


def _all_of(belief: Gaussian) -> Tensor:
    return torch.ones(belief.batch_shape, dtype=torch.bool, device=belief.mean.device)
