"""A motion or a measurement, linearised: what a filter's transform makes of a model at a belief."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters.core.columns import Columns, block_diagonal
from sigmaslam_filters.core.factors import apply, multiply, solve_lower_transposed
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.solve import TangentPosterior
from sigmaslam_filters.core.transforms import Difference, Taylor, Transform, Transformed, Unscented, push_forward
from sigmaslam_filters.manifolds import Space, is_flat
from sigmaslam_filters.manifolds.tangent_maps import tangent_maps
from sigmaslam_filters.models import (
    AnyMeasurement,
    AnyMotion,
    LinearMeasurement,
    LinearMotion,
    MeasurementModel,
    NonlinearModel,
)

_Error = Callable[[Tensor | None, Noise], Tensor]


@dataclass(frozen=True, slots=True, eq=False)
class LinearisedMeasurement:
    """A measurement's function, linearised.

    Attributes:
        innovation: (..., m).
        columns: deviations of what is seen.
        error: makes the linearisation's expected squared error (...,), in units of the noise's variance, of a mask
            and the noise; None where there is none to be seen.
        usable: (...,) bool, whether all of it is finite; None: it is for all.
    """

    innovation: Tensor
    columns: Columns
    error: _Error | None = None
    usable: Tensor | None = None

    def masked(self, mask: Tensor, unit_noise: bool) -> "LinearisedMeasurement":
        """With nothing of the components where the mask (..., m) is False, see `Columns.masked`."""
        innovation = torch.where(mask, self.innovation, 0.0)
        return replace(self, innovation=innovation, columns=self.columns.masked(mask, unit_noise))


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """How a filter linearises models about states of a space.

    Attributes:
        transform: how a Gaussian goes through a function.
        space: manifold of the state; None: R^n.
    """

    transform: Transform
    space: Space | None

    @property
    def chart(self) -> Difference | None:
        """(points, reference) -> tangent at the reference; None in R^n, where it is their difference."""
        space = self.space
        if space is None or is_flat(space):
            return None
        return lambda points, reference: space.local(reference, points)

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        """point [+] tangent."""
        if self.space is not None:
            return self.space.retract(point, tangent)
        # Components before the batch, so that what is computed is batch-last in memory.
        return (point.mT + tangent.mT).mT if point.ndim > 1 else point + tangent

    def carry(self, point: Tensor, shift: Tensor | None, root: Tensor, target: Tensor) -> list[Tensor]:
        """Deviations (..., n, c), in the chart at `target`, of a belief in the chart at `point` with mean `shift`.

        In R^n, and where a space carries tangents as they are, they are the root itself. With a shift, the target is
        point [+] shift.
        """
        chart = self.chart
        if chart is None or self.space is None or getattr(self.space, "parallel", False):
            return [root]
        if isinstance(self.transform, Taylor):
            maps, directions = tangent_maps(self.space), root.movedim(-1, 0)
            if shift is None:
                carried = maps.transport_back(target, self.space.local(target, point), directions)
            else:
                carried = maps.transport(point, shift, directions)
            return [carried.movedim(0, -1)]
        return self.transform(
            lambda offsets: chart(self.retract(point, offsets if shift is None else shift + offsets), target),
            root,
            None,
        ).columns.all()

    def require_flat(self, model: str) -> None:
        """Raises TypeError if the state is not in R^n."""
        if self.chart is not None:
            raise TypeError(f"{model} is for states in R^n; on a manifold use a model with a function")

    def motion(
        self, mean: Tensor, root: Tensor, motion: AnyMotion, noise: Noise, inputs: tuple[Tensor, ...]
    ) -> Transformed:
        """The moved state, and deviations of it, from a belief with mean (..., p) and root (..., n, n).

        The odd columns of noise that is not additive come after the n of the state.

        Raises:
            TypeError: a `LinearMotion` on a manifold.
        """
        if isinstance(motion, LinearMotion):
            self.require_flat("LinearMotion")
            return Transformed(None, motion.function(mean, *inputs), Columns(multiply(motion.matrix, root)))
        size = root.shape[-1]
        transform = self.transform
        if isinstance(transform, Taylor):
            if motion.jacobian is None:
                columns = root if motion.additive else block_diagonal(root, noise.factor())
                value, slopes = self._differentiate(motion, mean, None, columns, size, inputs)
                if self.space is None or self.chart is None:
                    return Transformed(None, value, Columns(slopes.movedim(0, -1)))
                slopes = tangent_maps(self.space).push_local(value, slopes)
                return Transformed(value, torch.zeros_like(slopes[0]), Columns(slopes.movedim(0, -1)))
            transform = Taylor(motion.jacobian(mean, *inputs))

        def evaluate(offsets: Tensor) -> Tensor:
            if motion.additive:
                return motion.evaluate(self.retract(mean, offsets), *inputs)
            return motion.evaluate(self.retract(mean, offsets[..., :size]), offsets[..., size:], *inputs)

        columns = root if motion.additive else block_diagonal(root, noise.factor())
        return transform(evaluate, columns, self.chart, self.retract)

    def measurement(
        self,
        mean: Tensor,
        root: Tensor,
        measurement: AnyMeasurement,
        noise: Noise,
        value: Tensor,
        inputs: tuple[Tensor, ...],
        previous: TangentPosterior | None,
    ) -> LinearisedMeasurement:
        """Innovation and deviations of a linearisation at the prior, or at the posterior of the previous one."""
        if isinstance(measurement, LinearMeasurement):
            self.require_flat("LinearMeasurement")
            innovation = value - measurement.evaluate(mean, *inputs)
            return LinearisedMeasurement(innovation, Columns(multiply(measurement.matrix, root)))
        size = root.shape[-1]
        shift = None if previous is None else previous.shift
        spread = None if previous is None else previous.spread()
        columns = root if spread is None else multiply(root, spread)
        transform = self.transform
        # A given derivative is in the chart of the point that it is taken at, which is the prior's only at first.
        in_chart = shift is None or self.chart is None
        if isinstance(transform, Taylor) and measurement.jacobian is not None and in_chart:
            transform = Taylor(measurement.jacobian(mean if shift is None else mean + shift, *inputs))

        def evaluate(offsets: Tensor) -> Tensor:
            moved = offsets if measurement.additive else offsets[..., :size]
            state = self.retract(mean, moved if shift is None else shift + moved)
            if measurement.additive:
                return measurement.evaluate(state, *inputs)
            return measurement.evaluate(state, offsets[..., size:], *inputs)

        offsets = columns if measurement.additive else block_diagonal(columns, noise.factor())
        if isinstance(transform, Taylor) and transform.jacobian is None:
            at, slopes = self._differentiate(measurement, mean, shift, offsets, size, inputs)
            expected, reference, residual = at, None, measurement.residual
            if residual is not None:
                values, slopes = push_forward(lambda z: residual(z, at), [at + torch.zeros_like(slopes)], [slopes])
                expected, reference = values[0], at
            seen = Transformed(reference, expected, Columns(slopes.movedim(0, -1)))
        else:
            seen = transform(evaluate, offsets, measurement.residual)
        if seen.mean.shape[-1] != value.shape[-1]:
            raise ValueError(
                f"the measurement's function returns {seen.mean.shape[-1]} components, the value has {value.shape[-1]}"
            )
        innovation = seen.from_mean(value, measurement.residual)
        seen_columns = seen.columns if measurement.additive else seen.columns.without_noise(size)
        if previous is None or spread is None:
            return LinearisedMeasurement(innovation, seen_columns, self._error(measurement, seen.columns, size))
        # The slope was taken along L M; the update wants it along L, and M is far from singular.
        odd = solve_lower_transposed(spread, seen_columns.odd.mT).mT
        return LinearisedMeasurement(
            innovation + apply(odd, previous.mean), Columns(odd, seen_columns.even, seen_columns.negative)
        )

    def _differentiate(
        self,
        model: NonlinearModel,
        mean: Tensor,
        shift: Tensor | None,
        columns: Tensor,
        size: int,
        inputs: tuple[Tensor, ...],
    ) -> tuple[Tensor, Tensor]:
        """A model's value (..., m) at mean [+] shift, and its changes (k, ..., m) along tangents, columns (..., ·, k).

        Only the model's function is differentiated; the retraction has closed forms. Columns have the noise's rows, if
        the noise is not additive, after the first `size`.
        """
        directions = columns.movedim(-1, 0)
        along = directions[..., :size]
        if self.chart is None or self.space is None:
            point = mean if shift is None else mean + shift
        else:
            maps = tangent_maps(self.space)
            if shift is not None:
                along = maps.transport(mean, shift, along)
            point = self.retract(mean, torch.zeros_like(along[0]) if shift is None else shift)
            along = maps.push_retract(point, along)
        # One copy of the point for each direction, in their memory order.
        points = point + torch.zeros_like(along)
        if model.additive:
            values, slopes = push_forward(lambda x: model.evaluate(x, *inputs), [points], [along])
        else:
            noise = directions[..., size:]
            values, slopes = push_forward(
                lambda x, w: model.evaluate(x, w, *inputs), [points, torch.zeros_like(noise)], [along, noise]
            )
        return values[0], slopes

    def _error(self, measurement: MeasurementModel, columns: Columns, size: int) -> _Error | None:
        """Makes the error of a linearisation, as far as the transform can see any; None: as good as none."""
        if isinstance(self.transform, Unscented) and not self.transform.points.sees_error:
            # Nothing shows whether a second linearisation is worth while: it is made.
            return lambda mask, noise: torch.full_like(columns.odd[..., 0, 0], torch.inf)
        even = columns.even
        if even is None:
            return None

        def error(mask: Tensor | None, noise: Noise) -> Tensor:
            variance = noise.variance() if measurement.additive else columns.odd[..., size:].square().sum(dim=-1)
            # Where there is no noise, no error is small.
            share = (even * even).sum(dim=-1) / variance.clamp_min(torch.finfo(variance.dtype).tiny)
            return (share if mask is None else torch.where(mask, share, 0.0)).sum(dim=-1)

        return error
