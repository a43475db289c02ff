"""The match verifier's rows, loss, training and calibration on rows whose law is known."""

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from sigmaslam.errors import InputError
from sigmaslam.frontend.nearest_neighbours import Putative
from sigmaslam.frontend.types import Features
from sigmaslam_evaluation.metrics.probability_calibration import calibration_error
from sigmaslam_models.scorer_network import MatchScorer
from sigmaslam_models.verifier_network import VERIFIER_COLUMNS, MatchVerifier
from sigmaslam_synthetic.rendering.textures import dead_leaves
from sigmaslam_training.matching import verifier_training as verifier_training
from sigmaslam_training.matching.match_sets import MatchSet, PairRecord
from sigmaslam_training.matching.verifier_training import (
    VerifierRows,
    calibrate,
    collect_rows,
    train_verifier,
    verifier_loss,
)

pytestmark = pytest.mark.usefixtures("one_thread")
CHI_SQUARE_95 = stats.chi2(2).ppf(0.95)
FREEDOM = 20.0
SHIFT = np.array([6.0, -4.0])


def student_errors(count: int, sigma: tuple[float, float]) -> Tensor:
    """(count, 2) draws of the law of the loss, of those scales along the axes."""
    draws = stats.multivariate_t(shape=np.eye(2), df=FREEDOM, seed=0).rvs(count)
    return torch.from_numpy((draws * sigma).astype(np.float32))


def untrained() -> MatchVerifier:
    torch.manual_seed(0)
    return MatchVerifier().eval()


def known_rows(
    verifier: MatchVerifier, count: int, factor: float, scale: float, shift: float, seed: int = 1
) -> VerifierRows:
    """Rows for which sigmas are right once multiplied by the factor, and logits once scaled and shifted."""
    rng = np.random.default_rng(seed)
    columns = rng.standard_normal((count, VERIFIER_COLUMNS)).astype(np.float32)
    # Sigmas of less than half a pixel: right matches are within 3 px of the truth.
    columns[:, 1] -= 4.0
    with torch.no_grad():
        logit, log_sigma = (values.double().numpy() for values in verifier(torch.from_numpy(columns)))
    right = rng.random(count) < 1.0 / (1.0 + np.exp(-(scale * logit + shift)))
    error = factor * np.exp(log_sigma) * rng.standard_normal((count, 2))
    error[~right] = 100.0
    return VerifierRows(columns, error.astype(np.float32), np.zeros(count, int))


# Loss


def test_loss_is_the_cross_entropy_and_the_likelihood_of_right_ones():
    logit, error = torch.tensor([1.0, -2.0, 0.5]), torch.tensor([[0.3, -0.4], [2.0, 1.0], [40.0, 0.0]])
    log_sigma = torch.tensor([[-1.0, 0.2], [0.5, 0.1], [1.0, 1.0]])
    right = np.array([1.0, 1.0, 0.0])
    p = 1.0 / (1.0 + np.exp(-logit.numpy().astype(float)))
    entropy = -np.mean(right * np.log(p) + (1.0 - right) * np.log(1.0 - p))
    densities = [
        stats.multivariate_t(shape=np.diag(np.exp(2.0 * s)), df=FREEDOM).logpdf(e)
        for s, e in zip(log_sigma.numpy()[:2], error.numpy()[:2], strict=True)
    ]
    constant = stats.multivariate_t(shape=np.eye(2), df=FREEDOM).logpdf([0.0, 0.0])
    expected = entropy + constant - np.mean(densities)
    assert float(verifier_loss(logit, log_sigma, error)) == pytest.approx(expected, rel=1e-5)


def test_loss_is_least_at_the_true_sigmas_of_both_axes():
    true = (0.2, 0.5)
    error = student_errors(20_000, true)

    def loss(factor0: float, factor1: float) -> float:
        log_sigma = torch.log(torch.tensor([factor0 * true[0], factor1 * true[1]])).expand(20_000, 2)
        return float(verifier_loss(torch.zeros(20_000), log_sigma, error))

    others = [(0.5, 1.0), (2.0, 1.0), (1.0, 0.5), (1.0, 2.0), (0.95, 1.0), (1.05, 1.0), (1.0, 0.95), (1.0, 1.05)]
    assert loss(1.0, 1.0) < min(loss(*factors) for factors in others)


def test_wrong_matches_have_no_part_in_sigma():
    error = student_errors(100, (0.3, 0.3))
    log_sigma = torch.full((100, 2), -1.0, requires_grad=True)
    error[::2] = torch.tensor([1000.0, 1000.0])
    verifier_loss(torch.zeros(100), log_sigma, error).backward()
    assert (log_sigma.grad[::2] == 0).all()
    assert (log_sigma.grad[1::2] != 0).all()
    log_sigma.grad = None
    verifier_loss(torch.zeros(50), log_sigma[::2], error[::2]).backward()
    assert (log_sigma.grad == 0).all()


# Calibration


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_calibrated_ellipses_hold_what_they_promise(factor: float):
    verifier = untrained()
    calibrate(verifier, known_rows(verifier, 20_000, factor, 1.0, 0.0))
    assert float(verifier.sigma_scale) == pytest.approx(factor, rel=0.03)
    held_out = known_rows(untrained(), 20_000, factor, 1.0, 0.0, seed=2)
    with torch.no_grad():
        _, log_sigma = verifier(torch.from_numpy(held_out.inputs))
    square = ((held_out.error / np.exp(log_sigma.numpy())) ** 2).sum(axis=1)[held_out.right]
    assert (square < CHI_SQUARE_95).mean() == pytest.approx(0.95, abs=0.01)


def larger_logits() -> MatchVerifier:
    """Of some spread: those of fresh weights are hardly different."""
    verifier = untrained()
    with torch.no_grad():
        verifier.layers[-1].weight[0] *= 25.0
    return verifier


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (0.25, 0.5), (0.5, -1.5), (3.0, 1.0)])
def test_calibrated_probabilities_are_the_shares_of_right_matches(scale: float, shift: float):
    verifier = larger_logits()
    rows = known_rows(verifier, 30_000, 1.0, scale, shift)
    held_out = known_rows(verifier, 30_000, 1.0, scale, shift, seed=2)

    def expected_error() -> float:
        with torch.no_grad():
            logit, _ = verifier(torch.from_numpy(held_out.inputs))
        return calibration_error(torch.sigmoid(logit).numpy(), held_out.right)

    before = expected_error()
    calibrate(verifier, rows)
    assert float(verifier.logit_scale) == pytest.approx(scale, rel=0.1)
    assert float(verifier.logit_shift) == pytest.approx(shift, abs=0.1)
    assert expected_error() < 0.015
    assert before > 0.05 or (scale, shift) == (1.0, 0.0)


def test_logits_ten_times_too_certain_are_calibrated():
    verifier = larger_logits()
    verifier.logit_scale.fill_(10.0)
    calibrate(verifier, known_rows(larger_logits(), 10_000, 1.0, 1.0, 0.0))
    assert float(verifier.logit_scale) == pytest.approx(1.0, rel=0.1)


def test_what_was_fitted_before_does_not_matter():
    fresh, fitted = larger_logits(), larger_logits()
    rows = known_rows(fresh, 10_000, 2.0, 0.5, -1.0)
    fitted.logit_scale.fill_(0.7)
    fitted.logit_shift.fill_(2.0)
    fitted.sigma_scale.fill_(0.3)
    results = []
    for verifier in (fresh, fitted):
        calibrate(verifier, rows)
        results.append([float(each) for each in (verifier.logit_scale, verifier.logit_shift, verifier.sigma_scale)])
    np.testing.assert_allclose(results[1], results[0], rtol=1e-3, atol=1e-3)


def test_calibration_leaves_the_weights():
    verifier = larger_logits()
    before = {name: value.clone() for name, value in verifier.named_parameters()}
    calibrate(verifier, known_rows(verifier, 2_000, 2.0, 0.5, -1.0))
    for name, value in verifier.named_parameters():
        assert torch.equal(value, before[name]), name
        assert value.grad is None, name


# Training


@pytest.mark.long
def test_training_finds_the_sigma_and_the_probability_of_each_kind_of_match(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """Two kinds that one column tells apart."""
    monkeypatch.setattr(verifier_training, "_BATCH", 512)
    rng = np.random.default_rng(0)
    columns = rng.standard_normal((4000, VERIFIER_COLUMNS)).astype(np.float32)
    kind = (np.arange(4000) % 2).astype(bool)
    columns[:, 0] = np.where(kind, 1.0, -1.0)
    columns[:, [1, 4, 5]] = 0.0
    error = np.where(kind[:, None], 0.1, 0.6) * rng.standard_normal((4000, 2))
    error[rng.random(4000) < np.where(kind, 0.1, 0.7)] = 100.0
    notes: list[int] = []
    rows = VerifierRows(columns, error.astype(np.float32), np.zeros(4000, int))
    verifier = train_verifier(rows, 150, 0, tmp_path / "verifier.safetensors", lambda step, _: notes.append(step))
    assert notes == list(range(1, 151))
    with torch.no_grad():
        logit, log_sigma = verifier(torch.from_numpy(columns))
    for which, sigma, share in ((kind, 0.1, 0.9), (~kind, 0.6, 0.3)):
        assert float(log_sigma[which].exp().median()) == pytest.approx(sigma, rel=0.15)
        assert float(torch.sigmoid(logit[which]).mean()) == pytest.approx(share, abs=0.08)


@pytest.fixture
def small_batch(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(verifier_training, "_BATCH", 64)


def assert_same_weights(a: MatchVerifier, b: MatchVerifier) -> None:
    for name, value in a.state_dict().items():
        assert torch.equal(value, b.state_dict()[name]), name


@pytest.mark.usefixtures("small_batch")
def test_a_stopped_run_ends_bit_for_bit_as_one_that_was_not(tmp_path: Path):
    def stop(step: int, note: str) -> None:
        if step == 3:
            raise KeyboardInterrupt

    rows, taken = known_rows(untrained(), 300, 1.0, 1.0, 0.0), []
    whole = train_verifier(rows, 5, 0, tmp_path / "whole.safetensors", lambda step, note: None)
    stopped = tmp_path / "stopped.safetensors"
    with pytest.raises(KeyboardInterrupt):
        train_verifier(rows, 5, 0, stopped, stop)
    assert_same_weights(train_verifier(rows, 5, 0, stopped, lambda step, note: taken.append(step)), whole)
    assert taken == [4, 5]
    with pytest.raises(InputError, match=r"made with steps 5, not steps 6"):
        train_verifier(rows, 6, 0, stopped, stop)


@pytest.mark.usefixtures("small_batch")
def test_the_same_seed_trains_the_same_weights(tmp_path: Path):
    rows = known_rows(untrained(), 300, 1.0, 1.0, 0.0)
    first, second, other = (
        train_verifier(rows, 3, seed, tmp_path / f"{name}.safetensors", lambda step, note: None)
        for name, seed in (("a", 0), ("b", 0), ("c", 1))
    )
    assert_same_weights(first, second)
    assert not torch.equal(first.layers[0].weight, other.layers[0].weight)
    torch.testing.assert_close(first.mean, torch.from_numpy(rows.inputs.mean(axis=0)), rtol=0, atol=1e-5)


# Rows


def shifted_record(source: str, seed: int = 0) -> PairRecord:
    """A texture and the same moved by (6, -4) pixels, with matches about half a pixel off; a few have no truth."""
    rng = np.random.default_rng(seed)
    texture = dead_leaves((200, 240), rng)
    image0, image1 = texture[10:190, 10:210], texture[14:194, 4:204]
    keypoints0 = rng.uniform(30.0, 150.0, (60, 2)).astype(np.float32)
    keypoints1 = (keypoints0 + SHIFT + rng.normal(0.0, 0.4, (60, 2))).astype(np.float32)
    places = keypoints0.astype(np.float64) + SHIFT
    visible = np.arange(60) >= 6
    features0, features1 = (
        Features(points, np.zeros((60, 0), np.float32), rng.random(60, np.float32), np.ones(60, np.float32))
        for points in (keypoints0, keypoints1)
    )
    index = np.arange(60)
    similarity, second = np.full(60, 0.9, np.float32), rng.uniform(0.0, 0.8, 60).astype(np.float32)
    second[-10:] = 0.95
    putative = Putative(index, index, similarity, second, second)
    return PairRecord(image0, image1, {"sift": MatchSet(source, features0, features1, putative, places, visible)})


@pytest.mark.parametrize(
    ("source", "times", "mapped"),
    [("stereo", 1, [0.0]), ("planes", 1, [1.0]), ("turned planes", 1, [1.0]), ("scenes", 2, [0.0, 1.0])],
)
def test_mutual_matches_are_refined_as_at_run_time(source: str, times: int, mapped: list[float]):
    torch.manual_seed(0)
    done: list[int] = []
    rows = collect_rows([shifted_record(source), shifted_record(source, 1)], MatchScorer(), done.append)
    assert done == [1, 2]
    assert rows.inputs.shape == (2 * 50 * times, VERIFIER_COLUMNS)
    assert np.unique(rows.inputs[:, 9]).tolist() == mapped
    assert np.bincount(rows.pair).tolist() == [50 * times, 50 * times]
    assert np.isfinite(rows.inputs).all()
    assert np.isfinite(rows.error).all()


def test_errors_are_those_of_the_refined_places_and_unknown_ones_are_wrong():
    torch.manual_seed(0)
    rows = collect_rows([shifted_record("stereo")], MatchScorer(), lambda done: None)
    assert not rows.right[:6].any()
    assert (np.abs(rows.error[:6]).max(axis=1) > 500.0).all()
    assert rows.right[6:].mean() > 0.95
    # Detected half a pixel off; refined to a few hundredths.
    assert np.median(np.linalg.norm(rows.error[6:], axis=1)) < 0.1


def test_matches_that_the_scorer_has_no_hope_for_are_left_out(monkeypatch: pytest.MonkeyPatch):
    torch.manual_seed(0)
    records = shifted_record("stereo"), shifted_record("stereo", 1)
    every = collect_rows(records, MatchScorer(), lambda done: None)
    hope = np.where(np.arange(60) % 2 == 0, -4.1, -3.9).astype(np.float32)
    monkeypatch.setattr(verifier_training, "score_set", lambda scorer, found: hope)
    some = collect_rows(records, MatchScorer(), lambda done: None)
    np.testing.assert_allclose(some.error, every.error[1::2], atol=1e-6)
    np.testing.assert_array_equal(some.pair, every.pair[1::2])


def test_selected_rows_stay_together():
    rows = known_rows(untrained(), 50, 1.0, 1.0, 0.0)
    part = rows.select(rows.right)
    assert part.right.all()
    assert 0 < len(part.pair) == rows.right.sum() < 50
    np.testing.assert_array_equal(part.inputs, rows.inputs[rows.right])
