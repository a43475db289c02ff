"""The cluster-robust factor: one for independent errors, and what Monte Carlo finds where neighbours err alike."""

import numpy as np
import pytest

from sigmaslam.estimation.clustered_errors import SharedErrors, clustering
from sigmaslam.estimation.frame_fit import FrameFit, FramePosterior

SIZE = (640, 480)


def scores_of(seed: int, shared: float, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Places, scores and information of a weighted fit of six numbers, and the error of the fit.

    Views have noise of variance one, of which neighbours in cells of 80 px share a part.
    """
    rng = np.random.default_rng(seed)
    places = rng.uniform((0, 0), SIZE, (count, 2))
    x, y = (2.0 * places / SIZE - 1.0).T
    one = np.ones(count)
    slopes = np.stack([one, x, y, x * y, x * x, y * y], axis=1)
    cell = (places // 80).astype(int)
    common = rng.standard_normal((8, 6))[cell[:, 0], cell[:, 1]]
    noise = np.sqrt(shared) * common + np.sqrt(1.0 - shared) * rng.standard_normal(count)
    information = slopes.T @ slopes
    error = np.linalg.solve(information, slopes.T @ noise)
    return places, slopes * (noise - slopes @ error)[:, None], information, error


def test_independent_errors_have_nothing_in_common():
    draws = [scores_of(seed, 0.0) for seed in range(200)]
    found = [clustering(places, SIZE, scores, information) for places, scores, information, _ in draws]
    assert 0.85 < np.mean(found) < 1.15


def fit_of(clustering: float) -> FrameFit:
    zero = np.zeros((6, 6))
    joint, scores = FramePosterior(np.zeros(6), zero, zero, zero, np.zeros(6)), np.zeros((9, 6))
    return FrameFit(
        np.eye(4), np.eye(4), zero, zero, np.zeros(12), joint, np.ones(9, bool), 9.0, 27, 1.0, clustering, scores
    )


def test_frames_are_averaged_but_a_large_factor_counts_at_once():
    shared = SharedErrors()
    found = [shared.averaged(fit_of(1.6 if k % 2 else 1.2)).clustering for k in range(200)]
    # Least believed at first, then what frames say in the mean.
    assert found[0] < 1.2 < found[-1]
    assert np.mean(found[-20:]) == pytest.approx(1.4, abs=0.02)
    assert shared.averaged(fit_of(5.0)).clustering == 5.0
    assert all(shared.averaged(fit_of(0.3)).clustering >= 1.0 for _ in range(100))


@pytest.mark.parametrize("shared", [0.5, 0.9])
def test_shared_errors_are_found_as_large_as_they_are(shared: float):
    draws = [scores_of(seed, shared) for seed in range(200)]
    # NEES of the fit per degree of freedom is by how much its variances are too small.
    truth = np.mean([error @ information @ error / 6.0 for _, _, information, error in draws])
    found = np.mean([clustering(places, SIZE, scores, information) for places, scores, information, _ in draws])
    assert truth > 3.0
    # Residuals hide a part of what is shared: a factor that is too small is what to expect of few cells.
    assert 0.6 * truth < found < 1.2 * truth


def test_a_body_that_moves_on_its_own_is_seen():
    places, scores, information, _ = scores_of(1, 0.0)
    inside = (np.abs(places - (160, 240)) < (100, 150)).all(axis=1)
    pulled = scores.copy()
    pulled[inside] = np.abs(scores[inside]) * 2.0
    pulled[~inside] -= pulled.sum(axis=0) / (~inside).sum()
    assert clustering(places, SIZE, pulled, information) > 3.0


def test_few_or_unused_views_say_nothing():
    places, scores, information, _ = scores_of(0, 0.9)
    assert clustering(places, SIZE, np.zeros_like(scores), information) == 1.0
    alone = np.where(np.arange(len(scores))[:, None] == 0, scores, 0.0)
    assert clustering(places, SIZE, alone, information) == 1.0


def test_an_upright_image_has_upright_cells():
    places, scores, information, _ = scores_of(3, 0.9)
    turned = clustering(places[:, ::-1], SIZE[::-1], scores, information)
    assert turned == pytest.approx(clustering(places, SIZE, scores, information))
