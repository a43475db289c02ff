"""Noise of motions and measurements: dense, diagonal or block-diagonal covariances that whiten at their own cost."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from sigmaslam.filters.linalg.square_roots import cholesky, identity, log_diagonal, solve_lower, square, triangularise


class Noise(Protocol):
    """What the filters ask of a covariance R (..., m, m)."""

    @property
    def size(self) -> int:
        """m."""
        ...

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        ...

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        ...

    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""
        ...

    def triangularised(self, pieces: Sequence[Tensor]) -> Tensor:
        """Lower root (..., m, m) of the covariance of R plus that of other deviations, pieces (..., m, c_i)."""
        ...

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c)."""
        ...

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        ...

    def masked(self, mask: Tensor) -> Noise:
        """The noise with unit variance, and no correlation, where mask (..., m) is False."""
        ...


class Diagonal:
    """Independent components."""

    def __init__(self, variance: Tensor) -> None:
        """Takes the variances (..., m)."""
        if variance.ndim < 1:
            raise ValueError("variances (..., m) expected, got a scalar")
        self._variance = variance

    @property
    def size(self) -> int:
        """m."""
        return self._variance.shape[-1]

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

    def masked(self, mask: Tensor) -> Diagonal:
        """Unit variance where mask (..., m) is False."""
        return Diagonal(torch.where(mask, self._variance, 1.0))


class BlockDiagonal:
    """Independent blocks, such as one 2x2 or 3x3 covariance for each point."""

    def __init__(self, blocks: Tensor) -> None:
        """Takes the blocks (..., b, k, k); component i k + j of the measurement is component j of block i."""
        if blocks.ndim < 3 or blocks.shape[-1] != blocks.shape[-2]:
            raise ValueError(f"blocks (..., b, k, k) expected, got {tuple(blocks.shape)}")
        self.blocks = blocks

    @property
    def size(self) -> int:
        """m = b k."""
        return self.blocks.shape[-3] * self.blocks.shape[-1]

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return _block_diagonal(self.blocks)

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return torch.diagonal(self.blocks, dim1=-2, dim2=-1).flatten(-2)

    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""
        return _block_diagonal(_flagged(*cholesky(self.blocks)))

    def triangularised(self, pieces: Sequence[Tensor]) -> Tensor:
        """Lower root of R and more deviations."""
        return triangularise([*pieces, self.factor()])

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c), block by block."""
        count, size = self.blocks.shape[-3], self.blocks.shape[-1]
        factor = _flagged(*cholesky(self.blocks))
        return solve_lower(factor, columns.unflatten(-2, (count, size)), regular=True).flatten(-3, -2)

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        return log_diagonal(_flagged(*cholesky(self.blocks))).sum(dim=-1)

    def masked(self, mask: Tensor) -> BlockDiagonal:
        """Unit variance and no correlation where mask (..., m) is False."""
        count, size = self.blocks.shape[-3], self.blocks.shape[-1]
        return BlockDiagonal(_masked(self.blocks, mask.unflatten(-1, (count, size))))


class _Correlated(ABC):
    """A covariance whose root is a full triangle."""

    @abstractmethod
    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""

    def triangularised(self, pieces: Sequence[Tensor]) -> Tensor:
        """Lower root of R and more deviations."""
        return triangularise([*pieces, self.factor()])

    def whitened(self, columns: Tensor) -> Tensor:
        """R^-1/2 columns, (..., m, c)."""
        return solve_lower(self.factor(), columns, regular=True)

    def log_determinant(self) -> Tensor:
        """log |R|, (...,)."""
        return log_diagonal(self.factor())


class Dense(_Correlated):
    """Any covariance."""

    def __init__(self, covariance: Tensor) -> None:
        """Takes the covariance (..., m, m)."""
        if covariance.ndim < 2 or covariance.shape[-1] != covariance.shape[-2]:
            raise ValueError(f"a covariance (..., m, m) expected, got {tuple(covariance.shape)}")
        self._covariance = covariance

    @property
    def size(self) -> int:
        """m."""
        return self._covariance.shape[-1]

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return self._covariance

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return torch.diagonal(self._covariance, dim1=-2, dim2=-1)

    def factor(self) -> Tensor:
        """Lower triangular root of R, (..., m, m)."""
        return _flagged(*cholesky(self._covariance))

    def masked(self, mask: Tensor) -> Dense:
        """Unit variance and no correlation where mask (..., m) is False."""
        return Dense(_masked(self._covariance, mask))


class Rooted(_Correlated):
    """A covariance by its lower triangular root."""

    def __init__(self, root: Tensor) -> None:
        """Takes the root (..., m, m)."""
        self._root = root

    @property
    def size(self) -> int:
        """m."""
        return self._root.shape[-1]

    def covariance(self) -> Tensor:
        """R, (..., m, m)."""
        return square([self._root])

    def variance(self) -> Tensor:
        """Diagonal of R, (..., m)."""
        return (self._root * self._root).sum(dim=-1)

    def factor(self) -> Tensor:
        """Root of R, (..., m, m)."""
        return self._root

    def masked(self, mask: Tensor) -> Dense:
        """Unit variance and no correlation where mask (..., m) is False."""
        return Dense(self.covariance()).masked(mask)


def as_noise(noise: Noise | Tensor) -> Noise:
    """A tensor is taken for a dense covariance (..., m, m)."""
    return Dense(noise) if isinstance(noise, Tensor) else noise


def _flagged(matrix: Tensor, healthy: Tensor | None) -> Tensor:
    """Matrices (..., r, c) with NaN in those that are not healthy, so that no result passes for one."""
    return matrix if healthy is None else torch.where(healthy[..., None, None], matrix, torch.nan)


def _masked(covariance: Tensor, mask: Tensor) -> Tensor:
    both = mask.unsqueeze(-1) & mask.unsqueeze(-2)
    return torch.where(both, covariance, identity(covariance.shape[-1], covariance))


def _block_diagonal(blocks: Tensor) -> Tensor:
    apart = identity(blocks.shape[-3], blocks)[:, None, :, None]
    spread = apart * blocks.unsqueeze(-2)
    return spread.flatten(-4, -3).flatten(-2, -1)
