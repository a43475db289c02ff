"""Sigma sets: their moments, their weights, and published transforms."""

import math

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.sigma_points import SigmaPoints
from sigmaslam_filters.core.transforms import Unscented
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import beliefs, covariances, random_numbers, tensor

SETS = {
    "cubature": filters.cubature(),
    "julier": filters.julier(1.0),
    "julier negative": filters.julier(-1.0, allow_negative=True),
    "merwe": filters.merwe(),
    "merwe narrow": filters.merwe(1e-3, 2.0, allow_negative=True),
    "simplex": filters.Simplex(),
}


@pytest.mark.parametrize("name", list(SETS))
@pytest.mark.parametrize("with_centre", [False, True])
def test_points_have_mean_and_covariance_of_the_root(name, with_centre):
    points = SETS[name]
    size = 4
    with_centre = with_centre or points.has_centre(size)
    root = torch.linalg.cholesky(covariances(3, size))
    x = 0.1 * random_numbers(3, size) + points.offsets(root, with_centre)
    mean = points.mean(x, size, with_centre)
    columns = points.deviations(x, mean, size, with_centre)
    covariance = sum(part @ part.mT for part in columns.all())
    if columns.negative is not None:
        covariance = covariance - columns.negative @ columns.negative.mT
    assert_close(mean, 0.1 * random_numbers(3, size), 1e-9)
    assert_close(covariance, root @ root.mT, 1e-9)
    assert_close(columns.odd, root, 1e-9)


@pytest.mark.parametrize("name", SETS)
def test_number_of_points(name):
    """R2: 2n for cubature, 2n + 1 with a centre, n + 1 for the simplex; 2 (n + q) when the noise is among them."""
    points, size, calls = SETS[name], 4, []

    def count(x: Tensor, w: Tensor) -> Tensor:
        calls.append(len(x))
        return x + w

    motion = filters.MotionModel(count, torch.eye(size, dtype=torch.float64), additive=False)
    filters.UnscentedKalmanFilter(points=points, form="dense").predict(beliefs(size), motion)
    assert calls == [{"cubature": 16, "simplex": 9}.get(name, 17)]


def transform(bayes: filters.BayesFilter, belief: filters.Gaussian, function) -> filters.Gaussian:
    size = function(belief.mean[None]).shape[-1]
    return bayes.predict(
        belief, filters.MotionModel(function, filters.Diagonal(torch.zeros(size, dtype=torch.float64)))
    ).belief


POLAR = filters.Gaussian(tensor(1.0, math.pi / 2), torch.diag(tensor(0.02**2, math.radians(15) ** 2)))


def to_cartesian(x: Tensor) -> Tensor:
    return torch.stack([x[..., 0] * torch.cos(x[..., 1]), x[..., 0] * torch.sin(x[..., 1])], dim=-1)


@pytest.mark.parametrize(
    ("bayes", "mean", "variance"),
    [
        (filters.UnscentedKalmanFilter(points=filters.julier(1.0)), 0.9663137284, (0.0639682486, 0.0026695298)),
        (filters.UnscentedKalmanFilter(points=filters.cubature()), 0.9661202212, (0.0654638787, 0.0015478394)),
        (filters.ExtendedKalmanFilter(), 1.0, (0.0685389195, 0.0004)),
    ],
    ids=["julier", "cubature", "linearised"],
)
def test_polar_to_cartesian_has_the_published_moments(bayes, mean, variance):
    found = transform(bayes, POLAR, to_cartesian)
    assert_close(found.mean, tensor(0.0, mean), 1e-9)
    assert_close(found.covariance, torch.diag(tensor(*variance)), 1e-9)


def test_polar_to_cartesian_is_near_the_exact_moments():
    """Third-order accurate with kappa = 3 - n, second-order with cubature, first-order when linearised."""
    exact_mean, exact = 0.9663110876, tensor(0.0640744417, 0.0025684402)
    bounds = {
        filters.UnscentedKalmanFilter(points=filters.julier(1.0)): (3e-6, 1.1e-4),
        filters.UnscentedKalmanFilter(): (2e-4, 1.4e-3),
        filters.ExtendedKalmanFilter(): (0.034, 4.5e-3),
    }
    for bayes, (of_mean, of_variance) in bounds.items():
        found = transform(bayes, POLAR, to_cartesian)
        error = float((found.covariance.diagonal() - exact).abs().max())
        assert 0.8 * of_mean < abs(float(found.mean[1]) - exact_mean) < of_mean
        assert 0.8 * of_variance < error < of_variance


@pytest.mark.parametrize("size", [1, 2, 3, 5, 12])
@pytest.mark.parametrize(("kappa", "beta"), [(0.0, 0.0), (1.0, 0.0), (0.5, 2.0), (0.0, 2.0)])
def test_variance_of_the_squared_norm_is_n_kappa_plus_beta_n_squared(size, kappa, beta):
    points = filters.merwe(1.0, beta, kappa)
    belief = filters.Gaussian(torch.zeros(size, dtype=torch.float64), torch.eye(size, dtype=torch.float64))
    found = transform(
        filters.UnscentedKalmanFilter(points=points), belief, lambda x: x.square().sum(dim=-1, keepdim=True)
    )
    assert_close(found.mean, tensor(size), 1e-12)
    assert_close(found.covariance, tensor(size * kappa + beta * size**2)[None], 1e-12)


@pytest.mark.parametrize("points", [filters.julier(-1.0), filters.merwe(1e-3, 2.0), filters.merwe(0.5, 0.0)])
def test_negative_centre_weight_is_refused_with_a_way_out(points):
    measurement = filters.MeasurementModel(torch.sin, filters.Diagonal(torch.ones(4, dtype=torch.float64)))
    with pytest.raises(ValueError, match=r"weight is -.* n = 4 .*cubature\(\).*allow_negative=True"):
        filters.UnscentedKalmanFilter(points=points).update(beliefs(4), measurement, random_numbers(4))


def test_negative_centre_weight_is_taken_when_asked_for():
    """kappa = 3 - n, W0 = -1/3 at n = 4: the kappa-variance of |x|^2 is then negative."""
    belief = filters.Gaussian(torch.zeros(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64))
    points = filters.julier(-1.0, allow_negative=True)

    def squared(x):
        return x.square().sum(dim=-1, keepdim=True)

    found = Unscented(points)(squared, belief.factor, None).columns.covariance()
    assert_close(found, tensor(-4.0)[None], 1e-12)
    motion = filters.MotionModel(squared, filters.Diagonal(tensor(0.0)))
    with pytest.raises(filters.FilterError, match="predicted covariance of the first has the smallest eigenvalue -4"):
        filters.UnscentedKalmanFilter(points=points).predict(belief, motion)


def test_points_that_would_be_imaginary_are_refused():
    with pytest.raises(ValueError, match=r"n = 4.*must be positive"):
        filters.UnscentedKalmanFilter(points=filters.julier(-4.0, allow_negative=True)).predict(
            beliefs(4), filters.MotionModel(torch.sin, torch.eye(4, dtype=torch.float64))
        )


def test_mean_of_a_narrow_set_is_accurate_in_float32():
    """R3: weights of a million times either sign, and yet the mean of values near 300 keeps its digits."""
    points: SigmaPoints = filters.merwe(1e-3, 2.0, allow_negative=True)
    size = 6
    root = torch.linalg.cholesky(covariances(size, scale=0.01)).float()
    centre = torch.full((size,), 300.0)
    values = centre + points.offsets(root, True)
    mean = points.mean(values, size, True)
    naive = values.sum(dim=0) - values[-1]
    naive = naive * points.weights(size)[0] + values[-1] * points.weights(size)[1]
    assert_close(mean, centre, 1e-7)
    assert float((naive - centre).abs().max()) > 1.0


def test_sigma_points_are_drawn_anew_after_the_process_noise():
    """R4: the update after a prediction sees Q, also where the measurement is nonlinear."""
    prior, bayes = beliefs(3), filters.UnscentedKalmanFilter()
    predicted = bayes.predict(prior, filters.MotionModel(lambda x: x, 0.5 * torch.eye(3, dtype=torch.float64))).belief
    fresh = filters.Gaussian(prior.mean, prior.covariance + 0.5 * torch.eye(3, dtype=torch.float64))
    measurement = filters.MeasurementModel(lambda x: torch.sin(x[..., :2]), filters.Diagonal(tensor(0.1, 0.2)))
    found, expected = (bayes.update(b, measurement, tensor(0.3, -0.1)).belief for b in (predicted, fresh))
    assert_close(found.mean, expected.mean, 1e-13)
    assert_close(found.covariance, expected.covariance, 1e-13)


@pytest.mark.parametrize("size", [1, 3, 12])
def test_simplex_points_are_equally_far_apart(size):
    x = filters.Simplex().offsets(torch.eye(size, dtype=torch.float64), False)
    apart = torch.cdist(x, x)[~torch.eye(size + 1, dtype=torch.bool)]
    assert_close(apart, torch.full_like(apart, math.sqrt(2 * (size + 1))), 1e-12)
