"""Measurements that may be wrong: a gate and robust weights, block by block (one landmark, one fix).

A block of weight w takes part with the noise R / w. Weights come from squared Mahalanobis distances, so they have no
unit:

- gate: the distance is that of the innovation, whose covariance is S. A block beyond the gate is refused while more
  than half of the blocks agree with the belief. Where they do not, the belief is in doubt as well, and the block takes
  part with the weight that Student's t gives it. That weight is never zero, so a belief that is wrong and too sure of
  itself is pulled back: the gate cannot lock itself out. A measurement that is not cut into blocks has no witness: it
  is refused beyond the gate, and motions alone widen the belief until it comes in again.
- robust: noise of heavy tails. The distance is that of the posterior's residual, with the uncertainty that is left in
  it, and the update is solved a few times with the weights of the time before: expectation maximisation for Student's t
  (Agamennoni et al. 2012; Piché et al. 2012), iterated reweighting for Huber's loss.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import torch
from scipy.special import chdtri
from torch import Tensor

from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.factors import apply, cholesky, is_traced, multiply, solve_lower, square
from sigmaslam_filters.core.noise_covariance import BlockDiagonal, Noise
from sigmaslam_filters.core.solve import TangentPosterior
from sigmaslam_filters.core.unrolled_factors import join
from sigmaslam_filters.models import AnyMeasurement, LinearMeasurement

Robust = Literal["student_t", "huber"]
ROBUST: tuple[Robust, ...] = ("student_t", "huber")

# Degrees of freedom of Student's t, the usual choice where they are not estimated (Lange et al. 1989).
_STUDENT_DOF = 4.0
# Share of a Gaussian that Huber's loss leaves alone: |x| < 1.345 of one component, which costs 5 % of efficiency.
_HUBER_SHARE = 0.8214
# Solutions of an update with robust weights.
_ROUNDS = 4


@dataclass(frozen=True, slots=True, eq=False)
class WeightedPosterior:
    """The posterior of an update, and what its measurement took part with.

    Attributes:
        solution: the posterior.
        noise: R, blocks over their weights; None if it is not additive.
        weight: (..., b) of the blocks; None: all 1.
    """

    solution: TangentPosterior
    noise: Noise | None
    weight: Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Blocks:
    """The blocks of a measurement.

    Attributes:
        size: components of a block.
        alone: whether the measurement is not cut: one block, which no other block is a witness for.
        count: (..., b) components of each that take part.
        weight: (..., b) by the gate; zero for a block that is refused.
        robust: what makes the other weights; None: nothing does.
    """

    size: int
    alone: bool
    count: Tensor
    weight: Tensor
    robust: Robust | None

    @classmethod
    def of(
        cls, measurement: AnyMeasurement, noise: Noise, value: Tensor, mask: Tensor | None, robust: Robust | None
    ) -> "Blocks":
        """The blocks of a value (..., m), as the model cuts it, else a `BlockDiagonal` noise; else there is one.

        Raises:
            ValueError: the noise is not additive, the name is unknown, or blocks of the model's size do not fit.
        """
        if robust is not None and robust not in ROBUST:
            raise ValueError(f"robust is {robust!r}; choose {' or '.join(ROBUST)}")
        if not isinstance(measurement, LinearMeasurement) and not measurement.additive:
            raise ValueError("a gate or robust weights need additive noise: this MeasurementModel has additive=False")
        components = value.shape[-1]
        size = noise.block_size if isinstance(noise, BlockDiagonal) else None
        size = size if measurement.block_size is None else measurement.block_size
        alone, size = size is None, components if size is None else size
        if components % size:
            raise ValueError(f"block_size is {size}, but the value has {components} components, no multiple of it")
        present = torch.ones_like(value, dtype=torch.bool) if mask is None else mask
        count = present.unflatten(-1, (-1, size)).sum(dim=-1)
        return cls(size, alone, count, torch.ones_like(count, dtype=value.dtype), robust)

    def gated(self, gate: float, innovation: Tensor, columns: Columns, noise: Noise) -> "Blocks":
        """The blocks with the weights that a gate gives them.

        Args:
            gate: probability that a block of a right measurement is inside.
            innovation: (..., m).
            columns: its deviations.
            noise: of the m components.
        Raises:
            ValueError: the gate is no probability.
        """
        if not 0.0 < gate < 1.0:
            raise ValueError(f"gate is {gate}; it must be a probability between 0 and 1, such as 0.999")
        distance = _distance([innovation.unsqueeze(-1)], columns.all(), noise, self.size)
        outside = distance > _quantiles(gate, self.count, self.size, distance)
        if self.alone:
            weight = torch.where(outside, 0.0, torch.ones_like(distance))
        else:
            there = self.count > 0
            doubtful = 2 * outside.sum(dim=-1, keepdim=True) >= there.sum(dim=-1, keepdim=True)
            weight = torch.where(doubtful, _student(distance, self.count), 0.0)
            weight = torch.where(outside, weight, 1.0)
        return replace(self, weight=weight, count=torch.where(weight > 0, self.count, 0))

    def masked(self, mask: Tensor | None) -> Tensor:
        """The mask (..., m) without the blocks that are refused."""
        left = self._components(self.weight) > 0
        return left if mask is None else mask & left

    def weighted(self, noise: Noise) -> Noise:
        """R / w; as it is where a block is refused."""
        return self._weighted(noise, torch.where(self.weight > 0, self.weight, 1.0))

    def solve(
        self, solve: Callable[[Noise], TangentPosterior], innovation: Tensor, columns: Columns, noise: Noise
    ) -> WeightedPosterior:
        """The posterior with robust weights.

        Args:
            solve: makes the posterior for a noise.
            innovation: (..., m).
            columns: deviations of what is seen.
            noise: of the m components, with the weights of the gate.
        """
        if self.robust is None:
            return WeightedPosterior(solve(noise), noise, self.weight)
        # What the linearisation leaves out is noise to it.
        others = [] if columns.even is None else [columns.even]
        distance = _distance([innovation.unsqueeze(-1)], columns.all(), noise, self.size)
        for _ in range(_ROUNDS):
            weight = self._robust_weight(distance)
            weighted = self._weighted(noise, weight)
            solution = solve(weighted)
            residual = innovation - apply(columns.odd, solution.mean)
            left = multiply(columns.odd, solution.spread())
            distance = _distance([residual.unsqueeze(-1), left], others, noise, self.size)
        return WeightedPosterior(solution, weighted, self.weight * weight)

    def _robust_weight(self, distance: Tensor) -> Tensor:
        if self.robust == "student_t":
            return _student(distance, self.count)
        threshold = _quantiles(_HUBER_SHARE, self.count, self.size, distance)
        return torch.sqrt(threshold / torch.maximum(distance, threshold))

    def _weighted(self, noise: Noise, weight: Tensor) -> Noise:
        return noise.scaled(self._components(torch.rsqrt(weight)))

    def _components(self, blocks: Tensor) -> Tensor:
        """What is said of blocks (..., b), of their components (..., m)."""
        return blocks.unsqueeze(-1).expand(*blocks.shape, self.size).flatten(-2)


def student_weight(
    distance: Tensor, count: Tensor | float, freedom: Tensor | float, consistent: bool = False
) -> Tensor:
    """Weights (...,) that make least squares the fit of Student's noise, which no distance makes zero.

    Args:
        distance: (...,) squared lengths of whitened residuals.
        count: (...,) how many components each has.
        freedom: degrees of freedom, (...,) or ().
        consistent: whether the weighted information shall be the estimate's precision. That of the plain weights is
            (nu + k + 2) / (nu + k) times as much; weights that much smaller hardly move the estimate.
    """
    whole = freedom + count
    if consistent:
        return whole * whole / ((whole + 2.0) * (freedom + distance))
    return whole / (freedom + distance)


def common_scale(
    distance: Tensor, median: Tensor, largest: Tensor, usable: Tensor, agreement: float = 0.95, most: float = 9.0
) -> Tensor:
    """Factor (), 1 or more, by which all variances together are too small: of a blurred image, say.

    The median tells how far the residuals scatter before any gate. It is believed where nearly all agree once their
    variances are scaled by it; where they do not, the errors are those of a part: outliers among good matches. Where
    it is large nothing fits.

    Args:
        distance: (M,) squared lengths of whitened residuals.
        median, largest: (M,) quantiles of chi-square for the components that each has: the median, and a gate.
        usable: (M,) bool, those that count.
        agreement: share of those that count that must agree once scaled; with fewer they are outliers.
        most: largest factor that is believed; right measurements err by no more than its root times what they claim.
    """
    counts = usable.to(distance.dtype)
    count = counts.sum()
    ratio = distance / median
    ordered = torch.sort(torch.where(usable, ratio, torch.full_like(ratio, float("inf")))).values
    number = usable.to(torch.int64).sum()
    middle = torch.stack([(number - 1).clamp_min(0) // 2, number // 2])
    factor = ordered.index_select(0, middle).sum() / 2.0
    # Half of them are expected above 1; by chance no more than three standard deviations of that count besides.
    scattered = ((ratio > 1.0).to(distance.dtype) * counts).sum() > 0.5 * count + 1.5 * torch.sqrt(count)
    agrees = (distance <= factor * largest).to(distance.dtype)
    nearly_all = torch.tensor(agreement, dtype=distance.dtype, device=distance.device)
    believed = scattered & (factor <= most) & ((agrees * counts).sum() >= nearly_all * count)
    return torch.where(believed, factor, torch.ones_like(factor))


def _distance(deviations: Sequence[Tensor], columns: Sequence[Tensor], noise: Noise, size: int) -> Tensor:
    """Sum of d^T C^-1 d over deviations d (..., m, ·), for C of columns (..., m, ·) and the noise; (..., b)."""
    blocks = noise.blocks(size)
    if columns:
        blocks = blocks + square([each.unflatten(-2, (-1, size)) for each in columns])
    white = solve_lower(cholesky(blocks)[0], join([each.unflatten(-2, (-1, size)) for each in deviations]))
    return (white * white).sum(dim=(-2, -1))


def _student(distance: Tensor, count: Tensor) -> Tensor:
    """Expected precision of a block of Student's noise, at most 1."""
    return student_weight(distance, count, _STUDENT_DOF).clamp_max(1.0)


def _quantiles(probability: float, count: Tensor, size: int, like: Tensor) -> Tensor:
    """Chi-square quantiles (..., b) for blocks of that size of which some components are missing."""
    known = _quantiles_up_to(probability, size)
    if not is_traced():
        return torch.tensor(known, dtype=like.dtype, device=like.device)[count]
    # A table is no arithmetic.
    found = torch.full_like(like, known[0])
    for dof, quantile in enumerate(known):
        found = torch.where(count == dof, quantile, found)
    return found


def _quantiles_up_to(probability: float, size: int) -> tuple[float, ...]:
    # A compiler looks through the cache, but takes the function around it for a constant.
    return _cached_quantiles(probability, size)


# What torch.compiler.assume_constant_result does, without loading the compiler, which takes a second.
_quantiles_up_to._dynamo_marked_constant = True  # type: ignore[attr-defined]


@lru_cache(maxsize=16)
def _cached_quantiles(probability: float, size: int) -> tuple[float, ...]:
    # Of no component the distance is zero, which any quantile but zero lies above.
    return (1.0, *(float(chdtri(dof, 1.0 - probability)) for dof in range(1, size + 1)))
