"""Sigma sets: points with the mean and covariance of a Gaussian, and what a function makes of them.

A set with weights w_i and standardised points xi_i, sum w_i xi_i xi_i^T = I, is rotated in sample space so that the
first n columns are the *odd* part of the function (its statistical linearisation times the root of the covariance) and
the rest the *even* part (the error of that linearisation). Their outer products add up to the covariance of the values,
and odd alone is the cross-covariance with the state. Weights are computed in float64 and cast (R3).
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.unrolled_factors import ROWS, join


class SigmaPoints(Protocol):
    """A sigma set for any dimension. Values are (k, ..., m), the k points first, in the order of `offsets`.

    Attributes:
        sees_error: whether the even columns show the error of a linearisation.
    """

    sees_error: ClassVar[bool]

    def offsets(self, columns: Tensor, with_centre: bool) -> Tensor:
        """Offsets (k, ..., n) of the points for a root (..., n, c) of the covariance; a centre comes last."""
        ...

    def has_centre(self, size: int) -> bool:
        """Whether the centre is one of the points for c columns."""
        ...

    def mean(self, values: Tensor, size: int, with_centre: bool) -> Tensor:
        """Weighted mean (..., m)."""
        ...

    def deviations(self, values: Tensor, mean: Tensor, size: int, with_centre: bool) -> Columns:
        """Columns of the values about a mean (..., m)."""
        ...


@dataclass(frozen=True, slots=True)
class Symmetric:
    """Pairs x0 +- sqrt(n + lambda) l_i, and a centre: what `cubature`, `julier` and `merwe` are made of.

    Attributes:
        alpha, beta, kappa: lambda = alpha^2 (n + kappa) - n, and the centre's covariance weight is its mean weight plus
            1 - alpha^2 + beta (Julier 2002; van der Merwe 2004).
        allow_negative: whether the centre's covariance weight may be negative: covariances can then be indefinite.
    """

    alpha: float = 1.0
    beta: float = 0.0
    kappa: float = 0.0
    allow_negative: bool = False

    sees_error: ClassVar[bool] = True

    def spread(self, size: int) -> float:
        """n + lambda for n = size: the points of a pair are its root times a column away, and weigh half its inverse.

        Raises:
            ValueError: the points are imaginary.
        """
        spread = self.alpha**2 * (size + self.kappa)
        if spread <= 0:
            raise ValueError(f"no sigma points for n = {size}: alpha^2 (n + kappa) = {spread:g} must be positive")
        return spread

    def weights(self, size: int) -> tuple[float, float, float]:
        """Of each pair's points, and the centre's for mean and covariance, for n = size.

        Raises:
            ValueError: the points are imaginary, or the centre's covariance weight is negative and not asked for.
        """
        spread = self.spread(size)
        centre = (spread - size) / spread
        centre_covariance = centre + 1.0 - self.alpha**2 + self.beta
        if centre_covariance < -1e-12 and not self.allow_negative:
            raise ValueError(
                f"the centre's covariance weight is {centre_covariance:.4g} for n = {size} (alpha {self.alpha:g}, beta "
                f"{self.beta:g}, kappa {self.kappa:g}): covariances can become indefinite. Use cubature(), raise kappa "
                "or beta, or ask for it with allow_negative=True"
            )
        return 0.5 / spread, centre, centre_covariance

    def has_centre(self, size: int) -> bool:
        """Whether the centre has a weight; cubature has none."""
        _, centre, centre_covariance = self.weights(size)
        return centre != 0.0 or centre_covariance != 0.0

    def offsets(self, columns: Tensor, with_centre: bool) -> Tensor:
        """Offsets (2c (+ 1), ..., n): plus, minus, centre."""
        size = columns.shape[-1]
        scaled = columns.movedim(-1, 0) * math.sqrt(0.5 / self.weights(size)[0])
        parts = [scaled, -scaled]
        if with_centre:
            parts.append(torch.zeros_like(scaled[:1]))
        # Points first and the batch last in memory: the components of all points lie side by side.
        return torch.cat([part.movedim(-1, 1) for part in parts], dim=0).movedim(1, -1)

    def mean(self, values: Tensor, size: int, with_centre: bool) -> Tensor:
        """Centred on the centre where there is one: x0 + sum w_i (x_i - x0), which is exact to round-off (R3)."""
        weight = self.weights(size)[0]
        first = values.movedim(-1, 1)  # components before the batch: what is computed is batch-last in memory
        if with_centre:
            centre = first[-1]
            mean = centre + _total(first[: 2 * size] - centre) * weight
        else:
            mean = _total(first) * weight
        return mean.movedim(0, -1)

    def deviations(self, values: Tensor, mean: Tensor, size: int, with_centre: bool) -> Columns:
        """Half differences and half sums of each pair; the centre makes a column of its own."""
        weight, _, centre_covariance = self.weights(size)
        scale = math.sqrt(0.5 * weight)
        first = values.movedim(-1, 1)
        halves = odd_and_even(first[:size], first[size : 2 * size], mean.movedim(-1, 0))
        odd, even = ((half * scale).movedim((0, 1), (-1, -2)) for half in halves)
        if not with_centre or centre_covariance == 0.0:
            return Columns(odd, even)
        centre = ((values[-1] - mean) * math.sqrt(abs(centre_covariance))).unsqueeze(-1)
        if centre_covariance < 0:
            return Columns(odd, even, negative=centre)
        return Columns(odd, join([even, centre]))


@dataclass(frozen=True, slots=True)
class Simplex:
    """n + 1 points of equal weight, the fewest there can be; no even part is seen (Moireau & Chapelle 2011)."""

    sees_error: ClassVar[bool] = False

    def has_centre(self, size: int) -> bool:
        """Never."""
        return False

    def offsets(self, columns: Tensor, with_centre: bool) -> Tensor:
        """Offsets (c + 1 (+ 1), ..., n): the corners of a regular simplex, then the centre."""
        corners = _simplex(columns.shape[-1]).to(columns) * math.sqrt(columns.shape[-1] + 1)
        moved = (columns @ corners).movedim(-1, 0)
        return torch.cat([moved, torch.zeros_like(moved[:1])], dim=0) if with_centre else moved

    def mean(self, values: Tensor, size: int, with_centre: bool) -> Tensor:
        """Plain average, about the centre where there is one."""
        if not with_centre:
            return values.mean(dim=0)
        return values[-1] + (values[:-1] - values[-1]).mean(dim=0)

    def deviations(self, values: Tensor, mean: Tensor, size: int, with_centre: bool) -> Columns:
        """n odd columns. About another mean than the average, the difference is an even column."""
        corners = _simplex(size).to(values)
        used = values[: size + 1]
        odd = (used - mean).movedim(0, -1) @ corners.mT / math.sqrt(size + 1)
        return Columns(odd, (used.mean(dim=0) - mean).unsqueeze(-1))


def odd_and_even(plus: Tensor, minus: Tensor, mean: Tensor) -> tuple[Tensor, Tensor]:
    """What pairs of values say of a function, any shape that broadcasts; divided by 2 sqrt(n + lambda), columns."""
    return plus - minus, plus + minus - 2.0 * mean


def cubature() -> Symmetric:
    """2n points of equal weight (Arasaratnam & Haykin 2009): no weight is ever negative. The default."""
    return Symmetric()


def julier(kappa: float, allow_negative: bool = False) -> Symmetric:
    """Symmetric set of Julier & Uhlmann (1997); kappa = 3 - n matches the fourth moment of each axis."""
    return Symmetric(kappa=kappa, allow_negative=allow_negative)


def merwe(alpha: float = 1.0, beta: float = 2.0, kappa: float = 0.0, allow_negative: bool = False) -> Symmetric:
    """Scaled set (van der Merwe 2004). beta = 2 suits a Gaussian; a small alpha needs allow_negative=True."""
    return Symmetric(alpha, beta, kappa, allow_negative)


def _total(values: Tensor) -> Tensor:
    """Sum over the points, (k, m, ...) -> (m, ...)."""
    if values.ndim < 3 or values.shape[0] > 2 * ROWS:
        return values.sum(dim=0)
    # torch's reduction of an outer dimension is slow on batch-last memory.
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total


def _simplex(size: int) -> Tensor:
    """Orthonormal rows (n, n + 1), each orthogonal to the vector of ones (Helmert), float64."""
    rows = torch.zeros(size, size + 1, dtype=torch.float64)
    for j in range(size):
        rows[j, : j + 1] = 1.0
        rows[j, j + 1] = -(j + 1.0)
        rows[j] /= math.sqrt((j + 1.0) * (j + 2.0))
    return rows
