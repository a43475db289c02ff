"""Scores of probabilities and sigmas against scipy, loops and values counted by hand."""

import numpy as np
import pytest
from scipy import stats

from sigmaslam_evaluation.metrics.probability_calibration import (
    auroc,
    average_precision,
    best_half,
    calibration_error,
    spearman,
)

RNG = np.random.default_rng(0)
RIGHT = RNG.random(300) < 0.4
SCORES = RIGHT + RNG.standard_normal(300)
# With many that are the same.
COARSE = np.round(2.0 * SCORES)


# Right before wrong


@pytest.mark.parametrize("score", [SCORES, COARSE], ids=["distinct", "ties"])
def test_auroc_is_the_share_of_ordered_pairs(score: np.ndarray):
    statistic = stats.mannwhitneyu(score[RIGHT], score[~RIGHT]).statistic
    assert auroc(score, RIGHT) == pytest.approx(statistic / (RIGHT.sum() * (~RIGHT).sum()))


def test_auroc_of_perfect_reversed_and_uninformed_scores():
    assert auroc(RIGHT.astype(float), RIGHT) == 1.0
    assert auroc(-RIGHT.astype(float), RIGHT) == 0.0
    assert auroc(np.zeros(300), RIGHT) == 0.5


@pytest.mark.parametrize("score", [SCORES, COARSE], ids=["distinct", "ties"])
def test_auroc_sees_the_order_alone(score: np.ndarray):
    assert auroc(np.exp(score), RIGHT) == auroc(score, RIGHT)


@pytest.mark.parametrize("right", [np.ones(5, bool), np.zeros(5, bool), np.zeros(0, bool)])
def test_auroc_of_one_kind_is_not_a_number(right: np.ndarray):
    assert np.isnan(auroc(np.arange(float(len(right))), right))


def test_average_precision_equals_the_definition_written_as_a_loop():
    order = sorted(range(300), key=lambda row: -SCORES[row])
    precision = [np.mean([RIGHT[row] for row in order[: k + 1]]) for k in range(300) if RIGHT[order[k]]]
    assert average_precision(SCORES, RIGHT) == pytest.approx(np.mean(precision))


@pytest.mark.parametrize(
    ("right", "expected"), [([1, 1, 0, 0], 1.0), ([0, 0, 1, 1], (1 / 3 + 2 / 4) / 2), ([1, 0, 1, 0], (1 + 2 / 3) / 2)]
)
def test_average_precision_of_four_is_what_one_counts(right: list[int], expected: float):
    """From the largest score down, in any order of the rows."""
    score, rows = np.array([0.9, 0.7, 0.4, 0.1]), np.array([2, 0, 3, 1])
    assert average_precision(score[rows], np.array(right, bool)[rows]) == pytest.approx(expected)


def test_average_precision_without_a_right_one_is_not_a_number():
    assert np.isnan(average_precision(SCORES, np.zeros(300, bool)))


# Sigma and error


def test_spearman_equals_scipys():
    a, b = np.random.default_rng(1).standard_normal((2, 200))
    assert spearman(a, a + b) == pytest.approx(stats.spearmanr(a, a + b).statistic)
    assert spearman(a, np.exp(a)) == pytest.approx(1.0)
    assert spearman(a, -(a**3)) == pytest.approx(-1.0)


def test_spearman_equals_scipys_where_values_are_the_same():
    """Sigmas at their bounds are."""
    a, b = np.round(2.0 * np.random.default_rng(2).standard_normal((2, 200)))
    assert spearman(a, a + b) == pytest.approx(stats.spearmanr(a, a + b).statistic)


def test_spearman_of_one_value_is_not_a_number():
    assert np.isnan(spearman(np.ones(1), np.ones(1)))


def test_best_half_of_known_errors_is_what_one_counts():
    sigma, error = np.array([3.0, 1.0, 2.0, 4.0]), np.array([5.0, 1.0, 3.0, 1.0])
    assert best_half(sigma, error) == pytest.approx(np.sqrt((1.0 + 9.0) / 2.0 / (36.0 / 4.0)))


def test_best_half_is_small_for_the_true_sigma_and_one_for_a_constant_error():
    rng = np.random.default_rng(3)
    sigma = np.exp(rng.standard_normal(2000))
    assert best_half(sigma, sigma * rng.standard_normal(2000)) < 0.4
    assert best_half(sigma, np.full(2000, 3.0)) == pytest.approx(1.0)


# Probability


@pytest.mark.parametrize("bins_used", [1, 4, 15])
def test_calibration_error_of_shares_that_hold_is_zero(bins_used: int):
    """Twenty matches a bin, of a probability k / 20 in it, of which k are right."""
    probability, right = [], []
    for bin_ in range(bins_used):
        k = int(np.ceil(20.0 * bin_ / 15.0))
        assert bin_ / 15.0 <= k / 20.0 < (bin_ + 1) / 15.0
        probability += [k / 20.0] * 20
        right += [True] * k + [False] * (20 - k)
    assert calibration_error(np.array(probability), np.array(right)) == pytest.approx(0.0, abs=1e-12)


def test_calibration_error_is_the_mean_gap_over_bins_by_their_size():
    """30 of probability 0.9 of which 20 are right, 10 of probability 0.1 of which 4 are right."""
    probability = np.r_[np.full(30, 0.9), np.full(10, 0.1)]
    right = np.r_[np.arange(30) < 20, np.arange(10) < 4]
    assert calibration_error(probability, right) == pytest.approx(0.75 * abs(0.9 - 2 / 3) + 0.25 * abs(0.1 - 0.4))


def test_gaps_within_one_bin_cancel_and_those_of_two_do_not():
    right = np.array([True, False])
    assert calibration_error(np.array([0.40, 0.46]), right) == pytest.approx(abs(0.43 - 0.5))
    assert calibration_error(np.array([0.35, 0.65]), right) == pytest.approx(0.5 * (0.65 + 0.65))


def test_certain_and_impossible_matches_count_in_the_outer_bins():
    assert calibration_error(np.array([0.0, 1.0]), np.array([False, True])) == 0.0
    assert calibration_error(np.array([0.0, 1.0]), np.array([True, False])) == 1.0


def test_calibration_error_of_nothing_is_zero():
    assert calibration_error(np.zeros(0), np.zeros(0, bool)) == 0.0


def test_calibration_error_of_probabilities_that_hold_vanishes_with_their_number():
    rng = np.random.default_rng(6)
    probability = rng.random(100_000)
    right = rng.random(100_000) < probability
    assert calibration_error(probability, right) < 0.01
    assert calibration_error(probability**2, right) > 0.1
