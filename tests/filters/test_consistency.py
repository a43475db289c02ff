import io
import math
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from scipy.stats import binomtest, chi2, norm, t
from torch import Tensor

from sigmaslam_filters import consistency
from sigmaslam_filters.consistency.plots import plot_coverage, plot_nees, plot_whiteness
from tests.support.filter_builders import covariances, random_numbers

axis_coverage = partial(consistency.coverage, by_axis=True)


def correlated(runs: int, steps: int, size: int, correlation: float, seed: int = 0) -> Tensor:
    """Standard normal errors that remember the step before, as those of a filter do."""
    errors = random_numbers(runs, steps, size, seed=seed)
    for step in range(1, steps):
        kept = correlation * errors[:, step - 1]
        errors[:, step] = kept + math.sqrt(1 - correlation**2) * errors[:, step]
    return errors


def run_kalman_filter(runs: int, steps: int, process_scale: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """NEES (runs, steps) and whitened innovations (runs, steps, 1) of a filter that follows a point's position.

    The point is pushed by white noise of acceleration; the filter takes its variance `process_scale` times the truth.
    """
    F = torch.tensor([[1.0, 0.1], [0.0, 1.0]], dtype=torch.float64)
    H = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    Q = torch.tensor([[0.1**3 / 3, 0.1**2 / 2], [0.1**2 / 2, 0.1]], dtype=torch.float64)
    R = torch.tensor([[0.01]], dtype=torch.float64)
    push = random_numbers(steps, runs, 2, seed=seed) @ torch.linalg.cholesky(Q).T
    noise = 0.1 * random_numbers(steps, runs, 1, seed=seed + 1)
    P = torch.eye(2, dtype=torch.float64)
    truth, mean = random_numbers(runs, 2, seed=seed + 2), torch.zeros(runs, 2, dtype=torch.float64)
    values, innovations = [], []
    for step in range(steps):
        truth = truth @ F.T + push[step]
        mean, P = mean @ F.T, F @ P @ F.T + process_scale * Q
        innovation, S = truth @ H.T + noise[step] - mean @ H.T, H @ P @ H.T + R
        innovations.append(consistency.whiten(innovation, S))
        K = P @ H.T / S
        mean, P = mean + innovation @ K.T, P - K @ S @ K.T
        values.append(consistency.nees(mean - truth, P))
    return torch.stack(values, dim=1), torch.stack(innovations, dim=1)


# NEES and NIS


def test_nees_of_known_values():
    error = torch.tensor([3.0, 4.0])
    assert float(consistency.nees(error, torch.eye(2))) == pytest.approx(25.0)
    assert float(consistency.nees(error, torch.diag(torch.tensor([9.0, 4.0])))) == pytest.approx(1.0 + 4.0)
    assert float(consistency.nees(error, factor=torch.diag(torch.tensor([3.0, 2.0])))) == pytest.approx(1.0 + 4.0)


@settings(max_examples=25, deadline=None)
@given(size=st.integers(1, 12), batch=st.lists(st.integers(1, 3), max_size=2), seed=st.integers(0, 1000))
def test_nees_equals_the_quadratic_form(size, batch, seed):
    error, P = random_numbers(*batch, size, seed=seed), covariances(*batch, size, seed=seed)
    expected = (error.unsqueeze(-2) @ torch.linalg.solve(P, error.unsqueeze(-1)))[..., 0, 0]
    torch.testing.assert_close(consistency.nees(error, P), expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("columns", [5, 8])
def test_any_square_root_gives_what_the_covariance_gives(columns):
    error, factor = random_numbers(10, 5, seed=1), random_numbers(10, 5, columns, seed=2)
    P = factor @ factor.mT
    torch.testing.assert_close(
        consistency.whiten(error, factor=factor), consistency.whiten(error, P), rtol=1e-7, atol=1e-9
    )
    torch.testing.assert_close(consistency.nees(error, factor=factor), consistency.nees(error, P), rtol=1e-7, atol=1e-9)


def test_a_factor_keeps_the_digits_that_its_covariance_loses():
    # Condition 1e9, its square beyond float64.
    factor = torch.tensor([[1.0, 0.0], [1.0, 1e-9]], dtype=torch.float64)
    error = factor @ torch.tensor([1.0, 2.0], dtype=torch.float64)
    assert consistency.nees(error, factor @ factor.T).isnan()
    assert float(consistency.nees(error, factor=factor)) == pytest.approx(5.0, rel=1e-5)


def test_nees_does_not_depend_on_units():
    error, P = random_numbers(6), covariances(6)
    units = torch.tensor([1e-6, 1e-3, 1.0, 1e2, 1e4, 1e6], dtype=torch.float64)
    torch.testing.assert_close(
        consistency.nees(error * units, P * units[:, None] * units), consistency.nees(error, P), rtol=1e-9, atol=0
    )


def test_a_batch_equals_a_loop_and_leading_dimensions_broadcast():
    error, P = random_numbers(4, 3, 5), covariances(3, 5)
    values = consistency.nees(error, P)
    assert values.shape == (4, 3)
    for i in range(4):
        for j in range(3):
            torch.testing.assert_close(values[i, j], consistency.nees(error[i, j], P[j]), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("as_factor", [False, True])
def test_a_bad_covariance_is_nan_and_leaves_the_others_alone(as_factor):
    error, factor = random_numbers(6, 3, seed=1), random_numbers(6, 3, 3, seed=2)
    factor[1, 2] = factor[1, 0]  # singular
    factor[2] = 0.0
    factor[3, 1, 1] = math.nan
    P = factor @ factor.mT
    if not as_factor:
        P[5] = -P[5]
    values = consistency.nees(error, factor=factor) if as_factor else consistency.nees(error, P)
    assert values.isnan().tolist() == [False, True, True, True, False, not as_factor]
    torch.testing.assert_close(values[[0, 4]], consistency.nees(error[[0, 4]], P[[0, 4]]))


def test_a_singular_covariance_is_nan_whatever_the_round_off():
    error, root = random_numbers(500, 6), random_numbers(500, 6, 5)
    wide = torch.cat([root, 2 * root], dim=-1)
    for dtype in (torch.float64, torch.float32):
        assert consistency.nees(error.to(dtype), (root @ root.mT).to(dtype)).isnan().all()
        assert consistency.nees(error.to(dtype), factor=wide.to(dtype)).isnan().all()


def test_nees_can_be_trained_through():
    error, P = random_numbers(2, 3).requires_grad_(), covariances(2, 3).requires_grad_()

    def of_symmetric_part(error: Tensor, P: Tensor) -> Tensor:
        return consistency.nees(error, (P + P.mT) / 2)

    assert torch.autograd.gradcheck(of_symmetric_part, (error, P))


def test_dtype_follows_the_input():
    error, P = random_numbers(4, 3).float(), covariances(3).float()
    assert consistency.nees(error, P).dtype == torch.float32
    assert consistency.check_nees(consistency.nees(error, P)[:, None], 3).low.dtype == torch.float32
    assert consistency.whiteness(consistency.whiten(error, P)[None], 2).band.dtype == torch.float32
    assert consistency.coverage(error, P).share.dtype == torch.float32


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(3),), "either covariance or factor"),
        ((torch.tensor(0.0), torch.eye(1)), "errors must be"),
        ((torch.zeros(3), torch.eye(2)), r"covariance must be \(..., 3, 3\)"),
        ((torch.zeros(3), torch.ones(3)), r"covariance must be \(..., 3, 3\)"),
        ((torch.zeros(4, 3), torch.eye(3).expand(5, 3, 3)), "do not broadcast"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(arguments, message):
    for function in (
        consistency.whiten,
        consistency.nees,
        consistency.coverage,
        axis_coverage,
    ):
        with pytest.raises(ValueError, match=message):
            function(*arguments)


def test_a_factor_with_too_few_columns_is_refused():
    with pytest.raises(ValueError, match="k >= 3"):
        consistency.nees(torch.zeros(3), factor=torch.ones(3, 2))
    with pytest.raises(ValueError, match="either covariance or factor"):
        consistency.nees(torch.zeros(3), torch.eye(3), factor=torch.eye(3))


# The chi-square band


def test_band_of_a_known_case():
    low, high = consistency.chi_square_band(12, runs=200)
    assert (round(low, 2), round(high, 2)) == (11.33, 12.69)
    # Bar-Shalom et al. (2001), example 5.4.2: 50 runs of a state of two.
    low, high = consistency.chi_square_band(2, runs=50)
    assert (low, high) == (pytest.approx(1.484, abs=2e-3), pytest.approx(2.592, abs=2e-3))


@pytest.mark.parametrize(("dof", "runs", "probability"), [(1, 1, 0.9), (6, 20, 0.95), (19, 300, 0.99)])
def test_band_holds_its_probability_with_equal_tails(dof, runs, probability):
    low, high = consistency.chi_square_band(dof, runs, probability)
    assert chi2.cdf(low * runs, dof * runs) == pytest.approx((1 - probability) / 2)
    assert chi2.sf(high * runs, dof * runs) == pytest.approx((1 - probability) / 2)


def test_band_refuses_what_makes_no_sense():
    for dof in (0, -1, math.nan, math.inf):
        with pytest.raises(ValueError, match="dof must be positive"):
            consistency.chi_square_band(dof)
    with pytest.raises(ValueError, match="runs must be at least 1"):
        consistency.chi_square_band(3, runs=0)
    for probability in (0.0, 1.0, 95.0, math.nan):
        with pytest.raises(ValueError, match="probability must be between 0 and 1"):
            consistency.chi_square_band(3, probability=probability)


# Consistency of runs


def test_check_agrees_with_its_definitions():
    values = random_numbers(20, 30, 4).square().sum(dim=-1)
    check = consistency.check_nees(values, 4, probability=0.9)
    band = consistency.chi_square_band(4, 20, 0.9)
    torch.testing.assert_close(check.mean_per_step, values.mean(dim=0))
    torch.testing.assert_close(check.low, torch.full((30,), band[0], dtype=torch.float64))
    torch.testing.assert_close(check.high, torch.full((30,), band[1], dtype=torch.float64))
    assert (check.expected_per_step == 4).all()
    inside = (check.mean_per_step > band[0]) & (check.mean_per_step < band[1])
    assert check.share_inside == pytest.approx(float(inside.double().mean()))
    assert check.mean == pytest.approx(float(values.mean()))
    assert check.normalised_mean == pytest.approx(float(values.mean()) / 4)
    means = values.mean(dim=1).numpy()
    expected = t.interval(0.9, 19, means.mean(), means.std(ddof=1) / math.sqrt(20))
    assert check.interval == pytest.approx(expected)
    assert check.median == pytest.approx(float(np.median(values.numpy())))
    assert check.expected_median == pytest.approx(chi2.median(4))
    assert (check.dof, check.runs, check.count, check.nan_count, check.probability) == (4, 20, 600, 0, 0.9)


def test_false_alarms_are_as_rare_as_promised_when_steps_are_correlated():
    repeats = 250
    errors = correlated(repeats * 30, 40, 3, correlation=0.9).reshape(repeats, 30, 40, 3)
    checks = [consistency.check_nees(values, 3) for values in errors.square().sum(dim=-1)]
    alarms = sum(not check.consistent for check in checks)
    assert binomtest(alarms, repeats, 0.05).pvalue > 1e-3
    assert np.mean([check.share_inside for check in checks]) == pytest.approx(0.95, abs=0.01)
    assert np.mean([check.median / check.expected_median for check in checks]) == pytest.approx(1.0, abs=0.02)


def test_an_honest_filter_passes_and_an_overconfident_one_is_caught():
    errors = correlated(100, 50, 6, correlation=0.5, seed=4)
    honest = consistency.check_nees(consistency.nees(errors, torch.eye(6, dtype=torch.float64)), 6)
    assert honest.consistent
    assert honest.share_inside > 0.85
    for deviations in (0.8, 1.2):
        P = deviations**2 * torch.eye(6, dtype=torch.float64)
        wrong = consistency.check_nees(consistency.nees(errors, P), 6)
        assert not wrong.consistent
        assert wrong.share_inside < 0.2
        assert wrong.normalised_mean == pytest.approx(1 / deviations**2, rel=0.05)
    # A fifth of the variance is enough to be found.
    P = 0.8 * torch.eye(6, dtype=torch.float64)
    assert consistency.check_nees(consistency.nees(errors, P), 6).interval[0] > 6


def test_a_kalman_filter_is_consistent_and_white_until_its_process_noise_is_wrong():
    values, innovations = run_kalman_filter(100, 60, process_scale=1.0, seed=3)
    assert consistency.check_nees(values, 2).consistent
    assert consistency.check_nees(innovations.square().sum(dim=-1), 1).consistent
    assert consistency.whiteness(innovations, 20).p_value > 0.01
    values, innovations = run_kalman_filter(100, 60, process_scale=0.3, seed=3)
    assert consistency.check_nees(values, 2).interval[0] > 2.2
    assert consistency.whiteness(innovations, 20).p_value < 1e-4
    values, innovations = run_kalman_filter(100, 60, process_scale=3.0, seed=3)
    assert consistency.check_nees(values, 2).interval[1] < 1.8
    assert consistency.whiteness(innovations, 20).p_value < 1e-4


def test_nan_is_counted_and_fails_the_check():
    values = correlated(50, 20, 3, correlation=0.5).square().sum(dim=-1)
    assert consistency.check_nees(values, 3).consistent
    values[7, 3] = values[9, 3] = math.nan
    values[:, 5] = math.nan
    check = consistency.check_nees(values, 3)
    assert (check.nan_count, check.count) == (52, 948)
    assert not check.consistent
    assert check.interval[0] < 3 < check.interval[1]
    # The band is that of the runs that are left.
    assert (float(check.low[3]), float(check.high[3])) == pytest.approx(consistency.chi_square_band(3, 48))
    assert float(check.mean_per_step[3]) == pytest.approx(float(values[:, 3].nanmean()))
    assert check.mean_per_step.isnan().nonzero().flatten().tolist() == [5]


def test_steps_without_a_measurement_are_left_out():
    generator = torch.Generator().manual_seed(0)
    dof = torch.randint(0, 4, (60, 40), generator=generator) * 2
    dof[:, 10] = 0
    measured = torch.arange(6) < dof.unsqueeze(-1)
    values = (random_numbers(60, 40, 6) * measured).square().sum(dim=-1)
    values[dof == 0] = math.nan
    check = consistency.check_nees(values, dof)
    assert (check.nan_count, check.count) == (0, int((dof > 0).sum()))
    assert check.consistent
    assert check.share_inside == pytest.approx(0.95, abs=0.08)
    assert check.dof == pytest.approx(float(dof[dof > 0].double().mean()))
    assert check.normalised_mean == pytest.approx(float(values.nansum() / dof.sum()))
    step = dof[:, 7].double()
    number, total = int((step > 0).sum()), float(step.sum())
    assert float(check.expected_per_step[7]) == pytest.approx(total / number)
    assert float(check.high[7]) == pytest.approx(chi2.ppf(0.975, total) / number)
    assert check.mean_per_step[10].isnan()
    share = [float((dof[dof > 0] == k).double().mean()) for k in (2, 4, 6)]
    assert float(np.dot(share, chi2.cdf(check.expected_median, [2, 4, 6]))) == pytest.approx(0.5)


def test_dof_of_each_step_equals_dof_of_each_value():
    values = random_numbers(10, 6, 3).square().sum(dim=-1)
    dof = torch.tensor([3, 3, 2, 1, 0, 3])
    by_step, by_value = consistency.check_nees(values, dof), consistency.check_nees(values, dof.expand(10, 6))
    torch.testing.assert_close(by_step.low, by_value.low, equal_nan=True)
    assert by_step.interval == by_value.interval


def test_one_run_has_a_band_but_no_interval():
    check = consistency.check_nees(random_numbers(1, 300, 3).square().sum(dim=-1), 3)
    assert check.share_inside == pytest.approx(0.95, abs=0.05)
    assert all(math.isnan(end) for end in check.interval)
    assert not check.consistent


def test_a_check_of_nothing_but_nan_is_nan():
    check = consistency.check_nees(torch.full((3, 4), math.nan), 2)
    assert (check.count, check.nan_count, check.consistent) == (0, 12, False)
    for number in (check.mean, check.normalised_mean, check.median, check.expected_median, check.share_inside):
        assert math.isnan(number)


def test_an_infinite_value_fails_the_check():
    values = random_numbers(10, 6, 3).square().sum(dim=-1)
    values[0, 0] = math.inf
    assert not consistency.check_nees(values, 3).consistent


def test_the_arguments_of_a_check_are_not_changed():
    values = torch.tensor([[1.0, math.nan], [2.0, 3.0]])
    consistency.check_nees(values, 2)
    torch.testing.assert_close(values, torch.tensor([[1.0, math.nan], [2.0, 3.0]]), equal_nan=True)


@pytest.mark.parametrize(
    ("values", "dof", "probability", "message"),
    [
        (torch.zeros(5), 3, 0.95, r"\(runs, steps\)"),
        (torch.zeros(0, 5), 3, 0.95, "at least 1 of each"),
        (torch.zeros(2, 5, dtype=torch.int64), 3, 0.95, "floating-point"),
        (torch.zeros(2, 5), torch.ones(4), 0.95, r"\(4,\) does not fit"),
        (torch.zeros(2, 5), -1, 0.95, "not negative"),
        (torch.zeros(2, 5), math.nan, 0.95, "finite"),
        (torch.zeros(2, 5), 3, 1.0, "probability must be"),
    ],
)
def test_a_check_refuses_what_makes_no_sense(values, dof, probability, message):
    with pytest.raises(ValueError, match=message):
        consistency.check_nees(values, dof, probability)


# Whiteness


def test_false_alarms_of_whiteness_are_as_rare_as_promised():
    repeats = 200
    found = [consistency.whiteness(noise, 8) for noise in random_numbers(repeats, 10, 40, 2)]
    assert binomtest(sum(one.p_value < 0.05 for one in found), repeats, 0.05).pvalue > 1e-3
    assert np.mean([one.share_inside for one in found]) == pytest.approx(0.95, abs=0.015)


def test_autocorrelation_is_that_of_the_process():
    found = consistency.whiteness(correlated(200, 100, 2, correlation=0.6), 6)
    expected = 0.6 ** torch.arange(1, 7, dtype=torch.float64)
    torch.testing.assert_close(found.autocorrelation, expected, rtol=0, atol=0.03)
    assert found.share_inside == 0
    assert found.p_value < 1e-10
    pairs = 200 * torch.arange(99, 93, -1)
    torch.testing.assert_close(found.band, norm.ppf(0.975) / (2.0 * pairs.double()).sqrt())


def test_statistic_is_the_sum_of_squares_in_units_of_the_band():
    found = consistency.whiteness(random_numbers(3, 20, 1), 6)
    expected = (norm.ppf(0.975) * found.autocorrelation / found.band).square().sum()
    assert found.statistic == pytest.approx(float(expected))
    assert found.p_value == pytest.approx(chi2.sf(float(expected), 6))


def test_components_of_opposite_correlation_are_caught():
    noise = torch.cat([correlated(50, 60, 1, 0.3, seed=1), correlated(50, 60, 1, -0.3, seed=2)], dim=-1)
    found = consistency.whiteness(noise, 1)
    assert found.share_inside == 1  # their mean is small
    assert found.p_value < 1e-10


def test_whiteness_does_not_depend_on_scale():
    noise = correlated(5, 40, 3, correlation=0.2)
    scaled = noise * torch.tensor([0.1, 1.0, 7.0], dtype=torch.float64)
    assert consistency.whiteness(scaled, 5).statistic == pytest.approx(consistency.whiteness(noise, 5).statistic)


def test_a_bias_is_not_white():
    assert consistency.whiteness(random_numbers(20, 50, 2) + 0.5, 5).p_value < 1e-6


def test_nan_takes_only_its_pairs_from_whiteness():
    noise = random_numbers(4, 30, 2)
    noise[0, 10, 0] = math.nan
    noise[2, :, 1] = math.nan
    found = consistency.whiteness(noise, 3)
    assert found.nan_count == 31
    assert found.autocorrelation.isfinite().all()
    # Lag 1: 4 runs of 29 pairs, less the two pairs of one value, and less one run.
    expected = norm.ppf(0.975) * math.sqrt(1 / (4 * 29 - 2) + 1 / (3 * 29)) / 2
    assert float(found.band[0]) == pytest.approx(expected)


def test_a_component_never_measured_changes_nothing():
    noise = random_numbers(4, 30, 2)
    more = torch.cat([noise, torch.full((4, 30, 1), math.nan, dtype=torch.float64)], dim=-1)
    alone, together = consistency.whiteness(noise, 5), consistency.whiteness(more, 5)
    torch.testing.assert_close(together.autocorrelation, alone.autocorrelation)
    torch.testing.assert_close(together.band, alone.band)
    assert together.p_value == pytest.approx(alone.p_value)


def test_whiteness_refuses_what_makes_no_sense():
    with pytest.raises(ValueError, match=r"\(runs, steps, m\)"):
        consistency.whiteness(torch.zeros(4, 30), 3)
    for lags in (0, 30):
        with pytest.raises(ValueError, match="lags must be between 1 and 29"):
            consistency.whiteness(torch.zeros(4, 30, 1), lags)
    with pytest.raises(ValueError, match="probability must be"):
        consistency.whiteness(torch.zeros(4, 30, 1), 3, probability=0)


# Coverage


def test_coverage_of_an_honest_covariance_is_its_level():
    P = covariances(4)
    error = random_numbers(200, 100, 4) @ torch.linalg.cholesky(P).T
    found = consistency.coverage(error, P)
    torch.testing.assert_close(found.share, found.level, rtol=0, atol=0.012)
    assert (found.share.shape, int(found.count), int(found.nan_count)) == ((5,), 20000, 0)
    by_axis = axis_coverage(error, P)
    assert by_axis.share.shape == (4, 5)
    torch.testing.assert_close(by_axis.share, by_axis.level.expand(4, 5), rtol=0, atol=0.012)


def test_coverage_of_an_overconfident_covariance_falls_short():
    found = consistency.coverage(random_numbers(500, 3), 0.64 * torch.eye(3, dtype=torch.float64))
    assert (found.high < found.level).all()
    expected = chi2.cdf(0.64 * chi2.ppf(found.level.numpy(), 3), 3)
    torch.testing.assert_close(found.share, torch.as_tensor(expected), rtol=0, atol=0.06)


def test_axis_coverage_counts_within_k_sigma_and_finds_the_axis():
    error, P = random_numbers(1000, 3), torch.diag(torch.tensor([1.0, 0.25, 1.0], dtype=torch.float64))
    found = axis_coverage(error, P, levels=(0.6827,))
    expected = (error.abs() <= norm.ppf((1 + 0.6827) / 2) * P.diagonal().sqrt()).double().mean(dim=0)
    torch.testing.assert_close(found.share[:, 0], expected)
    assert ((found.low <= 0.6827) & (found.high >= 0.6827)).flatten().tolist() == [True, False, True]


def test_coverage_from_a_factor_equals_that_from_the_covariance():
    error, factor = random_numbers(50, 3, seed=1), random_numbers(3, 5, seed=2)
    P = factor @ factor.T
    for function in (consistency.coverage, axis_coverage):
        torch.testing.assert_close(function(error, factor=factor).share, function(error, P).share)


@pytest.mark.parametrize("inside", [0, 1, 30, 60])
def test_interval_of_coverage_is_that_of_wilson(inside):
    error = torch.full((60, 1), 10.0, dtype=torch.float64)
    error[:inside] = 0.0
    found = consistency.coverage(error, torch.eye(1, dtype=torch.float64), levels=(0.9,), probability=0.99)
    expected = binomtest(inside, 60).proportion_ci(0.99, method="wilson")
    assert (float(found.low), float(found.high)) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nan_is_counted_in_coverage():
    error, P = random_numbers(100, 2), torch.eye(2, dtype=torch.float64).repeat(100, 1, 1)
    error[3, 1] = math.nan
    P[5, 0, 0] = -1.0
    found, by_axis = consistency.coverage(error, P), axis_coverage(error, P)
    assert (int(found.count), int(found.nan_count)) == (98, 2)
    assert by_axis.nan_count.tolist() == [1, 1]
    nothing = consistency.coverage(torch.full((4, 2), math.nan), torch.eye(2))
    assert int(nothing.count) == 0
    assert nothing.share.isnan().all()


def test_coverage_refuses_levels_that_are_no_probabilities():
    for levels in ((), (0.5, 1.0), (0.0,), (95.0,)):
        with pytest.raises(ValueError, match="levels must be probabilities"):
            consistency.coverage(torch.zeros(3), torch.eye(3), levels=levels)


# Figures


def some_check(runs: int = 20, scale: float = 1.0) -> consistency.Consistency:
    values = scale * random_numbers(runs, 30, 3).square().sum(dim=-1)
    values[:, 12] = math.nan
    return consistency.check_nees(values, 3)


def band_of(figure: Figure) -> np.ndarray:
    """Corners of the shaded band, (N, 2)."""
    (band,) = figure.axes[0].collections[:1]
    return np.concatenate([path.vertices for path in band.get_paths()])


def line_of(figure: Figure, label: str) -> np.ndarray:
    (line,) = [line for line in figure.axes[0].get_lines() if line.get_label() == label]
    return np.asarray(line.get_xydata())


def test_nees_is_drawn_with_its_band():
    check = some_check()
    figure = plot_nees(check, seconds=0.1 * torch.arange(30), quantity="NIS")
    corners = band_of(figure)
    assert (corners[:, 1].min(), corners[:, 1].max()) == pytest.approx(consistency.chi_square_band(3, 20))
    # There is no band at the step without a value.
    assert not ((corners[:, 0] > 1.15 + 1e-6) & (corners[:, 0] < 1.25 - 1e-6)).any()
    np.testing.assert_allclose(line_of(figure, "mean NIS")[:, 1], check.mean_per_step.numpy())
    assert figure.axes[0].get_xlabel() == "time [s]"
    assert figure.axes[0].get_yscale() == "linear"
    assert "20 NaN" in figure.axes[0].get_title()


def test_nees_far_off_is_drawn_on_a_logarithmic_axis():
    assert plot_nees(some_check(scale=30.0)).axes[0].get_yscale() == "log"


def test_autocorrelation_is_drawn_with_its_band():
    found = consistency.whiteness(random_numbers(10, 50, 2), 12)
    figure = plot_whiteness(found)
    assert np.abs(band_of(figure)[:, 1]).max() == pytest.approx(float(found.band.max()))
    points = line_of(figure, "innovations")
    np.testing.assert_allclose(points[:, 0], np.arange(1, 13))
    np.testing.assert_allclose(points[:, 1], found.autocorrelation.numpy())


def test_coverage_is_drawn_with_its_interval():
    found = axis_coverage(random_numbers(80, 2), torch.eye(2, dtype=torch.float64))
    figure = plot_coverage(found, labels=["x", "y"], title="Position, metres")
    axes = figure.axes[0]
    for row, container in enumerate(axes.containers):
        points, _, (bars,) = container.lines
        np.testing.assert_allclose(np.asarray(points.get_ydata()), found.share[row].numpy())
        ends = np.array([path[:, 1] for path in bars.get_segments()])
        np.testing.assert_allclose(ends, torch.stack([found.low[row], found.high[row]], dim=-1).numpy(), atol=1e-9)
    assert [text.get_text() for text in axes.get_legend().get_texts()][1:] == ["x", "y"]
    assert axes.get_title() == "Position, metres"


@pytest.mark.parametrize(
    "draw",
    [
        lambda: plot_nees(some_check(runs=1)),
        lambda: plot_nees(consistency.check_nees(torch.full((2, 1), math.nan), 3)),
        lambda: plot_whiteness(consistency.whiteness(random_numbers(2, 5, 1), 1)),
        lambda: plot_coverage(consistency.coverage(torch.full((4, 2), math.nan), torch.eye(2))),
    ],
    ids=["one run", "nothing but NaN", "one lag", "no samples"],
)
def test_edge_cases_are_drawn(draw: Callable[[], Figure]):
    target = io.BytesIO()
    draw().savefig(target, format="svg")
    assert target.tell() > 0


def test_figures_refuse_what_does_not_fit():
    with pytest.raises(ValueError, match=r"seconds must be \(30,\)"):
        plot_nees(some_check(), seconds=torch.arange(5.0))
    with pytest.raises(ValueError, match="labels must be 2"):
        plot_coverage(axis_coverage(random_numbers(8, 2), torch.eye(2, dtype=torch.float64)), labels=["x"])
