"""Deviations of values as columns: their outer products add up to a covariance, and stacked they are a root of it."""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters.core.factors import multiply, square, triangularise
from sigmaslam_filters.core.noise_covariance import Noise
from sigmaslam_filters.core.unrolled_factors import join


@dataclass(frozen=True, slots=True)
class Columns:
    """Deviations of m values, as columns whose outer products add up to their covariance.

    Attributes:
        odd: (..., m, n) statistical linearisation: slope times root of the state's covariance.
        even: (..., m, c) the rest, or None when there is none.
        negative: (..., m, 1) the column of a negative centre weight, whose outer product is taken away.
    """

    odd: Tensor
    even: Tensor | None = None
    negative: Tensor | None = None

    def all(self) -> list[Tensor]:
        """The columns that are added."""
        return [self.odd] if self.even is None else [self.odd, self.even]

    def covariance(self) -> Tensor:
        """Of the values, (..., m, m)."""
        covariance = square(self.all())
        return covariance if self.negative is None else covariance - square([self.negative])

    def where(self, usable: Tensor) -> "Columns":
        """The columns where usable (...,) bool is true, zeros elsewhere."""
        return self._with_zeros(usable[..., None, None])

    def masked(self, mask: Tensor, unit_noise: bool) -> "Columns":
        """Zero rows where the mask (..., m) is False; with unit noise of their own if no noise is added to them."""
        masked = self._with_zeros(mask.unsqueeze(-1))
        if not unit_noise:
            return masked
        odd, even = masked.odd, masked.even
        unit = torch.diag_embed((~mask).to(odd.dtype)).expand(*odd.shape[:-1], odd.shape[-2])
        return Columns(odd, unit if even is None else join([even, unit]), masked.negative)

    def without_noise(self, size: int) -> "Columns":
        """Of a transform of state and noise: odd columns after the first `size` are the noise's, and become even."""
        noise = self.odd[..., size:]
        even = noise if self.even is None else join([noise, self.even])
        return Columns(self.odd[..., :size], even, self.negative)

    def _with_zeros(self, kept: Tensor) -> "Columns":
        odd = torch.where(kept, self.odd, 0.0)
        even = None if self.even is None else torch.where(kept, self.even, 0.0)
        negative = None if self.negative is None else torch.where(kept, self.negative, 0.0)
        return Columns(odd, even, negative)


def predicted_factor(columns: Columns, noise: Noise | None, noise_matrix: Tensor | None) -> Tensor:
    """Lower root (..., n, n) of the covariance of the columns and of the noise that enters by its matrix (..., n, q).

    Raises:
        ValueError: sigma weights are negative.
    """
    if columns.negative is not None:
        raise ValueError("square roots need sigma weights that are not negative; use form='dense'")
    if noise is None:
        return triangularise(columns.all())
    if noise_matrix is None:
        return noise.triangularised(columns.all())
    return triangularise([*columns.all(), multiply(noise_matrix, noise.factor())])


def predicted_covariance(columns: Columns, noise: Noise | None, noise_matrix: Tensor | None) -> Tensor:
    """Covariance (..., n, n) of the columns and of the noise that enters by its matrix (..., n, q)."""
    covariance = columns.covariance()
    return covariance if noise is None else covariance + noise_entering(noise, noise_matrix)


def noise_entering(noise: Noise, noise_matrix: Tensor | None) -> Tensor:
    """B2 Q B2^T, (..., n, n)."""
    if noise_matrix is None:
        return noise.covariance()
    return multiply(multiply(noise_matrix, noise.covariance()), noise_matrix.mT)


def block_diagonal(first: Tensor, second: Tensor) -> Tensor:
    """(..., n, n) and (..., q, q) into (..., n + q, n + q)."""
    n, q = first.shape[-1], second.shape[-1]
    batch = torch.broadcast_shapes(first.shape[:-2], second.shape[:-2])
    upper = torch.nn.functional.pad(first, (0, q)).expand(*batch, n, n + q)
    return torch.cat([upper, torch.nn.functional.pad(second, (n, 0)).expand(*batch, q, n + q)], dim=-2)
