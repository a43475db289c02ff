"""Maximum likelihood (9.1)-(9.7) and maximum a posteriori (9.8)-(9.20) estimates by Gauss-Newton, batched.

Both minimise 1/2 sum_k |z_k - h_k(x)|^2 in the norms of R_k^-1; the second adds the prior as one more observation, of x
itself: Z = [z; x^-], g(x) = [h(x); x], C = diag(R, P). Each step is the least-squares problem of the whitened
derivative [R^-1/2 H] and residual, solved by its triangular factor (QR); normal equations, which lose half of the
digits, are never formed. A prior is whitened by the unknown: x = x^- [+] L zeta with L L^T = P, zeta ~ N(0, I), so that
P is not inverted and may hold directions that are known exactly.

(9.15) and (9.17) are printed with the wrong sign: the correction is + K (z - h(x)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from sigmaslam.filters.core.factors import (
    apply,
    identity,
    multiply,
    solve_lower,
    solve_lower_transposed,
    triangularise,
)
from sigmaslam.filters.core.failure import FilterError, name_elements
from sigmaslam.filters.core.noise_covariance import Dense, Noise, Rooted, as_noise
from sigmaslam.filters.core.transforms import Taylor
from sigmaslam.filters.gaussian_belief import Gaussian
from sigmaslam.filters.manifolds import Space, is_flat
from sigmaslam.filters.models import AnyMeasurement, LinearMeasurement

# A step is halved at most this often while it raises the cost.
_HALVINGS = 10
# A pivot below this share of its column, in units of the dtype's epsilon, is round-off of zero. Up to 4 were measured,
# to which derivatives add theirs; with a prior no pivot is zero, but it can be lost in the round-off of precise data.
_SINGULAR = 64
_LOST = 4


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


@dataclass(frozen=True, slots=True, eq=False)
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
    problem = _LeastSquares(terms, space, root, has_prior=False)
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
    problem = _LeastSquares(terms, space, start.factor, has_prior=True)
    return _estimate("maximum a posteriori", problem, start, sound, iterations, tolerance, on_failure)


@dataclass(frozen=True, slots=True, eq=False)
class _Term:
    """An observation made ready, everything expanded to the batch.

    Attributes:
        value: (..., m), zero where missing.
        noise: unit where missing.
        mask: (..., m) bool; None: everything takes part.
        scale: (..., m) square root of the weight; None: 1.
        count: (...,) number of components that take part.
        sound: (...,) bool: the noise is positive definite.
    """

    model: AnyMeasurement
    value: Tensor
    inputs: tuple[Tensor, ...]
    noise: Noise
    mask: Tensor | None
    scale: Tensor | None
    count: Tensor
    sound: Tensor

    def residual(self, state: Tensor) -> Tensor:
        """Whitened z - h(x) for states (..., p), (..., m)."""
        if isinstance(self.model, LinearMeasurement):
            predicted, compare = self.model.function(state), None
        else:
            predicted, compare = self.model.function(state.unsqueeze(0), *self.inputs)[0], self.model.residual
        if predicted.shape[-1] != self.value.shape[-1]:
            raise ValueError(
                f"a measurement's function returns {predicted.shape[-1]} components, its value has "
                f"{self.value.shape[-1]}"
            )
        difference = self.value - predicted if compare is None else compare(self.value, predicted)
        return self._whiten(difference.unsqueeze(-1)).squeeze(-1)

    def linearised(self, problem: _LeastSquares, anchor: Tensor, zeta: Tensor) -> Tensor:
        """Whitened derivative by zeta, with the whitened residual as one more column, (..., m, n + 1)."""
        shift = apply(problem.root, zeta)
        state = problem.retract(anchor, shift)
        model = self.model
        if isinstance(model, LinearMeasurement):
            slope, innovation = multiply(model.matrix, problem.root), self.value - model.function(state)
        else:
            columns, jacobian = problem.root, None
            if model.jacobian is not None:
                # Without a prior the chart is at the state, where the given derivative is.
                columns = problem.columns(anchor, zeta, state) if problem.has_prior else problem.root
                jacobian = model.jacobian(state, *self.inputs)
            seen = Taylor(jacobian)(
                lambda offsets: model.function(problem.retract(anchor, shift + offsets), *self.inputs),
                columns,
                model.residual,
            )
            slope = seen.columns.odd
            innovation = seen.from_mean(self.value, model.residual)
        slope = slope.expand(*innovation.shape, slope.shape[-1])
        return self._whiten(torch.cat([slope, innovation.unsqueeze(-1)], dim=-1))

    def magnitude(self) -> Tensor:
        """Squared length of the whitened value, (...,)."""
        white = self._whiten(self.value.unsqueeze(-1))
        return (white * white).sum(dim=(-2, -1))

    def _whiten(self, columns: Tensor) -> Tensor:
        if self.mask is not None:
            columns = torch.where(self.mask.unsqueeze(-1), columns, 0.0)
        if self.scale is not None:
            columns = self.scale.unsqueeze(-1) * columns
        return self.noise.whitened(columns)


@dataclass(frozen=True, slots=True, eq=False)
class _LeastSquares:
    """Least squares in zeta (..., n), with the state anchor [+] root zeta.

    With a prior the anchor is its mean for good. Without one, the root is the identity and the anchor goes along.
    """

    terms: Sequence[_Term]
    space: Space | None
    root: Tensor
    has_prior: bool

    @property
    def is_linear(self) -> bool:
        """Whether one step is exact."""
        return all(isinstance(term.model, LinearMeasurement) for term in self.terms)

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        """point [+] tangent."""
        return point + tangent if self.space is None else self.space.retract(point, tangent)

    def state(self, anchor: Tensor, zeta: Tensor) -> Tensor:
        """(..., p)."""
        return self.retract(anchor, apply(self.root, zeta))

    def columns(self, anchor: Tensor, zeta: Tensor, state: Tensor) -> Tensor:
        """Derivative (..., n, n) by zeta of the tangent at the state; in R^n that is the root."""
        space = self.space
        if space is None or is_flat(space):
            return self.root
        shift = apply(self.root, zeta)
        return Taylor()(
            lambda offsets: space.local(state, space.retract(anchor, shift + offsets)), self.root, None
        ).columns.odd

    def cost(self, anchor: Tensor, zeta: Tensor) -> Tensor:
        """Half of the sum of squares, (...,)."""
        state = self.state(anchor, zeta)
        residuals = [zeta] if self.has_prior else []
        residuals += [term.residual(state) for term in self.terms]
        return 0.5 * torch.stack([(residual * residual).sum(dim=-1) for residual in residuals]).sum(dim=0)

    def triangle(self, anchor: Tensor, zeta: Tensor) -> Tensor:
        """Lower factor (..., n + 1, n + 1) of the squares of [derivative, residual], one added to the last pivot's."""
        size = zeta.shape[-1]
        pieces = [term.linearised(self, anchor, zeta).mT for term in self.terms]
        # The one keeps the last pivot, the length of the residual, off zero, where a QR has no gradient.
        one = identity(size + 1, zeta)
        if self.has_prior:
            past = torch.nn.functional.pad(zeta.unsqueeze(-2), (0, 1, size, 0))
            return triangularise([*pieces, one - past])
        return triangularise([*pieces, one[:, size:]])


@dataclass(frozen=True, slots=True, eq=False)
class _Minimum:
    """Where Gauss-Newton ended; `factor` (..., n, n) is the lower root of the information on zeta of its last step."""

    anchor: Tensor
    zeta: Tensor
    factor: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor
    finite: Tensor
    determined: Tensor


def _gauss_newton(problem: _LeastSquares, anchor: Tensor, sound: Tensor, iterations: int, tolerance: float) -> _Minimum:
    size = problem.root.shape[-1]
    epsilon = torch.finfo(anchor.dtype).eps
    # Steps, in standard deviations, that change the cost by so little that its round-off has a say.
    negligible = epsilon**0.25
    zeta = torch.zeros_like(problem.root[..., 0])
    factor = unit = identity(size, zeta).expand_as(problem.root)
    cost = problem.cost(anchor, zeta)
    if cost.shape != anchor.shape[:-1]:
        raise ValueError(
            f"inputs, noise or matrices have batch {tuple(cost.shape)}, the state and the values "
            f"{tuple(anchor.shape[:-1])}: expand the state"
        )
    active, finite, determined = sound, torch.ones_like(sound), torch.ones_like(sound)
    converged, count = torch.zeros_like(sound), torch.zeros_like(sound, dtype=torch.int64)
    previous = torch.full_like(cost, torch.inf)
    # Round-off of a cost c is about sqrt(2 c) times this: what the values lose, times the residuals.
    lost = epsilon * torch.sqrt(sum((term.magnitude().detach() for term in problem.terms), torch.zeros_like(cost)))
    linear = problem.is_linear
    for _ in range(1 if linear else iterations):
        if _holds_everywhere(~active):
            break
        if not problem.has_prior:
            moving = active.unsqueeze(-1)
            anchor = torch.where(moving, problem.state(anchor, zeta), anchor)
            zeta = torch.where(moving, 0.0, zeta)
        triangle = problem.triangle(anchor, zeta)
        finite = torch.where(active, torch.isfinite(triangle).all(dim=-1).all(dim=-1), finite)
        regular = _is_regular(triangle, _LOST if problem.has_prior else _SINGULAR)
        determined = torch.where(active, regular, determined)
        usable = active & finite & determined
        current = torch.where(usable[..., None, None], triangle[..., :size, :size], unit)
        projected = torch.where(usable.unsqueeze(-1), triangle[..., size, :size], 0.0)
        step = solve_lower_transposed(current, projected.unsqueeze(-1)).squeeze(-1)
        length = torch.linalg.vector_norm(projected.detach(), dim=-1)

        scale = torch.ones_like(length)
        for _ in range(_HALVINGS + 1):
            candidate = zeta + scale.unsqueeze(-1) * step
            reached = problem.cost(anchor, candidate)
            fine = reached <= cost + lost * torch.sqrt(2 * cost.detach())
            fine = fine | (torch.isfinite(reached) & ((length <= negligible) | linear))
            if _holds_everywhere(fine | ~usable):
                break
            scale = torch.where(fine, scale, 0.5 * scale)

        moved = usable & fine
        zeta = torch.where(moved.unsqueeze(-1), candidate, zeta)
        cost = torch.where(moved, reached, cost)
        factor = torch.where(usable[..., None, None], current, factor)
        count = count + usable
        close = (length <= tolerance) | ((length <= negligible) & (length >= previous))
        converged = converged | (moved & (close | linear))
        active = moved & ~close
        previous = length
    return _Minimum(anchor, zeta, factor, cost, count, converged, finite, determined)


def _estimate(
    stage: str,
    problem: _LeastSquares,
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
    solution = _gauss_newton(problem, start.mean, sound, iterations, tolerance)
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


def _prepare(k: int, observation: Observation, like: Tensor, batch: torch.Size, space: Space | None) -> _Term:
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
    mask = None if _holds_everywhere(present) else present
    if mask is not None:
        value, noise = torch.where(mask, value, 0.0), noise.masked(mask)
    if isinstance(noise, Dense):
        noise = Rooted(noise.factor())  # once, not at every step
    sound = torch.isfinite(noise.log_determinant())
    return _Term(model, value, observation.inputs, noise, mask, scale, present.sum(dim=-1), sound)


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


def _holds_everywhere(condition: Tensor) -> bool:
    """Whether a condition holds everywhere; compiled, where looking would break the graph, nothing is known."""
    return not torch.compiler.is_compiling() and bool(condition.all())


def _is_regular(triangle: Tensor, tolerance: float) -> Tensor:
    """Whether the derivative that (..., n + 1, n + 1) was made from has full rank, at any scale of its columns.

    The tolerance is in units of the dtype's epsilon.
    """
    pivots = torch.diagonal(triangle, dim1=-2, dim2=-1)[..., :-1]
    lengths = torch.linalg.vector_norm(triangle.detach(), dim=-1)[..., :-1]
    return (pivots > tolerance * torch.finfo(triangle.dtype).eps * lengths).all(dim=-1)


def _raise(
    stage: str,
    healthy: Tensor,
    causes: Sequence[tuple[str, Tensor]],
    problem: _LeastSquares,
    solution: _Minimum,
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
