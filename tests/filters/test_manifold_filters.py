"""Filters whose states or measurements are not vectors: rotations, rigid motions, angles, and their products."""

import math

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import covariances, random_numbers, tensor

SPACES: dict[str, filters.Manifold] = {
    "SO2": filters.SO2(),
    "SE2 right": filters.SE2("right"),
    "SE2 left": filters.SE2("left"),
    "SO3 right": filters.SO3("right"),
    "SO3 left": filters.SO3("left"),
    "SE3 right": filters.SE3("right"),
    "SE3 left": filters.SE3("left"),
    "product": filters.Product(filters.SE2("left"), filters.Euclidean(2), filters.SO2()),
}


def points_of(space: filters.Manifold, *batch: int, seed: int = 0) -> Tensor:
    origin = torch.zeros(space.point_size, dtype=torch.float64)
    if isinstance(space, filters.SO3 | filters.SE3):
        origin[-1] = 1.0
    return space.retract(origin.expand(*batch, -1), 0.7 * random_numbers(*batch, space.tangent_size, seed=seed))


def smooth_measurement(space: filters.Manifold, variance: float) -> filters.MeasurementModel:
    """Smooth functions of the point, which of a quaternion are the same for either sign."""
    matrix = random_numbers(4, space.point_size, seed=3)

    def see(x: Tensor) -> Tensor:
        if isinstance(space, filters.SO3 | filters.SE3):
            x = torch.cat([x[..., :-4], x[..., -1:] * x[..., -4:]], dim=-1)
        return torch.sin(x @ matrix.mT)

    return filters.MeasurementModel(see, filters.Diagonal(torch.full((4,), variance, dtype=torch.float64)))


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("form", ["dense", "qr"])
def test_unscented_filter_equals_extended_filter_when_noise_is_small(name, form):
    """The difference of the two is of second order in sigma: relative to sigma it falls with sigma."""
    space, differences = SPACES[name], []
    mean, step = points_of(space, 3), 0.3 * random_numbers(space.tangent_size, seed=8)
    for sigma in (1e-3, 1e-4):
        P = covariances(3, space.tangent_size, seed=1, scale=sigma**2)
        motion = filters.MotionModel(lambda x: space.retract(x, step), covariances(space.tangent_size, scale=sigma**2))
        measurement = smooth_measurement(space, sigma**2)
        found = []
        for bayes in (filters.UnscentedKalmanFilter(space, form=form), filters.ExtendedKalmanFilter(space, form=form)):
            predicted = bayes.predict(filters.Gaussian(mean, P), motion).belief
            z = measurement.function(space.retract(mean, step)) + sigma * random_numbers(3, 4, seed=5)
            found.append(bayes.update(predicted, measurement, z).belief)
        apart = space.local(found[0].mean, found[1].mean).abs().max() / sigma
        covariance = (found[0].covariance - found[1].covariance).abs().max() / sigma**2
        differences.append(float(apart + covariance))
    assert differences[0] < 0.1
    assert differences[1] < 0.2 * differences[0] + 1e-6


@pytest.mark.parametrize("name", SPACES)
def test_iterated_extended_filter_stops_at_the_maximum_of_the_posterior(name):
    space, prior_P = SPACES[name], covariances(SPACES[name].tangent_size, scale=0.02)
    prior, measurement = filters.Gaussian(points_of(space), prior_P), smooth_measurement(SPACES[name], 0.05)
    z = measurement.function(points_of(space)) + 0.1 * random_numbers(4, seed=5)
    found = filters.ExtendedKalmanFilter(space, iterations=40).update(prior, measurement, z).belief.mean
    tangent = space.local(prior.mean, found).requires_grad_()
    residual = z - measurement.function(space.retract(prior.mean, tangent))
    cost = tangent @ torch.linalg.solve(prior_P, tangent) + (residual**2).sum() / 0.05
    (gradient,) = torch.autograd.grad(cost, tangent)
    assert_close(gradient, torch.zeros_like(gradient), 1e-6)


@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("count", [3, 140])
def test_batch_equals_single_filters(name, count):
    space = SPACES[name]
    bayes = filters.UnscentedKalmanFilter(space, iterations=2)
    P = covariances(count, space.tangent_size, scale=0.1)
    belief, motion = filters.Gaussian(points_of(space, count), P), filters.MotionModel(lambda x: x, 0.1 * P[0])
    measurement, z = smooth_measurement(space, 0.1), 0.3 * random_numbers(count, 4, seed=6)
    predicted, update = bayes.predict(belief, motion).belief, bayes.update(belief, measurement, z).belief
    for k in (0, count - 1):
        assert_same_belief(predicted[k], bayes.predict(belief[k], motion).belief, 1e-11)
        assert_same_belief(update[k], bayes.update(belief[k], measurement, z[k]).belief, 1e-11)


@pytest.mark.parametrize("name", SPACES)
def test_prediction_by_a_motion_of_the_group_keeps_the_mean(name):
    """Symmetric points about a point: standing still with no noise changes neither mean nor covariance."""
    space = SPACES[name]
    belief = filters.Gaussian(points_of(space, 2), covariances(2, space.tangent_size, scale=0.1))
    motion = filters.MotionModel(lambda x: x, filters.Diagonal(torch.zeros(space.tangent_size, dtype=torch.float64)))
    for bayes in (
        filters.UnscentedKalmanFilter(space),
        filters.UnscentedKalmanFilter(space, filters.julier(1.0)),
        filters.ExtendedKalmanFilter(space),
    ):
        predicted = bayes.predict(belief, motion).belief
        assert_close(space.local(belief.mean, predicted.mean), torch.zeros(2, space.tangent_size).double(), 1e-12)
        assert_close(predicted.covariance, belief.covariance, 1e-11)


def test_flat_product_equals_no_space():
    prior = filters.Gaussian(random_numbers(4), covariances(4))
    measurement = filters.MeasurementModel(torch.sin, filters.Diagonal(torch.ones(4, dtype=torch.float64)))
    z = random_numbers(4, seed=2)
    space = filters.Product(filters.Euclidean(3), filters.Euclidean(1))
    found, expected = (filters.UnscentedKalmanFilter(s).update(prior, measurement, z).belief for s in (space, None))
    assert_same_belief(found, expected, 1e-15)


@pytest.mark.parametrize("make", [filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter])
def test_bearing_across_pi_is_a_small_innovation(make):
    """The bearing of a landmark behind is pi from one side and -pi from the other; turned by 3 rad, nothing changes."""

    def update(turn: float):
        def bearing(x: Tensor) -> Tensor:
            return filters.wrap_angle(torch.atan2(x[..., 1:], x[..., :1]) + turn)

        prior = filters.Gaussian(tensor(5.0, 0.3), torch.diag(tensor(0.5, 0.5)))
        model = filters.MeasurementModel(
            bearing, filters.Diagonal(tensor(0.01)), residual=lambda a, b: filters.wrap_angle(a - b)
        )
        return make().update(prior, model, filters.wrap_angle(tensor(-0.1 + turn)))

    expected = update(0.0)
    for turn in (math.pi, -math.pi, 3.1, -3.1):
        found = update(turn)
        assert_close(found.innovation, expected.innovation, 1e-12)
        assert_same_belief(found.belief, expected.belief, 1e-12)


@pytest.mark.parametrize("make", [filters.UnscentedKalmanFilter, filters.ExtendedKalmanFilter])
def test_heading_across_pi_equals_heading_across_zero(make):
    space = filters.Product(filters.Euclidean(1), filters.SO2())
    P, z = covariances(2, scale=0.3), tensor(0.4)
    motion = filters.MotionModel(lambda x: space.retract(x, tensor(0.5, 0.4)), 0.05 * P)

    def follow(turn: float) -> filters.Gaussian:
        bayes = make(space)
        belief = filters.Gaussian(torch.cat([tensor(1.0), filters.wrap_angle(tensor(-0.2 + turn))]), P)
        model = filters.MeasurementModel(
            lambda x: filters.wrap_angle(x[..., 1:] + 0.1 * x[..., :1]),
            filters.Diagonal(tensor(0.1)),
            residual=lambda a, b: filters.wrap_angle(a - b),
        )
        for _ in range(3):
            belief = bayes.predict(belief, motion).belief
            belief = bayes.update(belief, model, filters.wrap_angle(z + turn)).belief
        return belief

    expected = follow(0.0)
    for turn in (math.pi, -math.pi, 3.0):
        found = follow(turn)
        assert_close(found.covariance, expected.covariance, 1e-12)
        shifted = torch.cat([expected.mean[:1], filters.wrap_angle(expected.mean[1:] + turn)])
        assert_close(space.local(found.mean, shifted), torch.zeros(2, dtype=torch.float64), 1e-12)


def test_mean_of_a_wide_angle_does_not_flip():
    """R11: beyond 81 degrees of sigma, the mean by weighted sines is on the other side."""
    belief = filters.Gaussian(tensor(0.3), tensor(math.radians(85) ** 2)[None])
    points = filters.merwe(math.sqrt(3.0), 2.0 + 2.0)
    still = filters.MotionModel(lambda x: filters.wrap_angle(x), filters.Diagonal(tensor(0.0)))
    for bayes in (filters.UnscentedKalmanFilter(filters.SO2()), filters.UnscentedKalmanFilter(filters.SO2(), points)):
        predicted = bayes.predict(belief, still).belief
        assert_close(predicted.mean, belief.mean, 1e-12)
        assert_close(predicted.covariance, belief.covariance, 1e-12)


def test_negative_weights_on_a_manifold_keep_the_covariance_of_the_posterior():
    """A chart that is changed without a change of the mean leaves the covariance as it was."""
    space, prior = filters.SE2(), filters.Gaussian(tensor(1.0, 2.0, 0.3), covariances(3, scale=0.3))
    measurement = filters.MeasurementModel(lambda x: x[..., :2], filters.Diagonal(tensor(1e12, 1e12)))
    bayes = filters.UnscentedKalmanFilter(space, filters.merwe(0.5, 0.0, allow_negative=True), form="dense")
    assert_same_belief(bayes.update(prior, measurement, prior.mean[:2]).belief, prior, 1e-9)


@pytest.mark.long
def test_second_iteration_makes_many_precise_points_consistent():
    """R10: 200 stereo points from a prior of 0.04 m and 0.06 rad, 12 states, so the mean NEES should be 12."""
    runs, generator = 120, torch.Generator().manual_seed(1)
    space = filters.Product(filters.SE3("left"), filters.Euclidean(6))
    sigma = tensor(*[0.04] * 3, *[0.06] * 3, *[0.1] * 6)
    points = torch.rand(200, 3, generator=generator, dtype=torch.float64) * tensor(8, 6, 12) - tensor(4, 3, -4)

    def see(x: Tensor) -> Tensor:
        T = filters.SE3("left").to_matrix(x[..., :7])
        X, Y, Z = ((points - T[..., None, :3, 3]) @ T[..., :3, :3]).unbind(-1)
        Z = Z.clamp_min(0.3)
        return torch.stack([500 * X / Z, 500 * Y / Z, 50 / Z], dim=-1).flatten(-2)

    identity = torch.zeros(runs, 13, dtype=torch.float64)
    identity[:, 6] = 1.0
    prior = filters.Gaussian(identity, torch.diag(sigma.square()).expand(runs, 12, 12))
    truth = space.retract(identity, sigma * random_numbers(runs, 12, seed=4))
    noise = 0.5
    z = see(truth) + noise * random_numbers(runs, 600, seed=6)
    measurement = filters.MeasurementModel(see, filters.Diagonal(torch.full((600,), noise**2, dtype=torch.float64)))
    nees = []
    for iterations in (1, 2, 3):
        update = filters.UnscentedKalmanFilter(space, iterations=iterations).update(prior, measurement, z)
        assert update.form == "low-rank"
        error = space.local(update.belief.mean, truth)
        nees.append(float((error * torch.linalg.solve(update.belief.covariance, error)).sum(dim=-1).mean()))
    assert nees[0] > 30
    # The mean of 120 chi-squared of 12 has a standard deviation of 0.45.
    assert abs(nees[1] - 12) < 1.4
    assert abs(nees[2] - 12) < 1.4
