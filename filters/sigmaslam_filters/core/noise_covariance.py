"""Noise of motions and measurements: dense, diagonal or block-diagonal covariances that whiten at their own cost."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import (
    cholesky,
    identity,
    log_diagonal,
    may_look,
    solve_lower,
    square,
    triangularise,
)
from sigmaslam_filters.core.tensors import require_symmetric, require_tensor


class Noise(ABC):
    """A covariance R (..., m, m). What is not overridden works with its root, a full triangle."""

    @abstractmethod
    def covariance(self) -> Tensor:
        """R, (..., m, m)."""

    def __repr__(self) -> str:
        return f"{type(self).__name__}{tuple(self.variance().shape)}"

    def masked(self, mask: Tensor) -> "Noise":
        """The noise with unit variance, and no correlation, where mask (..., m) is False."""
        return Dense(_masked(self.covariance(), mask))

    def scaled(self, factor: Tensor) -> "Noise":
        """The noise of components that are multiplied by factors (..., m)."""
        return Dense(self.covariance() * (factor.unsqueeze(-1) * factor.unsqueeze(-2)))

    def blocks(self, size: int) -> Tensor:
        """Covariances of m / size parts of equal size, (..., m / size, size, size)."""
        parts = self.covariance().unflatten(-1, (-1, size)).unflatten(-3, (-1, size))
        return torch.diagonal(parts, dim1=-4, dim2=-2).movedim(-1, -3)

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return torch.diagonal(self.covariance(), dim1=-2, dim2=-1)

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        return log_diagonal(self.factor())

    @abstractmethod
    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""

    def triangularised(self, pieces: Sequence[Tensor]) -> Tensor:
        """Lower root (..., m, m) of the covariance of R plus that of other deviations, pieces (..., m, c_i)."""
        return triangularise([*pieces, self.factor()])

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c)."""
        return solve_lower(self.factor(), columns, regular=True)


class Diagonal(Noise):
    """Independent components."""

    def __init__(self, variance: Tensor) -> None:
        """Takes the variances (..., m)."""
        require_tensor("Diagonal's variance", variance)
        if variance.ndim < 1:
            raise ValueError("variances (..., m) expected, got a scalar")
        self._variance = variance

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return torch.diag_embed(self._variance)

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return self._variance

    def factor(self) -> Tensor:
        """Root of R, (..., m, m)."""
        return torch.diag_embed(torch.sqrt(self._variance))

    def triangularised(self, pieces: Sequence[Tensor]) -> Tensor:
        """Lower root of R and more deviations."""
        return triangularise(pieces, torch.sqrt(self._variance))

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c)."""
        return columns * torch.rsqrt(self._variance).unsqueeze(-1)

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        return torch.log(self._variance).sum(dim=-1)

    def masked(self, mask: Tensor) -> "Diagonal":
        """Unit variance where mask (..., m) is False."""
        return Diagonal(torch.where(mask, self._variance, 1.0))

    def scaled(self, factor: Tensor) -> "Diagonal":
        """The noise of components that are multiplied by factors (..., m)."""
        return Diagonal(self._variance * (factor * factor))

    def blocks(self, size: int) -> Tensor:
        """Covariances of parts of equal size, (..., m / size, size, size)."""
        return torch.diag_embed(self._variance.unflatten(-1, (-1, size)))


class BlockDiagonal(Noise):
    """Independent blocks, such as one 2x2 or 3x3 covariance for each point."""

    def __init__(self, blocks: Tensor) -> None:
        """Takes the blocks (..., b, k, k); component i k + j of the measurement is component j of block i."""
        require_tensor("BlockDiagonal's blocks", blocks)
        if blocks.ndim < 3 or blocks.shape[-1] != blocks.shape[-2]:
            raise ValueError(f"blocks (..., b, k, k) expected, got {tuple(blocks.shape)}")
        self._blocks = Dense(blocks, "BlockDiagonal's blocks")
        self._shape = blocks.shape[-3], blocks.shape[-1]

    @property
    def block_size(self) -> int:
        """k, components of a block."""
        return self._shape[1]

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return _block_diagonal(self._blocks.covariance())

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return self._blocks.variance().flatten(-2)

    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""
        return _block_diagonal(self._blocks.factor())

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c), block by block."""
        return self._blocks.whitened(columns.unflatten(-2, self._shape)).flatten(-3, -2)

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        return self._blocks.log_determinant().sum(dim=-1)

    def masked(self, mask: Tensor) -> "BlockDiagonal":
        """Unit variance and no correlation where mask (..., m) is False."""
        return BlockDiagonal(_masked(self._blocks.covariance(), mask.unflatten(-1, self._shape)))

    def scaled(self, factor: Tensor) -> "BlockDiagonal":
        """The noise of components that are multiplied by factors (..., m)."""
        parts = factor.unflatten(-1, self._shape)
        return BlockDiagonal(self._blocks.covariance() * (parts.unsqueeze(-1) * parts.unsqueeze(-2)))

    def blocks(self, size: int) -> Tensor:
        """Covariances of parts of equal size, (..., m / size, size, size)."""
        return self._blocks.covariance() if size == self.block_size else super().blocks(size)


class Dense(Noise):
    """Any covariance."""

    def __init__(self, covariance: Tensor, name: str = "Dense's covariance") -> None:
        """Takes the covariance (..., m, m), symmetric; the name is for messages."""
        require_tensor(name, covariance)
        if covariance.ndim < 2 or covariance.shape[-1] != covariance.shape[-2]:
            raise ValueError(
                f"{name}: a covariance (..., m, m) expected, got {tuple(covariance.shape)}; variances alone are a "
                "Diagonal"
            )
        if may_look(covariance):
            require_symmetric(name, covariance)
        self._covariance = covariance

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return self._covariance

    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m); NaN where R is not positive semidefinite."""
        factor, healthy = cholesky(self._covariance)
        return factor if healthy is None else torch.where(healthy[..., None, None], factor, torch.nan)


class Rooted(Noise):
    """A covariance by its lower triangular root."""

    def __init__(self, root: Tensor) -> None:
        """Takes the root (..., m, m)."""
        self._root = root

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return square([self._root])

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return (self._root * self._root).sum(dim=-1)

    def factor(self) -> Tensor:
        """Root of R, (..., m, m)."""
        return self._root


def as_noise(noise: Noise | Tensor, name: str = "noise") -> Noise:
    """A tensor is taken for a dense covariance (..., m, m); the name is for messages.

    Raises:
        TypeError: it is neither.
        ValueError: the covariance is not square, or not symmetric.
    """
    return noise if isinstance(noise, Noise) else Dense(noise, name)


def _masked(covariance: Tensor, mask: Tensor) -> Tensor:
    both = mask.unsqueeze(-1) & mask.unsqueeze(-2)
    return torch.where(both, covariance, identity(covariance.shape[-1], covariance))


def _block_diagonal(blocks: Tensor) -> Tensor:
    on_diagonal = identity(blocks.shape[-3], blocks)[:, None, :, None]
    return (on_diagonal * blocks.unsqueeze(-2)).flatten(-4, -3).flatten(-2, -1)
