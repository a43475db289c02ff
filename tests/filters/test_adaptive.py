"""Noise that adapts finds the noise there is."""

import pytest
import torch

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import covariances, random_numbers, tensor

EYE = torch.eye(2, dtype=torch.float64)
WALK = filters.LinearMotion(EYE, 0.01 * EYE)
PRIOR = filters.Gaussian(tensor(0.0, 0.0), EYE)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["diagonal", "dense"])
@pytest.mark.parametrize("robust", [None, "student_t"])
def test_noise_that_adapts_finds_the_noise_there_is(kind, robust):
    """From 25 times too large, of two sensors in one measurement; the robust weights have heavy-tailed noise to do."""
    truth = torch.diag(tensor(0.04, 0.25)) if kind == "diagonal" else covariances(2, seed=1, scale=0.2)
    root = torch.linalg.cholesky(truth)
    noise = filters.Diagonal(25.0 * truth.diagonal()) if kind == "diagonal" else filters.Dense(25.0 * truth)
    steps, bayes, belief, state = 600, filters.KalmanFilter(), PRIOR, tensor(0.0, 0.0)
    draws, moves = random_numbers(steps, 2, 2, seed=2), 0.1 * random_numbers(steps, 2, seed=3)
    if robust:
        draws = draws / (random_numbers(4, steps, 2, 1, seed=4).square().mean(dim=0)).sqrt()
    late = []
    for k in range(steps):
        state = state + moves[k]
        value = (state + draws[k] @ root.mT).flatten()
        value[k % 4] = torch.nan if k % 5 == 0 else value[k % 4]
        see = filters.several(filters.LinearMeasurement(EYE, noise), 2)
        update = bayes.update(bayes.predict(belief, WALK).belief, see, value, robust=robust)
        noise, belief = filters.adapted_noise(noise, update, value, 0.03), update.belief
        late.append(noise.covariance())
    found = torch.stack(late[steps // 2 :]).mean(dim=0)
    scale = truth.diagonal().sqrt()
    assert_close(found / scale[:, None] / scale, truth / scale[:, None] / scale, 0.3)


def test_what_is_missing_or_refused_changes_nothing():
    noise = filters.Diagonal(tensor(1.0, 1.0))
    see = filters.several(filters.LinearMeasurement(EYE, noise), 3)
    value = tensor(torch.nan, 0.3, torch.nan, 90.0, torch.nan, 0.1)
    update = filters.KalmanFilter().update(PRIOR, see, value, gate=0.999)
    assert update.weight is not None
    assert update.weight.tolist() == [1.0, 0.0, 1.0]
    found = filters.adapted_noise(noise, update, value, 0.5).variance()
    assert float(found[0]) == 1.0
    value[3] = torch.nan
    without = filters.adapted_noise(noise, filters.KalmanFilter().update(PRIOR, see, value), value, 0.5)
    assert_close(found, without.variance(), 1e-14)
    with pytest.raises(ValueError, match=r"rate is 20\.0; it must be between 0 and 1"):
        filters.adapted_noise(noise, update, value, 20.0)
