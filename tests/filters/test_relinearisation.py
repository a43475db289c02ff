"""iterations="auto" takes a second linearisation where one is worth while, or where nothing shows that it is not."""

import pytest
import torch

import sigmaslam_filters as filters
from sigmaslam_filters.consistency import nees
from tests.support.filter_assertions import assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, random_numbers, tensor


def test_the_simplex_always_takes_a_second_linearisation():
    prior, z = beliefs(3, 4), random_numbers(3, 5)
    simplex = filters.Simplex()
    auto, two, one = (
        filters.UnscentedKalmanFilter(points=simplex, iterations=k).update(prior, bent_measurement(4, 5), z).belief
        for k in ("auto", 2, 1)
    )
    assert_same_belief(auto, two, 1e-15)
    assert float((auto.mean - one.mean).abs().max()) > 1e-3


def test_the_simplex_is_consistent_with_precise_measurements_from_a_vague_prior():
    """Of ranges to 40 beacons; with one linearisation the mean NEES is far above its number of states."""
    generator = torch.Generator().manual_seed(3)
    runs, beacons = 400, 20.0 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    prior = filters.Gaussian(torch.zeros(runs, 3).double(), 9.0 * torch.eye(3, dtype=torch.float64))
    truth = 3.0 * torch.randn(runs, 3, generator=generator, dtype=torch.float64)

    def ranges(state):
        return (state.unsqueeze(-2) - beacons).norm(dim=-1)

    noise = 0.05 * torch.randn(runs, 40, generator=generator, dtype=torch.float64)
    see = filters.MeasurementModel(ranges, filters.Diagonal(torch.full((40,), 0.05**2).double()))
    found = {
        k: nees(truth - (b := filters.UnscentedKalmanFilter(points=filters.Simplex(), iterations=k).update(
            prior, see, ranges(truth) + noise).belief).mean, b.covariance).mean()
        for k in (1, "auto")
    }  # fmt: skip
    assert found[1] > 30
    assert 2.6 < found["auto"] < 3.6


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("bend", [1e-4, 1.0])
def test_noise_inside_the_function_is_weighed_like_noise_beside_it(bend, missing):
    """A function bent less than the noise is linearised once, another twice."""
    prior, z = beliefs(3, 2), random_numbers(3, 2)
    if missing:
        z[1, 0] = torch.nan

    def seen(x):
        return x + bend * x * x

    inside = filters.MeasurementModel(lambda x, v: seen(x) + 0.1 * v, torch.eye(2).double(), additive=False)
    beside = filters.MeasurementModel(seen, filters.Diagonal(tensor(0.01, 0.01)))
    expected = filters.UnscentedKalmanFilter(iterations=2 if bend == 1.0 else 1)
    for form in ("dense", "qr"):
        auto = filters.UnscentedKalmanFilter(form=form)
        for model in (inside, beside):
            assert_same_belief(auto.update(prior, model, z).belief, expected.update(prior, model, z).belief, 1e-10)
    other = filters.UnscentedKalmanFilter(iterations=1 if bend == 1.0 else 2).update(prior, inside, z).belief
    assert float((other.mean - expected.update(prior, inside, z).belief.mean).abs().max()) > 1e-9
