"""Does a filter's covariance describe its errors? NEES and NIS, whiteness of innovations, and coverage.

A filter is consistent where its errors have zero mean and the covariance that it states. With x the error and P that
covariance, x^T P^-1 x is then chi-square; too large a mean tells of overconfidence, too small a one of modesty.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with Applications to Tracking and Navigation, Wiley 2001,
section 5.4. For plots see `sigmaslam_filters.consistency.plots`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq
from scipy.stats import chi2, norm, t
from torch import Tensor

LEVELS = (0.5, 0.6827, 0.9, 0.9545, 0.9973)
"""Levels of coverage: the median, 90 %, and what 1, 2 and 3 sigma hold of one dimension."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """NEES or NIS of many runs against the chi-square distribution that a consistent filter gives.

    Attributes:
        mean_per_step: (steps,) mean over the runs; NaN at a step without a value.
        expected_per_step: (steps,) its expectation, the mean degrees of freedom.
        low, high: (steps,) band that holds the mean of a step with `probability`.
        probability: of the band and of the interval.
        runs: how many.
        share_inside: of the steps with a value, those inside the band. Steps of a run are correlated, so that this
            share scatters more than a binomial one.
        mean: over runs and steps.
        interval: of the mean, from the scatter between the runs, which are independent where steps are not. NaN for
            a single run, which shows no scatter. Student's: with few runs of few steps, whose means are skewed, it
            holds somewhat less than it says (90 % for 5 runs of one step, 93 % for 20).
        dof: mean degrees of freedom, what `mean` should be.
        median: over runs and steps; a few wild values move the mean but not the median.
        expected_median: what it should be.
        count: values used.
        nan_count: values that were NaN and not used, though they had degrees of freedom: in general the covariance was
            not positive definite.
    """

    mean_per_step: Tensor
    expected_per_step: Tensor
    low: Tensor
    high: Tensor
    probability: float
    runs: int
    share_inside: float
    mean: float
    interval: tuple[float, float]
    dof: float
    median: float
    expected_median: float
    count: int
    nan_count: int

    @property
    def normalised_mean(self) -> float:
        """Mean per degree of freedom: 1 is right, more is overconfident."""
        return self.mean / self.dof if self.dof > 0 else math.nan

    @property
    def consistent(self) -> bool:
        """The interval holds the degrees of freedom and no value is NaN; False for one run, which shows no interval."""
        low, high = self.interval
        return self.nan_count == 0 and low <= self.dof <= high


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Autocorrelation of whitened innovations, which is zero at every lag for an optimal filter.

    Attributes:
        autocorrelation: (lags,) at lags 1, 2, ...; mean of the components, each over all runs and steps. NaN at a lag
            without a pair of values.
        band: (lags,) white noise stays within +-band at a lag with `probability`.
        probability: of the band.
        share_inside: of the lags, those inside the band.
        statistic: sum over lags and components of the squared autocorrelation times its number of pairs.
        p_value: probability of a statistic at least as large from white noise (Ljung & Box 1978); small means coloured.
        nan_count: values that were NaN and not used, nor the pairs they are in.
    """

    autocorrelation: Tensor
    band: Tensor
    probability: float
    share_inside: float
    statistic: float
    p_value: float
    nan_count: int


@dataclass(frozen=True, slots=True)
class Coverage:
    """Share of errors inside the regions that should hold them at given levels.

    Attributes:
        level: (L,) probability of each region under the filter's own covariance.
        share: (L,) of the samples inside, or (n, L) by axis; NaN without samples.
        low, high: as share; Wilson's interval of it for independent samples.
        probability: of that interval.
        count: () or (n,) samples used.
        nan_count: () or (n,) samples not used: the error is NaN or the covariance not positive definite.
    """

    level: Tensor
    share: Tensor
    low: Tensor
    high: Tensor
    probability: float
    count: Tensor
    nan_count: Tensor


def whiten(error: Tensor, covariance: Tensor | None = None, *, factor: Tensor | None = None) -> Tensor:
    """Errors in units of their own standard deviations, L^-1 x with L the Cholesky factor of P.

    Args:
        error: (..., n) errors or innovations.
        covariance: (..., n, n) their covariance P; only the lower triangle is read.
        factor: (..., n, k) instead of the covariance, any S with S S^T = P, triangular or not, k >= n. Keeps the digits
            that forming P loses.
    Returns:
        (..., n), the same from P as from any of its factors; NaN where P is not positive definite, or so near to
        singular that round-off decides, and where an input is NaN. Leading dimensions broadcast.
    Raises:
        ValueError: shapes do not fit, or not exactly one of covariance and factor is given.
    """
    lower, definite = _cholesky_factor(error.shape, covariance, factor)
    identity = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device)
    lower = torch.where(definite[..., None, None], lower, identity)
    whitened = torch.linalg.solve_triangular(lower, error.unsqueeze(-1), upper=False).squeeze(-1)
    return torch.where(definite.unsqueeze(-1), whitened, torch.nan)


def nees(error: Tensor, covariance: Tensor | None = None, *, factor: Tensor | None = None) -> Tensor:
    """Normalised estimation error squared, x^T P^-1 x; of an innovation and its covariance the NIS.

    Arguments and errors as `whiten`; an error of a pose is its tangent vector, in the units and the frame of P.

    Returns:
        (...,) chi-square with n degrees of freedom where the filter is consistent; NaN as in `whiten`.
    """
    return whiten(error, covariance, factor=factor).square().sum(dim=-1)


def chi_square_band(dof: float, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean of independent chi-square variables, Bar-Shalom et al. (2001), section 5.4.

    Args:
        dof: degrees of freedom of each.
        runs: how many variables the mean is of.
        probability: that the mean is inside; half of the rest lies on either side.
    Returns:
        Lower and upper end.
    Raises:
        ValueError: dof is not positive and finite, runs is less than 1 or the probability not between 0 and 1.
    """
    _require_probability(probability)
    if not 0 < dof < math.inf:
        raise ValueError(f"dof must be positive and finite, not {dof}")
    if runs < 1:
        raise ValueError(f"runs must be at least 1, not {runs}")
    low, high = chi2.interval(probability, runs * dof)
    return float(low) / runs, float(high) / runs


def check_nees(values: Tensor, dof: float | Tensor, probability: float = 0.95) -> Consistency:
    """Compare NEES or NIS of independent runs with the chi-square distribution.

    Args:
        values: (runs, steps) from `nees`.
        dof: degrees of freedom: a number, (steps,) or (runs, steps). 0 where there was no measurement; the value there
            is ignored, NaN or not.
        probability: of the bands and of the interval of the mean.
    Returns:
        See `Consistency`; its tensors are as the values in dtype and device.
    Raises:
        ValueError: values are not (runs, steps) with at least one of each, dof does not fit them, is negative or not
            finite, or the probability is not between 0 and 1.
    """
    _require_probability(probability)
    if values.ndim != 2 or 0 in values.shape or not values.is_floating_point():
        raise ValueError(
            f"values must be floating-point (runs, steps), at least 1 of each, not {values.dtype} {tuple(values.shape)}"
        )
    freedom = _to_float64(dof if isinstance(dof, Tensor) else torch.tensor(dof, dtype=torch.float64))
    if tuple(freedom.shape) not in ((), tuple(values.shape[1:]), tuple(values.shape)):
        raise ValueError(
            f"dof must be a number, (steps,) or (runs, steps); {tuple(freedom.shape)} does not fit values of "
            f"{tuple(values.shape)}"
        )
    if not bool((freedom.isfinite() & (freedom >= 0)).all()):
        raise ValueError("dof must be finite and not negative; give 0 where there was no measurement")
    given = _to_float64(values)
    measured = (freedom > 0).expand(values.shape)
    used = measured & ~given.isnan()
    given, freedom = torch.where(used, given, 0.0), torch.where(used, freedom, 0.0)

    # A sum of independent chi-square variables has the sum of their degrees of freedom.
    total, total_dof, number = given.sum(dim=0), freedom.sum(dim=0), used.sum(dim=0)
    mean_per_step = total / number
    low, high = (torch.as_tensor(end) / number for end in chi2.interval(probability, total_dof.numpy()))
    inside = (low <= mean_per_step) & (mean_per_step <= high)
    count = int(number.sum())
    mean_dof = float(total_dof.sum() / count)
    return Consistency(
        mean_per_step=mean_per_step.to(values),
        expected_per_step=(total_dof / number).to(values),
        low=low.to(values),
        high=high.to(values),
        probability=probability,
        runs=values.shape[0],
        share_inside=float(inside[number > 0].double().mean()),
        mean=float(total.sum() / count),
        interval=_interval_of_mean(given.sum(dim=1), freedom.sum(dim=1), mean_dof, probability),
        dof=mean_dof,
        median=float(np.median(given[used].numpy())) if count else math.nan,
        expected_median=_chi_square_median(freedom[used]),
        count=count,
        nan_count=int(measured.sum()) - count,
    )


def whiteness(innovations: Tensor, lags: int, probability: float = 0.95) -> Whiteness:
    """Autocorrelation of innovations over time, Bar-Shalom et al. (2001), section 5.4.2, and a portmanteau test.

    Each component is divided by its own power, so that a wrong scale of the covariance, which NIS finds, changes
    nothing here. The mean is not taken off: a bias is correlation too. Correlation between different components is not
    tested.

    Args:
        innovations: (runs, steps, m) from `whiten` with the innovation covariance. NaN where there was no measurement.
        lags: how many lags to test, from 1 on; less than the steps.
        probability: of the band.
    Returns:
        See `Whiteness`; its tensors are as the innovations in dtype and device.
    Raises:
        ValueError: innovations are not (runs, steps, m), lags are less than 1 or not less than the steps, or the
            probability is not between 0 and 1.
    """
    _require_probability(probability)
    if innovations.ndim != 3 or 0 in innovations.shape or not innovations.is_floating_point():
        raise ValueError(
            "innovations must be floating-point (runs, steps, m), at least 1 of each, not "
            f"{innovations.dtype} {tuple(innovations.shape)}"
        )
    if not 1 <= lags < innovations.shape[1]:
        raise ValueError(f"lags must be between 1 and {innovations.shape[1] - 1}, less than the steps, not {lags}")
    given = _to_float64(innovations)
    valid = ~given.isnan()
    given = torch.where(valid, given, 0.0)
    by_component, pairs_by_component = [], []
    for lag in range(1, lags + 1):
        both = valid[:, :-lag] & valid[:, lag:]
        earlier, later = given[:, :-lag] * both, given[:, lag:] * both
        power = (earlier.square().sum(dim=(0, 1)) * later.square().sum(dim=(0, 1))).sqrt()
        by_component.append((earlier * later).sum(dim=(0, 1)) / power)
        pairs_by_component.append(both.sum(dim=(0, 1)))
    correlation, pairs = torch.stack(by_component), torch.stack(pairs_by_component)
    # Of white noise, each has the variance one over its number of pairs.
    tested = correlation.isfinite()
    components = tested.sum(dim=-1)
    autocorrelation = torch.where(tested, correlation, 0.0).sum(dim=-1) / components
    deviation = torch.where(tested, 1.0 / pairs, 0.0).sum(dim=-1).sqrt() / components
    band = norm.isf((1 - probability) / 2) * deviation
    inside = autocorrelation.abs() <= band
    statistic = float((pairs * correlation.square())[tested].sum())
    return Whiteness(
        autocorrelation=autocorrelation.to(innovations),
        band=band.to(innovations),
        probability=probability,
        share_inside=float(inside[autocorrelation.isfinite()].double().mean()),
        statistic=statistic,
        p_value=float(chi2.sf(statistic, int(tested.sum()))),
        nan_count=int((~valid).sum()),
    )


def coverage(
    error: Tensor,
    covariance: Tensor | None = None,
    levels: Sequence[float] = LEVELS,
    *,
    factor: Tensor | None = None,
    by_axis: bool = False,
    probability: float = 0.95,
) -> Coverage:
    """Share of errors inside the covariance's ellipsoid of each level, or inside the interval of each axis.

    Args:
        error: (..., n) errors; every leading dimension counts as samples.
        covariance, factor: one of them, as for `whiten`.
        levels: probabilities of the regions.
        by_axis: count |x_i| <= k sigma_i on each axis i, k the normal distribution's for each level. Correlations
            between the axes play no part, and an axis of which only others are NaN still counts.
        probability: of Wilson's interval. It takes the samples to be independent: those of one run are not, and the
            interval is then too narrow.
    Returns:
        See `Coverage`; shares are (L,) and counts (), by axis (n, L) and (n,).
    Raises:
        ValueError: as `whiten`, or a level or the probability is not between 0 and 1.
    """
    if not by_axis:
        return _shares(nees(error, covariance, factor=factor).flatten(), error.shape[-1], levels, probability)
    _require_shapes(error.shape, covariance, factor)
    if factor is not None:
        variance = factor.square().sum(dim=-1)
    elif covariance is not None:
        variance = covariance.diagonal(dim1=-2, dim2=-1)
    squared = torch.where(variance > 0, error.square() / variance, torch.nan)
    return _shares(squared.reshape(-1, error.shape[-1]), 1, levels, probability)


def _shares(squared: Tensor, dof: int, levels: Sequence[float], probability: float) -> Coverage:
    """Coverage of chi-square variables, (samples,) or (samples, n)."""
    _require_probability(probability)
    if len(levels) == 0 or not all(0 < level < 1 for level in levels):
        raise ValueError(f"levels must be probabilities between 0 and 1, at least one, not {tuple(levels)}")
    valid = ~squared.isnan()
    count = valid.sum(dim=0)
    bounds = torch.as_tensor(chi2.ppf(np.asarray(levels), dof)).to(squared)
    samples = count.unsqueeze(-1).to(squared)
    # NaN is not inside.
    share = (squared.unsqueeze(-1) <= bounds).sum(dim=0) / samples
    # Wilson (1927): unlike the normal interval it holds its probability at shares near 0 and 1.
    z = float(norm.isf((1 - probability) / 2))
    centre = (share + z**2 / (2 * samples)) / (1 + z**2 / samples)
    half = z * (share * (1 - share) / samples + z**2 / (4 * samples**2)).sqrt() / (1 + z**2 / samples)
    return Coverage(
        level=torch.tensor(levels, dtype=squared.dtype, device=squared.device),
        share=share,
        low=(centre - half).clamp(min=0.0),
        high=(centre + half).clamp(max=1.0),
        probability=probability,
        count=count,
        nan_count=(~valid).sum(dim=0),
    )


def _interval_of_mean(totals: Tensor, dofs: Tensor, mean_dof: float, probability: float) -> tuple[float, float]:
    """Student's interval of the mean from each run's sum of values and of degrees of freedom, both (runs,)."""
    totals, dofs = totals[dofs > 0], dofs[dofs > 0]
    runs = len(totals)
    if runs < 2:
        return math.nan, math.nan
    # Runs may differ in how much they measured: the mean is a ratio of two sums, this its usual linearisation. For
    # equal runs it is the interval of the mean of the runs' means.
    ratio = totals.sum() / dofs.sum()
    deviation = (totals - ratio * dofs) / dofs.mean()
    half = t.isf((1 - probability) / 2, runs - 1) * deviation.square().sum().div((runs - 1) * runs).sqrt()
    return float(ratio - half) * mean_dof, float(ratio + half) * mean_dof


def _chi_square_median(dofs: Tensor) -> float:
    """Median of a mixture of chi-square variables with these degrees of freedom, (N,)."""
    different, number = np.unique(dofs.numpy(), return_counts=True)
    if len(different) == 0:
        return math.nan
    medians = chi2.median(different)
    if len(different) == 1:
        return float(medians[0])
    share = number / number.sum()
    return float(brentq(lambda x: share @ chi2.cdf(x, different) - 0.5, medians[0], medians[-1]))


def _cholesky_factor(
    error_shape: Sequence[int], covariance: Tensor | None, factor: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The lower factor with a positive diagonal, (..., n, n), and where there is one, (...)."""
    _require_shapes(error_shape, covariance, factor)
    if factor is not None:
        upper = torch.linalg.qr(factor.mT).R
        # QR leaves the signs open.
        lower = upper.mT * upper.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)
        definite = lower.isfinite().flatten(-2).all(dim=-1)
        largest = 1.0 / _round_off(lower)
    elif covariance is not None:
        lower, failed = torch.linalg.cholesky_ex(covariance)
        definite = failed == 0
        # A factor has the root of its covariance's condition.
        largest = 1.0 / math.sqrt(_round_off(lower))
    # In units of the deviations, the inverse's norm bounds how near to singular the factor is: beyond what round-off
    # leaves, a success of the decomposition is chance.
    with torch.no_grad():
        scaled = lower / torch.linalg.vector_norm(lower, dim=-1, keepdim=True)
        identity = torch.eye(lower.shape[-1], dtype=lower.dtype, device=lower.device)
        inverse = torch.linalg.solve_triangular(scaled, identity, upper=False)
        return lower, definite & (torch.linalg.matrix_norm(inverse) < largest)


def _round_off(matrix: Tensor) -> float:
    return 4.0 * matrix.shape[-1] * torch.finfo(matrix.dtype).eps


def _require_shapes(error_shape: Sequence[int], covariance: Tensor | None, factor: Tensor | None) -> None:
    if (covariance is None) == (factor is None):
        raise ValueError("give either covariance or factor, one and only one of them")
    size = error_shape[-1] if len(error_shape) else 0
    if size == 0:
        raise ValueError(f"errors must be (..., n) with n > 0, not {tuple(error_shape)}")
    if covariance is not None:
        shape = covariance.shape
        if len(shape) < 2 or tuple(shape[-2:]) != (size, size):
            raise ValueError(f"covariance must be (..., {size}, {size}) for errors (..., {size}), not {tuple(shape)}")
    elif factor is not None:
        shape = factor.shape
        if len(shape) < 2 or shape[-2] != size or shape[-1] < size:
            raise ValueError(
                f"factor must be (..., {size}, k) with k >= {size} for errors (..., {size}), not {tuple(shape)}"
            )
    try:
        torch.broadcast_shapes(error_shape[:-1], shape[:-2])
    except RuntimeError:
        raise ValueError(
            f"leading dimensions of errors {tuple(error_shape)} and covariance or factor {tuple(shape)} do not "
            "broadcast"
        ) from None


def _require_probability(probability: float) -> None:
    if not 0 < probability < 1:
        raise ValueError(f"probability must be between 0 and 1, not {probability}; 95 % is 0.95")


def _to_float64(values: Tensor) -> Tensor:
    return values.detach().to("cpu", torch.float64)
