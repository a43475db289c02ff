"""Motions and measurements as objects: a function, its noise, and how its values are compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from sigmaslam.filters.linalg.square_roots import apply
from sigmaslam.filters.noise_covariance import Noise

Function = Callable[..., Tensor]
Residual = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True, slots=True, eq=False)
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


@dataclass(frozen=True, slots=True, eq=False)
class MotionModel(NonlinearModel):
    """How a state moves: x' = f(x, *inputs) [+] w, or x' = f(x, w, *inputs); see `NonlinearModel`.

    Attributes:
        noise_matrix: B2 (..., n, q) of (9.22): additive noise enters as B2 w, in the tangent at f(x); None: w.
    """

    noise_matrix: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementModel(NonlinearModel):
    """What a sensor sees: z = h(x, *inputs) + v, or z = h(x, v, *inputs); see `NonlinearModel`.

    A component that is NaN in the measured value, or False in the mask, has weight zero. A `Diagonal` or
    `BlockDiagonal` noise keeps the cost of an update linear in m.

    Attributes:
        residual: (measured (..., m), predicted (..., m)) -> their difference, where that is not a plain difference
            (an angle, see `wrap_angle`); None: subtraction.
        mask: (..., m) bool, True for components that take part; None: all.
    """

    residual: Residual | None = None
    mask: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
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


@dataclass(frozen=True, slots=True, eq=False)
class LinearMeasurement:
    """z = H x + v, (9.22); on R^n.

    Attributes:
        matrix: H (..., m, n).
        noise: covariance R (..., m, m) of v, or a `Noise`.
        mask: (..., m) bool, True for components that take part; None: all.
    """

    matrix: Tensor
    noise: Noise | Tensor
    mask: Tensor | None = None

    def function(self, state: Tensor) -> Tensor:
        """H x for (..., n)."""
        return apply(self.matrix, state)


AnyMotion = MotionModel | LinearMotion
AnyMeasurement = MeasurementModel | LinearMeasurement
