"""Maximum likelihood (9.1)-(9.7) and maximum a posteriori (9.8)-(9.20) estimates by Gauss-Newton, batched.

Both minimise 1/2 sum_k |z_k - h_k(x)|^2 in the norms of R_k^-1; the second adds the prior as one more observation, of x
itself: Z = [z; x^-], g(x) = [h(x); x], C = diag(R, P). `sigmaslam_filters.gauss_newton` takes the steps.

(9.15) and (9.17) are printed with the wrong sign: the correction is + K (z - h(x)).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import identity, solve_lower, triangularise
from sigmaslam_filters.core.failure import FilterError, name_elements
from sigmaslam_filters.core.noise_covariance import Dense, Rooted, as_noise
from sigmaslam_filters.core.tensors import shapes_of
from sigmaslam_filters.gauss_newton import LeastSquares, Minimum, Term, gauss_newton, holds_everywhere
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.manifolds import Space, is_flat
from sigmaslam_filters.models import AnyMeasurement, LinearMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What one sensor measured, z = h(x, *inputs) + v.

    Attributes:
        model: h and the noise of v, which must be additive.
        value: (..., m) z; NaN for a component that is missing.
        inputs: passed on to the model's function, each of batch shape (..., ·): landmarks, calibration.
        weight: factor >= 0 on the information, of the observation (...,) or of each component (..., m); 0 leaves out,
            as NaN does. One for each component has all batch dimensions, be they of size 1. It divides variances and
            keeps correlations. None: 1.
    """

    model: AnyMeasurement
    value: Tensor
    inputs: tuple[Tensor, ...] = ()
    weight: Tensor | float | None = None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class PointEstimate:
    """The state that explains the observations best.

    Attributes:
        belief: the estimate, and its covariance (held by a root) in the chart there: the inverse of the information
            H^T R^-1 H (+ P^-1), linearised where the last step was taken from, as in (9.19) and (9.20).
        cost: (...,) 1/2 of the weighted squares that remain, those of the prior included; (9.5), (9.7) with the square.
        degrees_of_freedom: (...,) number of components that took part, without a prior less the unknowns. For linear
            models with the right noise, twice the cost is chi-square distributed with as many.
        iterations: (...,) steps taken.
        converged: (...,) bool. False where `iterations` ran out, or no step lowers the cost.
        healthy: (...,) bool, False for elements that could not be estimated. Those keep the prior; without one, the
            initial value and a covariance of NaN.
    """

    belief: Gaussian
    cost: Tensor
    degrees_of_freedom: Tensor
    iterations: Tensor
    converged: Tensor
    healthy: Tensor

    __repr__ = shapes_of


def maximum_likelihood(
    observations: Sequence[Observation],
    initial: Tensor,
    space: Space | None = None,
    *,
    iterations: int = 20,
    tolerance: float = 1e-10,
    on_failure: Literal["raise", "hold"] = "raise",
) -> PointEstimate:
    """The state under which the observations are likeliest, (9.1)-(9.7).

    If all models are `LinearMeasurement`, this is weighted least squares, and one step. Else steps go on, element by
    element; one that raises the cost is halved, up to ten times, and an element that has converged stays as it is.

    Args:
        observations: at least one.
        initial: (..., p) where to start. Its leading dimensions, with those of the values, are the batch.
        space: manifold of the state; None: R^n.
        iterations: at most so many steps.
        tolerance: an element has converged when its step is no longer than this, in standard deviations of the
            estimate; or where round-off keeps steps from getting any shorter.
        on_failure: "raise", or "hold", which flags elements as not healthy.
    Raises:
        FilterError: for some element the observations do not determine the state, noise is not positive definite, or
            residuals are not finite; and on_failure is "raise". The message names elements, cause, and the direction
            that nothing sees.
        TypeError: a `LinearMeasurement` on a curved space or with inputs.
        ValueError: noise that is not additive, a negative weight, or shapes or dtypes that do not fit.
    """
    _check_options(iterations, on_failure)
    if not observations:
        raise ValueError("maximum_likelihood needs at least one observation; without any there is only the prior")
    batch = _batch(initial, observations)
    terms = [_prepare(k, observation, initial, batch, space) for k, observation in enumerate(observations)]
    size = initial.shape[-1] if space is None else space.tangent_size
    root = identity(size, initial).expand(*batch, size, size)
    start = initial.expand(*batch, initial.shape[-1])
    problem = LeastSquares(terms, space, root, has_prior=False)
    failed_estimate = Gaussian(start, factor=torch.full_like(root, torch.nan), factor_is_lower=True)
    return _estimate("maximum likelihood", problem, failed_estimate, None, iterations, tolerance, on_failure)


def maximum_a_posteriori(
    prior: Gaussian,
    observations: Sequence[Observation],
    space: Space | None = None,
    *,
    iterations: int = 20,
    tolerance: float = 1e-10,
    on_failure: Literal["raise", "hold"] = "raise",
) -> PointEstimate:
    """The likeliest state given prior and observations, (9.8)-(9.20).

    Starts at the mean of the prior; the first step is the Kalman update, and at convergence it is the iterated extended
    Kalman filter. Steps, arguments and errors are as those of `maximum_likelihood`.

    Args:
        prior: batch (...,), held by covariance or root; the covariance may be semidefinite.
        observations: any number. The batch is that of the prior, with those of the values.
        space: manifold of the state; None: R^n.
        iterations: at most so many steps.
        tolerance: length of a step, in standard deviations of the posterior, at which an element has converged.
        on_failure: "raise", or "hold", which flags elements as not healthy and gives the prior for them.
    Raises:
        FilterError: an element's prior covariance is not positive semidefinite, noise is not positive definite,
            residuals are not finite, or the digits of the dtype do not suffice for both prior and observations; and
            on_failure is "raise".
        TypeError: a `LinearMeasurement` on a curved space or with inputs.
        ValueError: noise that is not additive, a negative weight, or shapes or dtypes that do not fit.
    """
    _check_options(iterations, on_failure)
    batch = _batch(prior.mean, observations)
    terms = [_prepare(k, observation, prior.mean, batch, space) for k, observation in enumerate(observations)]
    root, sound = prior.checked_factor()
    start = Gaussian(
        prior.mean.expand(*batch, prior.mean.shape[-1]),
        factor=root.expand(*batch, *root.shape[-2:]),
        factor_is_lower=True,
    )
    if sound is not None:
        sound = sound.expand(batch)
    problem = LeastSquares(terms, space, start.factor, has_prior=True)
    return _estimate("maximum a posteriori", problem, start, sound, iterations, tolerance, on_failure)


def _estimate(
    stage: str,
    problem: LeastSquares,
    start: Gaussian,
    sound_prior: Tensor | None,
    iterations: int,
    tolerance: float,
    on_failure: Literal["raise", "hold"],
) -> PointEstimate:
    terms = problem.terms
    causes = [] if sound_prior is None else [("the prior covariance is not positive semidefinite", sound_prior)]
    causes += [
        (f"the noise covariance of observation {k} is not positive definite", term.sound)
        for k, term in enumerate(terms)
    ]
    sound = torch.ones_like(start.mean[..., 0], dtype=torch.bool)
    for _, holds in causes:
        sound = sound & holds
    solution = gauss_newton(problem, start.mean, sound, iterations, tolerance)
    causes.append(("a residual or a derivative is not finite", solution.finite))
    text = "the observations do not determine the state"
    if problem.has_prior:
        text = f"prior and observations differ in precision by more than the digits of {start.mean.dtype}"
    causes.append((text, solution.determined))
    healthy = sound & solution.finite & solution.determined
    if on_failure == "raise" and not bool(healthy.all()):
        _raise(stage, healthy, causes, problem, solution)

    mean = problem.state(solution.anchor, solution.zeta)
    columns = problem.columns(solution.anchor, solution.zeta, mean)
    factor = triangularise([solve_lower(solution.factor, columns.mT).mT])
    belief = Gaussian(mean, factor=factor, factor_is_lower=True).where(healthy, start)
    freedom = torch.zeros_like(solution.iterations) - (0 if problem.has_prior else problem.root.shape[-1])
    for term in terms:
        freedom = freedom + term.count
    return PointEstimate(belief, solution.cost, freedom, solution.iterations, solution.converged, healthy)


def _prepare(k: int, observation: Observation, like: Tensor, batch: torch.Size, space: Space | None) -> Term:
    model, value = observation.model, observation.value
    if isinstance(model, LinearMeasurement):
        if not is_flat(space) or observation.inputs:
            raise TypeError(
                f"observation {k}: LinearMeasurement is for states in R^n and takes no inputs; use MeasurementModel"
            )
    elif not model.additive:
        raise ValueError(f"observation {k}: only additive noise is supported; use a filter, or make the noise additive")
    noise = as_noise(model.noise)
    if (size := noise.variance().shape[-1]) != value.shape[-1]:
        raise ValueError(f"observation {k}: the value has {value.shape[-1]} components, its noise {size}")
    if value.dtype != like.dtype:
        raise ValueError(f"observation {k}: the value is {value.dtype}, the state {like.dtype}")
    value = value.expand(*batch, value.shape[-1])
    present, scale = ~torch.isnan(value), None
    if model.mask is not None:
        present = present & model.mask
    if observation.weight is not None:
        weight = _expand_weight(k, observation.weight, value)
        present = present & (weight > 0)
        scale = torch.sqrt(torch.where(weight > 0, weight, 1.0))
    mask = None if holds_everywhere(present) else present
    if mask is not None:
        value, noise = torch.where(mask, value, 0.0), noise.masked(mask)
    if isinstance(noise, Dense):
        noise = Rooted(noise.factor())  # once, not at every step
    sound = torch.isfinite(noise.log_determinant())
    return Term(model, value, observation.inputs, noise, mask, scale, present.sum(dim=-1), sound)


def _expand_weight(k: int, weight: Tensor | float, value: Tensor) -> Tensor:
    """One weight for each component of the value (..., m)."""
    weight = torch.as_tensor(weight, dtype=value.dtype, device=value.device)
    try:
        weight = (weight if weight.ndim == value.ndim else weight.unsqueeze(-1)).expand_as(value)
    except RuntimeError:
        raise ValueError(
            f"observation {k}: a weight has shape {tuple(value.shape[:-1])}, or {tuple(value.shape)} to weight each "
            f"component (sizes may be 1), got {tuple(weight.shape)}"
        ) from None
    if not torch.compiler.is_compiling() and not bool((weight >= 0).all()):
        raise ValueError(f"observation {k}: weights must be at least 0, the smallest is {float(weight.min())}")
    return weight


def _batch(mean: Tensor, observations: Sequence[Observation]) -> torch.Size:
    shapes = [mean.shape[:-1], *(observation.value.shape[:-1] for observation in observations)]
    try:
        return torch.broadcast_shapes(*shapes)
    except RuntimeError:
        raise ValueError(
            f"batches of state and values do not broadcast: {', '.join(str(tuple(shape)) for shape in shapes)}"
        ) from None


def _check_options(iterations: int, on_failure: str) -> None:
    if iterations < 1:
        raise ValueError(f"iterations is {iterations}; it must be at least 1")
    if on_failure not in ("raise", "hold"):
        raise ValueError(f"on_failure is {on_failure!r}; choose raise or hold")


def _raise(
    stage: str, healthy: Tensor, causes: Sequence[tuple[str, Tensor]], problem: LeastSquares, solution: Minimum
) -> None:
    first = tuple((~healthy).nonzero()[0].tolist())
    cause = next(text for text, holds in causes if not bool(holds.expand_as(healthy)[first]))
    if not problem.has_prior and bool(solution.finite[first]) and not bool(solution.determined[first]):
        triangle = problem.triangle(solution.anchor, solution.zeta)[first].detach()
        size = triangle.shape[-1] - 1
        lengths = torch.linalg.vector_norm(triangle[:size, :size], dim=-1)
        lengths = torch.where(lengths > 0, lengths, 1.0)
        unseen = torch.linalg.svd(triangle[:size, :size].mT / lengths).Vh[-1] / lengths
        unseen = unseen / unseen[unseen.abs().argmax()]
        direction = ", ".join(f"{number:.3g}" for number in torch.where(unseen.abs() < 1e-6, 0.0, unseen).tolist())
        cause += f": none of them sees the tangent direction [{direction}]; add observations, or a prior"
    where = f" for {name_elements(healthy)}, in the first" if healthy.ndim else ""
    raise FilterError(f"{stage} failed{where}: {cause}. on_failure='hold' goes on without them.")
