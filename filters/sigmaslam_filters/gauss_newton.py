"""Gauss-Newton on the whitened system, batched: least squares by its triangular factor, on manifolds, step by step.

Each step is the least-squares problem of the whitened derivative [R^-1/2 H] and residual, solved by QR; normal
equations, which lose half of the digits, are never formed. A prior is whitened by the unknown: x = x^- [+] L zeta with
L L^T = P, zeta ~ N(0, I), so that P is not inverted and may hold directions that are known exactly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import apply, identity, multiply, solve_lower_transposed, triangularise
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.transforms import Taylor
from sigmaslam_filters.manifolds import Space, is_flat
from sigmaslam_filters.models import AnyMeasurement, LinearMeasurement

# A step is halved at most this often while it raises the cost.
_HALVINGS = 10
# A pivot below this share of its column, in units of the dtype's epsilon, is round-off of zero. Up to 4 were measured,
# to which derivatives add theirs; with a prior no pivot is zero, but it can be lost in the round-off of precise data.
_SINGULAR = 64
_LOST = 4


@dataclass(frozen=True, slots=True, eq=False)
class Term:
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
            predicted, compare = self.model.evaluate(state.unsqueeze(0), *self.inputs)[0], self.model.residual
        if predicted.shape[-1] != self.value.shape[-1]:
            raise ValueError(
                f"a measurement's function returns {predicted.shape[-1]} components, its value has "
                f"{self.value.shape[-1]}"
            )
        difference = self.value - predicted if compare is None else compare(self.value, predicted)
        return self._whiten(difference.unsqueeze(-1)).squeeze(-1)

    def linearised(self, problem: "LeastSquares", anchor: Tensor, zeta: Tensor) -> Tensor:
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
                lambda offsets: model.evaluate(problem.retract(anchor, shift + offsets), *self.inputs),
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
class LeastSquares:
    """Least squares in zeta (..., n), with the state anchor [+] root zeta.

    With a prior the anchor is its mean for good. Without one, the root is the identity and the anchor goes along.
    """

    terms: Sequence[Term]
    space: Space | None
    root: Tensor
    has_prior: bool

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
class Minimum:
    """Where Gauss-Newton ended; `factor` (..., n, n) is the lower root of the information on zeta of its last step."""

    anchor: Tensor
    zeta: Tensor
    factor: Tensor
    cost: Tensor
    iterations: Tensor
    converged: Tensor
    finite: Tensor
    determined: Tensor


def gauss_newton(problem: LeastSquares, anchor: Tensor, sound: Tensor, iterations: int, tolerance: float) -> Minimum:
    """Steps from an anchor (..., p) until each element has converged.

    Args:
        sound: (...,) bool, elements to be estimated; the others stay where they are.
        iterations: at most so many steps; one where all models are linear.
        tolerance: length of a step, in standard deviations of the estimate, at which an element has converged.
    Raises:
        ValueError: inputs, noise or matrices have a batch that the state lacks.
    """
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
    linear = all(isinstance(term.model, LinearMeasurement) for term in problem.terms)
    for _ in range(1 if linear else iterations):
        if holds_everywhere(~active):
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
            if holds_everywhere(fine | ~usable):
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
    return Minimum(anchor, zeta, factor, cost, count, converged, finite, determined)


def holds_everywhere(condition: Tensor) -> bool:
    """Whether a condition holds everywhere; compiled, where looking would break the graph, nothing is known."""
    return not torch.compiler.is_compiling() and bool(condition.all())


def _is_regular(triangle: Tensor, tolerance: float) -> Tensor:
    """Whether the derivative that (..., n + 1, n + 1) was made from has full rank, at any scale of its columns.

    The tolerance is in units of the dtype's epsilon.
    """
    pivots = torch.diagonal(triangle, dim1=-2, dim2=-1)[..., :-1]
    lengths = torch.linalg.vector_norm(triangle.detach(), dim=-1)[..., :-1]
    return (pivots > tolerance * torch.finfo(triangle.dtype).eps * lengths).all(dim=-1)
