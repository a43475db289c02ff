"""Measurement updates of a standard-normal prior zeta ~ N(0, I_n), with x = x0 [+] L zeta, in three forms.

Given the innovation e = z - E[z] and deviation columns [odd, even] of the predicted measurement, the innovation
covariance is S = odd odd^T + even even^T + R, and odd is its covariance with zeta.

- dense: S and its Cholesky factor. The cheapest for few measurements; takes any R, singular ones and negative weights.
- low-rank: whiten by R^-1/2, W = R^-1/2 [even, odd]; everything follows from I + W^T W, whose size is the number of
  columns (Barfoot & McManus 2011). Linear in the number of measurements.
- qr: the triangular factor of the stacked [W, R^-1/2 e; I, 0], the square root of the same system without forming it.
  Twice the digits: the form for float32 (R7).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from sigmaslam_filters.core.columns import Columns
from sigmaslam_filters.core.factors import (
    apply,
    cholesky,
    identity,
    log_diagonal,
    multiply,
    solve_lower,
    solve_lower_transposed,
    square,
    triangularise,
)
from sigmaslam_filters.core.layout import choose
from sigmaslam_filters.core.noise_covariance import Dense, Noise, Rooted
from sigmaslam_filters.core.unrolled_factors import is_small, join, stacked_update

Form = Literal["dense", "low-rank", "qr"]
FORMS: tuple[Form, ...] = ("dense", "low-rank", "qr")


@dataclass(frozen=True, slots=True)
class TangentPosterior:
    """Posterior of L zeta, the state's tangent at the prior mean.

    Attributes:
        mean: (..., n) of zeta.
        shift: (..., n) of L zeta.
        covariance: (..., n, n); None from the qr form.
        root: (..., n, n) lower triangular root of the covariance; from the qr form only.
        spread: makes a lower triangular M (..., n, n) such that L M is a root of the covariance, but for `_width`.
        nis: makes e^T S^-1 e, (...,).
        log_determinant: makes log |S|, (...,).
        matrix: (..., k, k) what was factored: S, or I + W^T W; None from the qr form.
        healthy: (...,) bool: the factorisation exists; None: it does for all.
    """

    mean: Tensor
    shift: Tensor
    covariance: Tensor | None
    root: Tensor | None
    spread: Callable[[], Tensor]
    nis: Callable[[], Tensor]
    log_determinant: Callable[[], Tensor]
    matrix: Tensor | None
    healthy: Tensor | None

    def where(self, chosen: Tensor, other: "TangentPosterior") -> "TangentPosterior":
        """This solution where chosen (...,) bool is true, the other of the same form elsewhere."""

        def pick(first: Tensor | None, second: Tensor | None, trailing: int) -> Tensor | None:
            return None if first is None or second is None else choose(chosen, first, second, trailing)

        return replace(
            self,
            mean=choose(chosen, self.mean, other.mean, 1),
            shift=choose(chosen, self.shift, other.shift, 1),
            covariance=pick(self.covariance, other.covariance, 2),
            root=pick(self.root, other.root, 2),
            matrix=pick(self.matrix, other.matrix, 2),
            healthy=_choose_flags(chosen, self.healthy, other.healthy),
        )

    def factor(self) -> Tensor:
        """Lower triangular root of the covariance, (..., n, n)."""
        if self.root is not None:
            return self.root
        assert self.covariance is not None
        return cholesky(self.covariance)[0]


def _choose_flags(chosen: Tensor, first: Tensor | None, second: Tensor | None) -> Tensor | None:
    """The first flags where chosen, the second elsewhere, (...,) bool; None is all true."""
    if first is None and second is None:
        return None
    yes = torch.ones_like(chosen)
    return torch.where(chosen, yes if first is None else first, yes if second is None else second)


def choose_form(columns: Columns, measurements: int, additive: bool) -> Form:
    """Dense or low-rank, by what is larger: the measurement or the number of columns."""
    count = sum(part.shape[-1] for part in columns.all())
    return "low-rank" if additive and columns.negative is None and _is_more(measurements, count) else "dense"


def _is_more(measurements: int, count: int) -> bool:
    """Whether there are more measurements than columns; a number that a graph leaves open is taken for many."""
    return type(measurements) is not int or measurements > count


def solve(form: Form, innovation: Tensor, columns: Columns, noise: Noise | None, prior: Tensor) -> TangentPosterior:
    """Posterior of zeta in the form asked for.

    Args:
        innovation: (..., m).
        columns: deviations of the predicted measurement, (..., m, ·).
        noise: R; None when the noise is among the even columns (non-additive).
        prior: (..., n, n) lower triangular L.
    """
    if form == "dense":
        return _dense(innovation, columns, noise, prior)
    if columns.negative is not None:
        raise ValueError(f"the {form} form needs sigma weights that are not negative; use form='dense'")
    odd, even = columns.odd, columns.even
    count = odd.shape[-1] + (0 if even is None else even.shape[-1])
    if even is not None and (noise is None or not _is_more(innovation.shape[-1], count)):
        # Few measurements: the even columns join the noise, and only n unknowns are left.
        if form == "qr":
            noise = Rooted(triangularise([even]) if noise is None else noise.triangularised([even]))
        else:
            noise = Dense(square([even]) if noise is None else square([even]) + noise.covariance())
        even = None
    if noise is None:
        raise ValueError("the noise of the measurement is not additive, but no deviation comes from it")
    parts = [odd, innovation.unsqueeze(-1)] if even is None else [even, odd, innovation.unsqueeze(-1)]
    white = noise.whitened(join(parts))
    return (_qr if form == "qr" else _low_rank)(white, prior, noise)


def _dense(innovation: Tensor, columns: Columns, noise: Noise | None, prior: Tensor) -> TangentPosterior:
    size = columns.odd.shape[-1]
    S = columns.covariance()
    if noise is not None:
        S = S + noise.covariance()
    factor, healthy = cholesky(S)
    white = solve_lower(factor, join([columns.odd, innovation.unsqueeze(-1)]))
    gain, residual = white[..., :size], white[..., size]
    covariance = identity(size, S) - square([gain.mT])
    mean = apply(gain.mT, residual)
    return TangentPosterior(
        mean=mean,
        shift=apply(prior, mean),
        covariance=multiply(multiply(prior, covariance), prior.mT),
        root=None,
        spread=lambda: cholesky(covariance + _width(covariance) ** 2 * identity(size, S))[0],
        nis=lambda: (residual * residual).sum(dim=-1),
        log_determinant=lambda: log_diagonal(factor),
        matrix=S,
        healthy=healthy,
    )


def _low_rank(white: Tensor, prior: Tensor, noise: Noise) -> TangentPosterior:
    """White deviations (..., m, k), the last n of them odd, with the white innovation as one more column."""
    count = white.shape[-1] - 1
    first = count - prior.shape[-1]
    deviations = white[..., :count]
    products = deviations.mT @ white
    information = products[..., :count] + identity(count, white)
    factor, healthy = cholesky(information)
    projected = solve_lower(factor, products[..., count:], regular=True)
    inner = factor[..., first:, first:]
    spread = solve_lower(inner, prior.mT, regular=True)

    def nis() -> Tensor:
        # As sums of squares: the shorter |e|^2 - |projected|^2 cancels when the prior is vague.
        eta = solve_lower_transposed(factor, projected)
        remaining = white[..., count:] - deviations @ eta
        return (remaining * remaining).sum(dim=(-2, -1)) + (eta * eta).sum(dim=(-2, -1))

    return TangentPosterior(
        mean=solve_lower_transposed(inner, projected[..., first:, :]).squeeze(-1),
        shift=apply(spread.mT, projected[..., first:, 0]),
        covariance=square([spread.mT]),
        root=None,
        spread=lambda: _spread(inner),
        nis=nis,
        log_determinant=lambda: noise.log_determinant() + log_diagonal(factor),
        matrix=information,
        healthy=healthy,
    )


def _qr(white: Tensor, prior: Tensor, noise: Noise) -> TangentPosterior:
    """As `_low_rank`, by triangularising the rows [W^T, I, 0] and [e^T, 0, 1]; the 1 keeps the last pivot off zero."""
    if is_small(white.mT):
        mean, root, inner, last, determinant = stacked_update(white, prior.shape[-1], prior)
    else:
        count = white.shape[-1] - 1
        first = count - prior.shape[-1]
        triangle = triangularise([white.mT, identity(count + 1, white)])
        inner, projected = triangle[..., first:count, first:count], triangle[..., count, first:count]
        mean = solve_lower_transposed(inner, projected.unsqueeze(-1)).squeeze(-1)
        root = triangularise([solve_lower(inner, prior.mT, regular=True).mT])
        last = triangle[..., count, count]
        determinant = torch.diagonal(triangle, dim1=-2, dim2=-1)[..., :count]
    return TangentPosterior(
        mean=mean,
        shift=apply(prior, mean),
        covariance=None,
        root=root,
        spread=lambda: _spread(inner),
        nis=lambda: (last * last - 1.0).clamp_min(0.0),
        log_determinant=lambda: noise.log_determinant() + 2.0 * torch.log(determinant).sum(dim=-1),
        matrix=None,
        healthy=None,
    )


def _width(like: Tensor) -> float:
    """The least width of a second linearisation, as a share of the prior's: over less, differences are round-off."""
    return float(torch.finfo(like.dtype).eps ** 0.25)


def _spread(information_root: Tensor) -> Tensor:
    """Lower triangular root (..., n, n) of the inverse of G G^T, widened a little."""
    size = information_root.shape[-1]
    unit = identity(size, information_root).expand_as(information_root)
    return triangularise([solve_lower_transposed(information_root, unit), _width(unit) * unit])


def log_likelihood(solution: TangentPosterior, count: Tensor | int) -> Tensor:
    """Gaussian log-density of the innovation, (...,); count is the number of components that took part."""
    nis = solution.nis()
    if isinstance(count, Tensor):
        count = count.to(nis.dtype)
    return -0.5 * (nis + solution.log_determinant() + count * math.log(2 * math.pi))
