"""Arguments that do not fit are refused here, by messages that name the model, the argument and the mend."""

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import is_traced
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.tensors import require_dtype, require_tensor
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.manifolds import Space
from sigmaslam_filters.models import AnyMeasurement, AnyMotion, LinearMeasurement, LinearMotion

# What to do where a batch is none.
BY_TIME = "What changes with time is given as a list of models, one for each step"


def check_space(space: object) -> None:
    """A space has two functions and two sizes.

    Raises:
        TypeError: it has not.
    """
    lacks = [name for name in ("retract", "local", "point_size", "tangent_size") if not hasattr(space, name)]
    if space is not None and (lacks or isinstance(space, type)):
        shown = f"the class {space.__name__}" if isinstance(space, type) else repr(space)
        raise TypeError(
            f"space is {shown}: give a manifold such as SE2(), or an object with retract, local, point_size and "
            "tangent_size; None is R^n"
        )


def check_belief(belief: Gaussian, space: Space | None) -> None:
    """In R^n a mean has as many components as the covariance has rows.

    Raises:
        ValueError: it has not.
    """
    if space is None and belief.mean.shape[-1] != belief.size:
        n = belief.size
        raise ValueError(
            f"the mean has {belief.mean.shape[-1]} components, the covariance is {n} x {n}: in R^n they agree; for "
            "points of a manifold give the filter its space"
        )


def check_model(given: object, kinds: tuple[type, ...], where: str) -> None:
    """A motion is one, and a measurement one.

    Raises:
        TypeError: it is something else, such as the other one.
    """
    if not isinstance(given, kinds):
        names = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(
            f"{where} must be a {names}, got {type(given).__name__}: Event and filter take the motion first"
        )


def check_inputs(inputs: tuple[Tensor, ...]) -> None:
    """Inputs are tensors; their shapes are the model's business.

    Raises:
        TypeError: one is something else.
    """
    for k, given in enumerate(inputs):
        require_tensor(f"input {k} of the model", given)


def check_motion(motion: AnyMotion, noise: Noise, belief: Gaussian) -> None:
    """Sizes of what a motion is made of, as far as they show before its function is called.

    Raises:
        ValueError: a matrix or the noise does not fit the belief.
    """
    kind, n = type(motion).__name__, belief.size
    variance = noise.variance()
    require_dtype(f"{kind}.noise", variance, belief.mean.dtype)
    _check_batch(f"{kind}.noise", variance.shape[:-1], belief.batch_shape)
    if isinstance(motion, LinearMotion):
        _check_batch(f"{kind}.matrix", motion.matrix.shape[:-2], belief.batch_shape)
        require_dtype(f"{kind}.matrix", motion.matrix, belief.mean.dtype)
        if motion.matrix.shape[-2:] != (n, n):
            raise ValueError(f"{kind}.matrix is {tuple(motion.matrix.shape)}, but the state asks for {n} x {n}")
        check_entering(motion, noise, n)


def check_entering(motion: AnyMotion, noise: Noise, components: int) -> None:
    """Additive noise has as many components as the moved state, or as its matrix has columns.

    Raises:
        ValueError: it has not.
    """
    kind, given = type(motion).__name__, noise.variance().shape[-1]
    matrix = motion.noise_matrix
    if matrix is None:
        if given != components:
            raise ValueError(
                f"{kind}.noise is {given} x {given}, but {kind}.function returns {components} components: "
                f"{components} x {components} expected"
            )
    elif matrix.shape[-2:] != (components, given):
        raise ValueError(
            f"{kind}.noise is {given} x {given}, but {matrix.shape[-1]} x {matrix.shape[-1]} was expected for a "
            f"noise_matrix of shape {tuple(matrix.shape)} and {components} states"
        )


def check_update(
    belief: Gaussian,
    space: Space | None,
    measurement: AnyMeasurement,
    noise: Noise,
    value: Tensor,
    inputs: tuple[Tensor, ...],
) -> torch.Size:
    """Sizes of what an update is given, as far as they show before the model's function is called.

    Returns:
        the batch of the belief and the value together.
    Raises:
        TypeError: the value or an input is no tensor.
        ValueError: the belief, the value, the noise, the mask or the matrix does not fit.
    """
    require_tensor("the value", value)
    if not value.ndim:
        raise ValueError("the value has no dimension: (..., m) is expected, of one component (1,)")
    check_belief(belief, space)
    check_inputs(inputs)
    kind, m = type(measurement).__name__, value.shape[-1]
    require_dtype("the value", value, belief.mean.dtype)
    if isinstance(measurement, LinearMeasurement):
        require_dtype(f"{kind}.matrix", measurement.matrix, belief.mean.dtype)
        rows, columns = measurement.matrix.shape[-2:]
        if columns != belief.size:
            shape = tuple(measurement.matrix.shape)
            raise ValueError(f"{kind}.matrix is {shape}, but a state of {belief.size} asks for {belief.size} columns")
        if rows != m:
            raise ValueError(f"this {kind} has {rows} components, the value has {m}")
        _check_batch(f"{kind}.matrix", measurement.matrix.shape[:-2], belief.batch_shape)
    variance = noise.variance()
    require_dtype(f"{kind}.noise", variance, belief.mean.dtype)
    if isinstance(measurement, LinearMeasurement) or measurement.additive:
        given = variance.shape[-1]
        if given != m:
            returned = measurement.evaluate(belief.mean.unsqueeze(0), *inputs).shape[-1]
            if returned == given:
                raise ValueError(
                    f"the value has {m} components, but {kind}.function returns {returned} and its noise is "
                    f"{given} x {given}"
                )
            raise ValueError(
                f"{kind}.noise is {given} x {given}, but its function returns {returned} components and the value has "
                f"{m}: {returned} x {returned} expected"
            )
    if measurement.mask is not None:
        if measurement.mask.shape[-1] != m:
            raise ValueError(f"{kind}.mask is {tuple(measurement.mask.shape)}, but the value has {m} components")
        _check_batch(f"{kind}.mask", measurement.mask.shape[:-1], belief.batch_shape)
    _check_batch("the value", value.shape[:-1], belief.batch_shape)
    batch = belief.batch_shape
    if value.shape[:-1] != batch:
        batch = torch.broadcast_shapes(batch, value.shape[:-1])
    _check_batch(f"{kind}.noise", variance.shape[:-1], batch)
    return batch


def _check_batch(name: str, given: torch.Size, expected: torch.Size) -> None:
    if not given or given == expected or is_traced():
        return
    try:
        torch.broadcast_shapes(given, expected)
    except RuntimeError:
        raise ValueError(
            f"the batch of {name} {tuple(given)} does not broadcast to that of the belief, {tuple(expected)}. {BY_TIME}"
        ) from None
