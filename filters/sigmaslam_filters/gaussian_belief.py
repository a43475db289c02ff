"""A Gaussian belief over states, by its covariance or by a square root of it, and how much of a belief it is."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import apply, cholesky, may_look, solve_lower, square, triangularise
from sigmaslam_filters.core.layout import choose
from sigmaslam_filters.core.tensors import DTYPES, require_symmetric, require_tensor
from sigmaslam_filters.core.unrolled_factors import known_lower
from sigmaslam_filters.manifolds import Space


class Gaussian:
    """Mean and covariance, for any number of leading batch dimensions.

    On a manifold the mean is a point, and the covariance that of the tangent vector v in mean [+] v.

    Attributes:
        mean: (..., p) point; p = n in R^n.
    """

    __slots__ = ("_covariance", "_factor", "_is_lower", "_unrooted", "mean")

    def __init__(
        self,
        mean: Tensor,
        covariance: Tensor | None = None,
        *,
        factor: Tensor | None = None,
        factor_is_lower: bool = False,
        is_symmetric: bool = False,
    ) -> None:
        """Takes the covariance, or instead of it a square root.

        Args:
            mean: (..., p).
            covariance: (..., n, n) symmetric positive semidefinite; leading dimensions broadcast to the mean's.
            factor: (..., n, k) any S with S S^T = covariance. A filter goes on with what it is given.
            factor_is_lower: the factor is known to be lower triangular, which saves making it so.
            is_symmetric: the covariance is known to be symmetric, which saves a look.
        Raises:
            ValueError: both or neither are given, a shape or dtype does not fit, or the covariance is not symmetric.
            TypeError: something other than a tensor is given.
        """
        if (covariance is None) == (factor is None):
            raise ValueError("a Gaussian needs either a covariance or a factor of it")
        given = covariance if covariance is not None else factor
        assert given is not None
        require_tensor("the mean", mean)
        require_tensor("the covariance" if covariance is not None else "the factor", given)
        if mean.ndim < 1 or given.ndim < 2 or (covariance is not None and given.shape[-1] != given.shape[-2]):
            kind = "covariance (..., n, n)" if covariance is not None else "factor (..., n, k)"
            raise ValueError(f"mean (..., p) and {kind} expected, got {tuple(mean.shape)} and {tuple(given.shape)}")
        if mean.dtype != given.dtype:
            raise ValueError(f"mean and covariance need one floating dtype, got {mean.dtype} and {given.dtype}")
        # There is no factorisation of integers and half precision.
        if mean.dtype not in DTYPES:
            raise ValueError(f"the belief is {mean.dtype}: convert it with .to(torch.float32) or .to(torch.float64)")
        if covariance is not None and not is_symmetric and may_look(covariance):
            require_symmetric("the covariance", covariance)
        if given.shape[:-2] != mean.shape[:-1]:
            try:
                given = given.expand(*mean.shape[:-1], *given.shape[-2:])
            except RuntimeError:
                raise ValueError(
                    f"batch of the covariance {tuple(given.shape[:-2])} does not broadcast to that of the mean "
                    f"{tuple(mean.shape[:-1])}; noises that change with time are a list of models, one for each step"
                ) from None
        self.mean = mean
        self._covariance = given if covariance is not None else None
        self._factor = given if covariance is None else None
        self._is_lower = factor_is_lower
        # Of a belief held by a root: the covariance (..., n, n) of elements that have no root, whose factor is NaN.
        self._unrooted: Tensor | None = None

    @property
    def covariance(self) -> Tensor:
        """(..., n, n)."""
        if self._covariance is None:
            assert self._factor is not None
            covariance = square([self._factor])
            if self._unrooted is None:
                return covariance
            return choose(self._factor[..., 0, 0].isnan(), self._unrooted, covariance, 2)
        return self._covariance

    @property
    def factor(self) -> Tensor:
        """(..., n, n) lower triangular root; meaningless where the covariance is not positive semidefinite."""
        return self.checked_factor()[0]

    def checked_factor(self) -> tuple[Tensor, Tensor | None]:
        """Lower triangular root (..., n, n), and (...,) bool: the covariance is positive semidefinite.

        The second is None for a belief that is held by a root, of which any is as good as another; but for elements
        that were held because their covariance has none.
        """
        if self._covariance is not None:
            return cholesky(self._covariance)
        assert self._factor is not None
        sound = None if self._unrooted is None else ~self._factor[..., 0, 0].isnan()
        return known_lower(self._factor) if self._is_lower else triangularise([self._factor]), sound

    @property
    def held(self) -> Tensor:
        """The covariance (..., n, n) or the factor (..., n, k), whichever the belief is held by."""
        held = self._covariance if self._covariance is not None else self._factor
        assert held is not None
        return held

    @property
    def is_square_root(self) -> bool:
        """Whether the belief is held by a square root."""
        return self._covariance is None

    @property
    def size(self) -> int:
        """n, the number of tangent dimensions."""
        return self.held.shape[-2]

    @property
    def batch_shape(self) -> torch.Size:
        """Leading dimensions."""
        return self.mean.shape[:-1]

    def __getitem__(self, index: Any) -> "Gaussian":
        """Elements of the batch: `belief[3]`, `belief[:, -1]`."""
        return self._like(self.mean[_of_batch(index, 1)], lambda matrix: matrix[_of_batch(index, 2)])

    def expand(self, batch: Sequence[int]) -> "Gaussian":
        """The same belief in every element of a larger batch."""
        return self._like(self.mean.expand(*batch, -1), lambda matrix: matrix.expand(*batch, -1, -1))

    def where(self, chosen: Tensor, other: "Gaussian") -> "Gaussian":
        """This belief where chosen (...,) bool is true, the other elsewhere; held as this one is."""
        if other.batch_shape != self.batch_shape:
            other = other.expand(self.batch_shape)
        mean = choose(chosen, self.mean, other.mean, 1)
        if self._covariance is not None:
            return Gaussian(mean, choose(chosen, self._covariance, other.covariance, 2), is_symmetric=True)
        factor, sound = other.checked_factor()
        if sound is None:
            return Gaussian(mean, factor=choose(chosen, self.factor, factor, 2), factor_is_lower=True)
        factor = torch.where(sound[..., None, None], factor, torch.nan)
        mixed = Gaussian(mean, factor=choose(chosen, self.factor, factor, 2), factor_is_lower=True)
        if not may_look(mean) or not bool((chosen | sound).all()):
            mixed._unrooted = other.covariance
        return mixed

    def to(self, *arguments: Any, **options: Any) -> "Gaussian":
        """Another dtype or device, as `Tensor.to`."""
        return self._like(self.mean.to(*arguments, **options), lambda matrix: matrix.to(*arguments, **options))

    def batch_last(self) -> "Gaussian":
        """The same belief with batch-last memory: `mean[..., i]` is contiguous, and large batches run much faster."""
        return self._like(_with_batch_last_memory(self.mean, 1), lambda matrix: _with_batch_last_memory(matrix, 2))

    def sample(self, number: int, generator: torch.Generator | None = None, space: Space | None = None) -> Tensor:
        """States (number, ..., p) drawn from the belief; on a manifold of its space."""
        shape = (number, *self.batch_shape, self.size)
        normal = torch.randn(shape, generator=generator, dtype=self.mean.dtype, device=self.mean.device)
        points, offsets = self.mean.expand(number, *self.mean.shape), apply(self.factor, normal)
        return points + offsets if space is None else space.retract(points, offsets)

    def marginal(self, components: Sequence[int]) -> "Gaussian":
        """The belief about some components of a state in R^n, in that order."""
        kept = self._components(components)
        if self._covariance is not None:
            return Gaussian(self.mean[..., kept], self._covariance[..., kept, :][..., kept], is_symmetric=True)
        return Gaussian(self.mean[..., kept], factor=self.factor[..., kept, :])

    def conditional(self, components: Sequence[int], values: Tensor) -> "Gaussian":
        """The belief about the other components of a state in R^n, in their order, once some are known.

        Args:
            components: those that are known.
            values: (..., c) what they are.
        Raises:
            ValueError: there are not as many values as components, or a component stands twice.
        """
        known = self._components(components)
        others = [i for i in range(self.size) if i not in known]
        size = len(known)
        if values.shape[-1:] != (size,):
            raise ValueError(f"{size} components are known, the values are {tuple(values.shape)}")
        # The triangular root of the known, then the others: all that is left below is the others' own.
        joint = triangularise([self.factor[..., [*known, *others], :]])
        white = solve_lower(joint[..., :size, :size], (values - self.mean[..., known]).unsqueeze(-1))
        mean = self.mean[..., others] + (joint[..., size:, :size] @ white).squeeze(-1)
        left = Gaussian(mean, factor=joint[..., size:, size:], factor_is_lower=True)
        return left if self.is_square_root else Gaussian(mean, left.covariance, is_symmetric=True)

    def _components(self, components: Sequence[int]) -> list[int]:
        if self.mean.shape[-1] != self.size:
            raise ValueError("components are those of a state in R^n; these are points of a manifold")
        found = [range(self.size)[i] for i in components]
        if len(set(found)) < len(found):
            raise ValueError(f"components {found} are not all different")
        return found

    def _like(self, mean: Tensor, change: Callable[[Tensor], Tensor]) -> "Gaussian":
        """With another mean, and the covariance or root changed; what has no root changes likewise."""
        if self._covariance is not None:
            return Gaussian(mean, change(self._covariance), is_symmetric=True)
        assert self._factor is not None
        changed = Gaussian(mean, factor=change(self._factor), factor_is_lower=self._is_lower)
        changed._unrooted = None if self._unrooted is None else change(self._unrooted)
        return changed

    def __repr__(self) -> str:
        kind = "factor" if self.is_square_root else "covariance"
        return f"Gaussian(mean {tuple(self.mean.shape)}, {kind}, n = {self.size}, {self.mean.dtype})"


def degree_of_belief(covariance: Tensor) -> Tensor:
    """Bel = 1 - ||P||_2^(1/2), clipped to [0, 1]: one minus the largest standard deviation in any direction.

    The last line of the chapter's filter algorithms. Tables 9.1 and 9.2 speak of the determinant where their formula
    has the 2-norm; the formula is what is built.

    The number means nothing without its unit: it is 0 from one unit of standard deviation on, one metre or one radian,
    say. The caller chooses the block of the posterior covariance and says which block, and in which unit, wherever the
    belief is shown. A block that mixes units (metres and radians) mixes them in the norm too: scale it first, or ask
    for each part on its own.

    Args:
        covariance: (..., n, n) symmetric, in the square of one unit. Only the lower triangle is read.
    Returns:
        (...,) belief in [0, 1]: NaN where the covariance has a NaN, 0 where it has an infinity but no NaN. The
        gradient is that of the formula where 0 < Bel < 1; it is zero where the belief is clipped and for P = 0, at
        which the root has none.
    Raises:
        ValueError: the last two dimensions are not a square of at least 1 by 1.
    """
    if covariance.ndim < 2 or covariance.shape[-1] != covariance.shape[-2] or covariance.shape[-1] == 0:
        raise ValueError(
            f"covariance must be (..., n, n) with n > 0, not {tuple(covariance.shape)}; "
            "a single variance is a (1, 1) matrix"
        )
    lower = covariance.tril()
    is_nan = lower.isnan().flatten(-2).any(dim=-1)
    finite = lower.isfinite().flatten(-2).all(dim=-1)
    # The solver raises for the whole batch at the first matrix that is not finite.
    regular = torch.where(finite[..., None, None], covariance, 0.0)
    # The spectral norm of a symmetric matrix is its largest eigenvalue in size.
    norm = torch.linalg.eigvalsh(regular).abs().amax(dim=-1)
    partial = finite & (norm > 0) & (norm < 1)
    inside = 1.0 - torch.where(partial, norm, 1.0).sqrt()
    certain = finite & (norm == 0)
    return torch.where(is_nan, torch.nan, torch.where(partial, inside, certain.to(inside.dtype)))


def _of_batch(index: Any, trailing: int) -> tuple[Any, ...]:
    """An index of the batch dimensions made one of the whole array; an ellipsis stands for batch dimensions."""
    given = index if isinstance(index, tuple) else (index,)
    if not any(part is Ellipsis for part in given):
        given = (*given, Ellipsis)
    return (*given, *[slice(None)] * trailing)


def _with_batch_last_memory(array: Tensor, trailing: int) -> Tensor:
    last = tuple(range(-trailing, 0))
    first = tuple(range(trailing))
    return array.movedim(last, first).contiguous().movedim(first, last)
