"""How a Gaussian goes through a function: by sigma points (UKF), by the derivative (EKF), or exactly if it is linear.

A function is given as `evaluate`, from tangent offsets (k, ..., n) about the mean to values (k, ..., m), and as
`difference(values, reference)` where values are not vectors; the result is a reference value, a mean in the chart at
the reference, and columns of deviations. KF, EKF and UKF differ in nothing else.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.forward_mode import push_along
from sigmaslam_filters.core.plain_factors import is_exporting
from sigmaslam_filters.core.sigma_points import SigmaPoints, Symmetric

Evaluate = Callable[[Tensor], Tensor]
Difference = Callable[[Tensor, Tensor], Tensor]
Recentre = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, slots=True)
class Transformed:
    """What became of a Gaussian.

    Attributes:
        reference: (..., p) value that the chart is at; None for plain vectors.
        mean: (..., m) mean, in the chart at the reference.
        columns: deviations from the mean.
    """

    reference: Tensor | None
    mean: Tensor
    columns: Columns

    def from_mean(self, value: Tensor, difference: Difference | None) -> Tensor:
        """A value (..., m) minus the mean, by the difference that the transform was given."""
        if difference is None or self.reference is None:
            return value - self.mean
        return difference(value, self.reference) - self.mean


class Transform(Protocol):
    """Sends a Gaussian with a root (..., n, c) of its covariance through a function."""

    def __call__(
        self, evaluate: Evaluate, columns: Tensor, difference: Difference | None, recentre: Recentre | None = None
    ) -> Transformed:
        """Values, through `difference` where they are not vectors.

        `recentre(reference, mean)` makes a new reference of the mean, where deviations are to be seen from there.
        """
        ...


@dataclass(frozen=True, slots=True)
class Unscented:
    """By sigma points (Table 9.2)."""

    points: SigmaPoints = field(default_factory=Symmetric)

    def __call__(
        self, evaluate: Evaluate, columns: Tensor, difference: Difference | None, recentre: Recentre | None = None
    ) -> Transformed:
        """One call of the function for all points."""
        size = columns.shape[-1]
        # Differences of values on a manifold are taken from the centre, so it is evaluated though its weight be zero.
        with_centre = difference is not None or self.points.has_centre(size)
        values = evaluate(self.points.offsets(columns, with_centre))
        if difference is None:
            mean = self.points.mean(values, size, with_centre)
            return Transformed(None, mean, self.points.deviations(values, mean, size, with_centre))
        reference = values[-1]
        local = difference(values, reference)
        mean = self.points.mean(local, size, with_centre)
        if recentre is not None:
            reference = recentre(reference, mean)
            mean, local = torch.zeros_like(mean), difference(values, reference)
        return Transformed(reference, mean, self.points.deviations(local, mean, size, with_centre))


@dataclass(frozen=True, slots=True, eq=False)
class Taylor:
    """By the first derivative at the mean (9.26, Table 9.1).

    Attributes:
        jacobian: (..., m, n) the derivative where the model gives it; None: by forward-mode differentiation.
    """

    jacobian: Tensor | None = None

    def __call__(
        self, evaluate: Evaluate, columns: Tensor, difference: Difference | None, recentre: Recentre | None = None
    ) -> Transformed:
        """All directional derivatives in one pass."""
        directions = columns.movedim(-1, 0)
        if self.jacobian is not None or difference is not None:
            reference = evaluate(torch.zeros_like(directions[:1]))[0]
        if self.jacobian is not None:
            odd = self.jacobian @ columns
            mean = reference if difference is None else torch.zeros_like(odd[..., 0])
            return Transformed(None if difference is None else reference, mean, Columns(odd))

        def local(offsets: Tensor) -> Tensor:
            values = evaluate(offsets)
            return values if difference is None else difference(values, reference)

        values, slopes = push_forward(local, [torch.zeros_like(directions)], [directions])
        return Transformed(None if difference is None else reference, values[0], Columns(slopes.movedim(0, -1)))


def push_forward(
    function: Callable[..., Tensor], points: Sequence[Tensor], directions: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Values of a function of tensors, and its derivative along directions, which have the points' shapes."""
    if not is_exporting():
        return push_along(function, points, directions)
    # Forward derivatives cannot be traced, those of the backward pass, which is linear in its argument, can.
    pulled = torch.func.vjp(function, *points)
    values, pull = pulled[0], pulled[1]
    push = torch.func.vjp(pull, torch.zeros_like(values))[1]
    return values, push(tuple(directions))[0]


@dataclass(frozen=True, slots=True)
class Exact:
    """Refuses functions: the Kalman filter is for linear models, which need no transform."""

    def __call__(self, *arguments: object, **options: object) -> Transformed:
        """Raises TypeError."""
        raise TypeError(
            "the Kalman filter takes LinearMotion and LinearMeasurement on R^n; use ExtendedKalmanFilter or "
            "UnscentedKalmanFilter for other models"
        )
