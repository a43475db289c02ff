"""Motions and measurements as objects: a function, its noise, and how its values are compared."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import apply, is_traced, may_look
from sigmaslam_filters.core.noise_covariance import BlockDiagonal, Diagonal, Noise, as_noise
from sigmaslam_filters.core.tensors import require_tensor, shapes_of

Function = Callable[..., Tensor]
Residual = Callable[[Tensor, Tensor], Tensor]


_READ = "It is called once for all sigma points: read components as x[..., i] and join them with stack"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class NonlinearModel:
    """What `MotionModel` and `MeasurementModel` have in common: y = f(x, *inputs) + w, or y = f(x, w, *inputs).

    The function is called once for all sigma points: with states (k, ..., p) and, if the noise is not additive, noise
    (k, ..., q), while inputs have the batch shape (..., ·) and broadcast. Components are read as `x[..., i]`.

    Attributes:
        function: f, to (k, ..., m) of states or measurements.
        noise: covariance (..., q, q) of w, or a `Noise`.
        additive: whether w is added to f(x).
        jacobian: derivative of f (and of w, side by side) in tangent coordinates, called like the function at one
            point, (..., m, n) or (..., m, n + q); None: by automatic differentiation. Only the EKF asks for it.
    """

    function: Function
    noise: Noise | Tensor
    additive: bool = True
    jacobian: Function | None = None

    __repr__ = shapes_of

    def evaluate(self, states: Tensor, *others: Tensor) -> Tensor:
        """The function of states (k, ..., p), and of noise and inputs.

        Raises:
            TypeError: it takes other arguments, or returns something else than a tensor.
            ValueError: what it returns is no (k, ..., m).
        """
        if is_traced():
            return self.function(states, *others)
        name = f"{type(self).__name__}.function"
        try:
            values = self.function(states, *others)
        except TypeError as error:
            self._check_arguments(name, states, *others)
            raise TypeError(f"{name} of states {tuple(states.shape)}: {error}. {_READ}") from error
        except IndexError as error:
            raise ValueError(f"{name} of states {tuple(states.shape)}: {error}. {_READ}") from error
        require_tensor(f"what {name} returns", values)
        lead, expected = values.shape[:-1], states.shape[:-1]
        fits = len(lead) >= len(expected) and lead[0] == expected[0]
        # Of as many copies of a state as it has components x[i] has the shape of x[..., i], but not its value.
        if fits and states.shape[:-1] == states.shape[1:] != (1,) and may_look(states):
            copies = torch.equal(states[0].detach(), states[1].detach())
            fits = not copies or torch.allclose(values[0].detach(), values[1].detach(), rtol=1e-3, equal_nan=True)
        if not fits or any(a not in (b, 1) for a, b in zip(expected[::-1], lead[::-1], strict=False)):
            raise ValueError(
                f"{name} of states {tuple(states.shape)} returned {tuple(values.shape)}; "
                f"{(*expected, 'm')} expected. {_READ}"
            )
        return values

    def _check_arguments(self, name: str, *given: Tensor) -> None:
        """Raises TypeError if the function takes another number of arguments."""
        try:
            parameters = inspect.signature(self.function)
        except ValueError:
            return
        try:
            parameters.bind(*given)
        except TypeError:
            takes = "the state" + ("" if self.additive else ", the noise")
            inputs = len(given) - (1 if self.additive else 2)
            raise TypeError(f"{name} takes {parameters}, but was given {takes} and {inputs} inputs") from None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MotionModel(NonlinearModel):
    """How a state moves: x' = f(x, *inputs) [+] w, or x' = f(x, w, *inputs); see `NonlinearModel`.

    Attributes:
        noise_matrix: B2 (..., n, q) of (9.22): additive noise enters as B2 w, in the tangent at f(x); None: w.
    """

    noise_matrix: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class MeasurementModel(NonlinearModel):
    """What a sensor sees: z = h(x, *inputs) + v, or z = h(x, v, *inputs); see `NonlinearModel`.

    A component that is NaN in the measured value, or False in the mask, has weight zero. A `Diagonal` or
    `BlockDiagonal` noise keeps the cost of an update linear in m.

    Attributes:
        residual: (measured (..., m), predicted (..., m)) -> their difference, where that is not a plain difference
            (an angle, see `wrap_angle`); None: subtraction.
        mask: (..., m) bool, True for components that take part; None: all.
        block_size: components that are right or wrong together, side by side, for gates and robust weights; None: the
            blocks of a `BlockDiagonal` noise, else all components.
    """

    residual: Residual | None = None
    mask: Tensor | None = None
    block_size: int | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LinearMotion:
    """x' = A x + B1 u + B2 w, (9.22); on R^n. `predict` takes u as its input when there is a B1.

    Attributes:
        matrix: A (..., n, n).
        noise: covariance Q (..., q, q) of w, or a `Noise`.
        control_matrix: B1 (..., n, c).
        noise_matrix: B2 (..., n, q); None: the identity.
    """

    matrix: Tensor
    noise: Noise | Tensor
    control_matrix: Tensor | None = None
    noise_matrix: Tensor | None = None

    __repr__ = shapes_of

    def evaluate(self, state: Tensor, *inputs: Tensor) -> Tensor:
        """As `function`."""
        return self.function(state, *inputs)

    def function(self, state: Tensor, *inputs: Tensor) -> Tensor:
        """A x + B1 u for (..., n) and (..., c)."""
        moved = apply(self.matrix, state)
        if self.control_matrix is not None:
            if len(inputs) != 1:
                raise ValueError("this motion has a control matrix: give predict the control (..., c)")
            moved = moved + apply(self.control_matrix, inputs[0])
        elif inputs:
            raise ValueError("an input was given, but this motion has no control matrix")
        return moved


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LinearMeasurement:
    """z = H x + v, (9.22); on R^n.

    Attributes:
        matrix: H (..., m, n).
        noise: covariance R (..., m, m) of v, or a `Noise`.
        mask: (..., m) bool, True for components that take part; None: all.
        block_size: as `MeasurementModel`.
    """

    matrix: Tensor
    noise: Noise | Tensor
    mask: Tensor | None = None
    block_size: int | None = None

    __repr__ = shapes_of

    def evaluate(self, state: Tensor, *inputs: Tensor) -> Tensor:
        """As `function`, which takes no inputs."""
        if inputs:
            raise ValueError("an input was given, but a LinearMeasurement takes none")
        return self.function(state)

    def function(self, state: Tensor) -> Tensor:
        """H x for (..., n)."""
        return apply(self.matrix, state)


def is_additive(model: "AnyMotion | AnyMeasurement") -> bool:
    """Whether the model's noise is added to what its function returns."""
    return isinstance(model, LinearMotion | LinearMeasurement) or model.additive


def several(measurement: "AnyMeasurement", count: int) -> "AnyMeasurement":
    """The measurement taken `count` times at one time, of what its inputs name: landmarks, beacons.

    Values are (..., count m), end to end, and inputs (..., count, ·); each has the noise of its own, independent of
    the others', and is a block to gates and robust weights.

    Args:
        measurement: of m components.
        count: how many.
    Raises:
        ValueError: the noise is not additive, which would be noise of all in each.
    """
    one = as_noise(measurement.noise)
    noise, block_size = _repeated(one, count), measurement.block_size
    if block_size is None:
        block_size = one.block_size if isinstance(one, BlockDiagonal) else one.variance().shape[-1]
    mask = measurement.mask
    if mask is not None:
        mask = mask.unsqueeze(-2).expand(*mask.shape[:-1], count, mask.shape[-1]).flatten(-2)
    if isinstance(measurement, LinearMeasurement):
        matrix = measurement.matrix
        rows = matrix.unsqueeze(-3).expand(*matrix.shape[:-2], count, *matrix.shape[-2:])
        return LinearMeasurement(rows.flatten(-3, -2), noise, mask, block_size)
    if not measurement.additive:
        raise ValueError("several measurements at one time need additive noise")

    residual, see, slope = measurement.residual, measurement.function, measurement.jacobian

    def values(state: Tensor, *inputs: Tensor) -> Tensor:
        each = see(state.unsqueeze(-2), *inputs)
        return each.expand(*each.shape[:-2], count, each.shape[-1]).flatten(-2)

    def slopes(state: Tensor, *inputs: Tensor) -> Tensor:
        assert slope is not None
        each = slope(state.unsqueeze(-2), *inputs)
        return each.expand(*each.shape[:-3], count, *each.shape[-2:]).flatten(-3, -2)

    def differences(measured: Tensor, predicted: Tensor) -> Tensor:
        assert residual is not None
        measured, predicted = (each.unflatten(-1, (count, -1)) for each in (measured, predicted))
        return residual(measured, predicted).flatten(-2)

    return MeasurementModel(
        values,
        noise,
        jacobian=None if slope is None else slopes,
        residual=None if residual is None else differences,
        mask=mask,
        block_size=block_size,
    )


def _repeated(noise: Noise, count: int) -> Noise:
    """Independent noises of one covariance."""
    if isinstance(noise, Diagonal):
        variance = noise.variance().unsqueeze(-2)
        return Diagonal(variance.expand(*variance.shape[:-2], count, variance.shape[-1]).flatten(-2))
    block = noise.covariance().unsqueeze(-3)
    return BlockDiagonal(block.expand(*block.shape[:-3], count, *block.shape[-2:]))


AnyMotion = MotionModel | LinearMotion
AnyMeasurement = MeasurementModel | LinearMeasurement
MOTIONS, MEASUREMENTS = (MotionModel, LinearMotion), (MeasurementModel, LinearMeasurement)
