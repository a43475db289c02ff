import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.point_estimates import Observation, PointEstimate, maximum_a_posteriori, maximum_likelihood
from tests.support.filter_builders import covariances, random_numbers, tensor

BEACONS = torch.tensor([[0.0, 0.0], [4.0, -1.0], [1.0, 5.0]], dtype=torch.float64)


def linear_problem(*batch: int, size: int = 3, measured: int = 6) -> tuple[filters.LinearMeasurement, Tensor]:
    matrix, noise = random_numbers(*batch, measured, size, seed=1), covariances(*batch, measured, seed=2)
    return filters.LinearMeasurement(matrix, noise), random_numbers(*batch, measured, seed=3)


def ranges(state: Tensor) -> Tensor:
    """Distances of points (..., 2) to the beacons."""
    offset = BEACONS.to(state.dtype) - state[..., None, :2]
    return torch.sqrt((offset * offset).sum(dim=-1))


def bearings(state: Tensor) -> Tensor:
    """Directions to the beacons from points (..., 2), or as seen from poses (..., 3) of SE2."""
    offset = BEACONS.to(state.dtype) - state[..., None, :2]
    seen = torch.atan2(offset[..., 1], offset[..., 0])
    return filters.wrap_angle(seen - state[..., 2:]) if state.shape[-1] == 3 else seen


def ranging(deviation: float = 0.1) -> filters.MeasurementModel:
    return filters.MeasurementModel(ranges, filters.Diagonal(torch.full((3,), deviation**2, dtype=torch.float64)))


def sighting(deviation: float = 0.05) -> filters.MeasurementModel:
    noise = filters.Diagonal(torch.full((3,), deviation**2, dtype=torch.float64))
    return filters.MeasurementModel(
        bearings, noise, residual=lambda measured, seen: filters.wrap_angle(measured - seen)
    )


def project(pose: Tensor, points: Tensor) -> Tensor:
    """Left and right column and row (..., 3 k) of points (..., k, 3) in a stereo camera at the pose (..., 7)."""
    T = filters.SE3().to_matrix(pose)
    x, y, z = ((points - T[..., None, :3, 3]) @ T[..., :3, :3]).unbind(-1)
    return torch.stack([400 * x / z, 400 * (x - 0.2) / z, 400 * y / z], dim=-1).flatten(-2)


def element(estimate: PointEstimate, *index: int) -> PointEstimate:
    rest = (estimate.cost, estimate.degrees_of_freedom, estimate.iterations, estimate.converged, estimate.healthy)
    return PointEstimate(estimate.belief[index], *(field[index] for field in rest))


def assert_equal(first: Tensor, second: Tensor, tolerance: float = 1e-10) -> None:
    torch.testing.assert_close(first, second, rtol=tolerance, atol=tolerance)


def assert_same(first: PointEstimate, second: PointEstimate, tolerance: float = 1e-10) -> None:
    assert_equal(first.belief.mean, second.belief.mean, tolerance)
    assert_equal(first.belief.covariance, second.belief.covariance, tolerance)
    assert_equal(first.cost, second.cost, tolerance)


# Maximum likelihood, (9.1)-(9.7)


def test_linear_maximum_likelihood_equals_the_closed_form() -> None:
    model, value = linear_problem(5)
    assert isinstance(model.noise, Tensor)
    estimate = maximum_likelihood([Observation(model, value)], torch.zeros(5, 3, dtype=torch.float64))
    weighted = torch.linalg.solve(model.noise, model.matrix)
    covariance = torch.linalg.inv(weighted.mT @ model.matrix)
    mean = (covariance @ weighted.mT @ value[..., None])[..., 0]
    left = value - model.function(mean)
    assert_equal(estimate.belief.mean, mean)
    assert_equal(estimate.belief.covariance, covariance)
    assert_equal(estimate.cost, 0.5 * (left * torch.linalg.solve(model.noise, left)).sum(dim=-1))


@pytest.mark.parametrize("batch", [1, 200])  # LAPACK, and unrolled
def test_linear_maximum_likelihood_keeps_the_digits_that_normal_equations_lose(batch: int) -> None:
    # Läuchli's columns, almost parallel, with rows of noise and columns of units that are many decades apart.
    near, units = 1e-5, tensor(1e6, 1.0, 1e-6)
    deviation = tensor(1e-6, 1.0, 1e3, 1e-2)
    plain = torch.cat([torch.ones(1, 3, dtype=torch.float64), near * torch.eye(3, dtype=torch.float64)])
    matrix = deviation[:, None] * plain * units
    truth = tensor(1.0, 2.0, 3.0) / units
    value = deviation * (plain @ tensor(1.0, 2.0, 3.0))
    estimate = maximum_likelihood(
        [Observation(filters.LinearMeasurement(matrix, filters.Diagonal(deviation**2)), value.expand(batch, 4))],
        torch.zeros(batch, 3, dtype=torch.float64),
    )
    torch.testing.assert_close(estimate.belief.mean, truth.expand(batch, 3), rtol=1e-10, atol=0.0)
    white = matrix / deviation[:, None]
    normal = torch.linalg.solve(white.T @ white, white.T @ (value / deviation))
    assert float((normal / truth - 1).abs().max()) > 1e-8


def test_linear_problem_takes_one_step_from_anywhere() -> None:
    model, value = linear_problem(4)
    near, far = (
        maximum_likelihood([Observation(model, value)], torch.full((4, 3), start, dtype=torch.float64))
        for start in (0.0, 1e3)
    )
    assert near.iterations.tolist() == far.iterations.tolist() == [1] * 4
    assert bool(far.converged.all())
    assert_same(near, far)


def test_location_from_ranges_equals_scipy() -> None:
    value = ranges(tensor(2.0, 1.0)) + 0.1 * random_numbers(3)
    estimate = maximum_likelihood([Observation(ranging(), value)], tensor(1.0, 1.0))
    found = least_squares(
        lambda x: ((value - ranges(torch.from_numpy(x))) / 0.1).numpy(), [1.0, 1.0], xtol=1e-15, ftol=1e-15, gtol=1e-14
    )
    assert bool(estimate.converged)
    np.testing.assert_allclose(estimate.belief.mean, found.x, atol=1e-8)
    np.testing.assert_allclose(estimate.cost, found.cost, rtol=1e-10)
    np.testing.assert_allclose(estimate.belief.covariance, np.linalg.inv(found.jac.T @ found.jac), rtol=1e-6)


def test_several_sensors_with_models_of_their_own_are_one_sensor_with_all_components() -> None:
    point = tensor(2.0, 1.0)
    far, near = ranges(point) + 0.1 * random_numbers(3), bearings(point) + 0.05 * random_numbers(3, seed=1)
    fix = filters.LinearMeasurement(torch.eye(2, dtype=torch.float64), covariances(2))
    apart = [Observation(ranging(), far), Observation(sighting(), near), Observation(fix, point)]
    assert isinstance(fix.noise, Tensor)
    joined = filters.MeasurementModel(
        lambda state: torch.cat([ranges(state), bearings(state), state], dim=-1),
        torch.block_diag(torch.diag(tensor(*3 * [0.1**2], *3 * [0.05**2])), fix.noise),
    )
    together = Observation(joined, torch.cat([far, near, point]))
    initial = tensor(1.5, 1.5)
    assert_same(maximum_likelihood(apart, initial), maximum_likelihood([together], initial))


# Maximum a posteriori, (9.8)-(9.20)


def test_one_step_equals_the_kalman_update_and_both_forms_of_its_covariance() -> None:
    model, value = linear_problem(4)
    H, R = model.matrix, model.noise
    assert isinstance(R, Tensor)
    prior = filters.Gaussian(random_numbers(4, 3, seed=4), covariances(4, 3, seed=5))
    estimate = maximum_a_posteriori(prior, [Observation(model, value)])
    update = filters.KalmanFilter().update(prior, model, value)
    assert_equal(estimate.belief.mean, update.belief.mean)
    assert_equal(2 * estimate.cost, update.nis)
    P = prior.covariance
    by_information = torch.linalg.inv(torch.linalg.inv(P) + H.mT @ torch.linalg.solve(R, H))  # (9.19)
    K = torch.linalg.solve(H @ P @ H.mT + R, H @ P).mT
    assert_equal(by_information, P - K @ H @ P)  # (9.20)
    assert_equal(estimate.belief.covariance, by_information)
    corrected = prior.mean + (K @ (value - model.function(prior.mean))[..., None])[..., 0]
    assert_equal(estimate.belief.mean, corrected)


@pytest.mark.parametrize(("space", "size"), [(None, 2), (filters.SE2(), 3)])
def test_steps_equal_the_iterated_extended_kalman_filter(space: filters.Manifold | None, size: int) -> None:
    point = tensor(2.0, 1.0, 0.4)[:size]
    prior = filters.Gaussian(point + 0.2 * random_numbers(6, size), 0.05 * covariances(6, size, seed=1))
    value = bearings(point) + 0.05 * random_numbers(6, 3, seed=2)
    for steps in (1, 10):
        estimate = maximum_a_posteriori(prior, [Observation(sighting(), value)], space, iterations=steps)
        update = filters.ExtendedKalmanFilter(space, iterations=steps, form="qr").update(prior, sighting(), value)
        assert_equal(estimate.belief.mean, update.belief.mean)
        assert_equal(estimate.belief.covariance, update.belief.covariance)


def test_maximum_a_posteriori_equals_scipy() -> None:
    prior = filters.Gaussian(tensor(2.3, 0.6), covariances(2))
    value = ranges(tensor(2.0, 1.0)) + 0.3 * random_numbers(3)
    estimate = maximum_a_posteriori(prior, [Observation(ranging(0.3), value)])

    def residuals(x: np.ndarray) -> np.ndarray:
        state = torch.from_numpy(x)
        root = torch.linalg.cholesky(prior.covariance)
        white = torch.linalg.solve_triangular(root, (state - prior.mean)[:, None], upper=False)[:, 0]
        return torch.cat([(value - ranges(state)) / 0.3, white]).numpy()

    found = least_squares(residuals, prior.mean.numpy(), xtol=1e-15, ftol=1e-15, gtol=1e-14)
    np.testing.assert_allclose(estimate.belief.mean, found.x, atol=1e-8)
    np.testing.assert_allclose(estimate.cost, found.cost, rtol=1e-10)
    assert int(estimate.degrees_of_freedom) == 3


def test_prior_by_root_equals_prior_by_covariance() -> None:
    root = random_numbers(2, 5)
    value = ranges(tensor(2.0, 1.0))
    by_root, by_covariance = (
        maximum_a_posteriori(prior, [Observation(ranging(), value)])
        for prior in (
            filters.Gaussian(tensor(2.2, 1.3), factor=root),
            filters.Gaussian(tensor(2.2, 1.3), root @ root.T),
        )
    )
    assert_same(by_root, by_covariance)


@pytest.mark.parametrize("batch", [1, 200])
def test_exactly_known_directions_of_the_prior_stay_known(batch: int) -> None:
    prior = filters.Gaussian(tensor(2.0, 1.5).expand(batch, 2), torch.diag(tensor(0.0, 1.0)))
    value = ranges(tensor(2.0, 1.0)) + 0.1 * random_numbers(3)
    estimate = maximum_a_posteriori(prior, [Observation(ranging(), value)])
    height = filters.MeasurementModel(
        lambda y: ranges(torch.cat([torch.full_like(y, 2.0), y], dim=-1)), filters.Diagonal(tensor(0.01, 0.01, 0.01))
    )
    alone = maximum_a_posteriori(filters.Gaussian(tensor(1.5), torch.eye(1).double()), [Observation(height, value)])
    assert bool((estimate.belief.mean[:, 0] == 2.0).all())
    assert_equal(estimate.belief.mean[:, 1:], alone.belief.mean.expand(batch, 1))
    expected = torch.nn.functional.pad(alone.belief.covariance, (1, 0, 1, 0))
    assert_equal(estimate.belief.covariance, expected.expand(batch, 2, 2))


def test_vague_prior_leads_to_maximum_likelihood() -> None:
    value = ranges(tensor(2.0, 1.0)) + 0.1 * random_numbers(3)
    prior = filters.Gaussian(tensor(1.5, 1.5), 1e12 * torch.eye(2, dtype=torch.float64))
    vague = maximum_a_posteriori(prior, [Observation(ranging(), value)])
    assert_same(vague, maximum_likelihood([Observation(ranging(), value)], prior.mean), 1e-8)


def test_without_observations_the_prior_stays() -> None:
    prior = filters.Gaussian(random_numbers(4, 3), covariances(4, 3))
    estimate = maximum_a_posteriori(prior, [])
    assert_equal(estimate.belief.mean, prior.mean)
    assert_equal(estimate.belief.covariance, prior.covariance)


# What the estimate says of itself


def test_errors_and_costs_are_distributed_as_the_estimate_says() -> None:
    runs, truth = 2000, tensor(2.0, 1.0, 0.4)
    values = [
        bearings(truth) + 0.02 * random_numbers(runs, 3),
        ranges(truth) + 0.05 * random_numbers(runs, 3, seed=1),
    ]
    observations = [Observation(sighting(0.02), values[0]), Observation(ranging(0.05), values[1])]
    estimate = maximum_likelihood(observations, truth, filters.SE2())
    error = filters.SE2().local(estimate.belief.mean, truth.expand(runs, 3))
    nees = (error * torch.linalg.solve(estimate.belief.covariance, error)).sum(dim=-1)
    assert estimate.degrees_of_freedom.unique().tolist() == [3]
    for squares in (nees, 2 * estimate.cost):
        assert kstest(squares.numpy(), "chi2", args=(3,)).pvalue > 0.01


def test_covariance_on_a_curved_space_is_the_inverse_information_in_the_chart_at_the_mean() -> None:
    points = random_numbers(8, 3, seed=1) + tensor(0.0, 0.0, 6.0)
    model = filters.MeasurementModel(project, filters.Diagonal(torch.full((24,), 0.25, dtype=torch.float64)))
    prior = filters.Gaussian(
        filters.SE3().from_matrix(torch.eye(4, dtype=torch.float64)), 0.02 * covariances(6, seed=3)
    )
    truth = filters.SE3().retract(prior.mean, 0.2 * random_numbers(6, seed=2))
    value = project(truth, points) + 0.5 * random_numbers(24)
    mean = maximum_a_posteriori(prior, [Observation(model, value, (points,))], filters.SE3()).belief.mean
    root = torch.linalg.inv(prior.factor)

    def residuals(tangent: Tensor) -> Tensor:
        state = filters.SE3().retract(mean, tangent)
        return torch.cat([(value - project(state, points)) / 0.5, root @ filters.SE3().local(prior.mean, state)])

    zero = torch.zeros(6, dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(residuals, zero)
    torch.testing.assert_close(slope.T @ residuals(zero), zero, rtol=0.0, atol=1e-6)
    covariance = maximum_a_posteriori(prior, [Observation(model, value, (points,))], filters.SE3()).belief.covariance
    torch.testing.assert_close(covariance, torch.linalg.inv(slope.T @ slope), rtol=1e-7, atol=1e-12)


# Weights and what is missing


def blocks() -> filters.MeasurementModel:
    """Ranges and bearings, in pairs that are correlated."""
    return filters.MeasurementModel(
        lambda state: torch.stack([ranges(state), bearings(state)], dim=-1).flatten(-2),
        filters.BlockDiagonal(0.01 * covariances(3, 2, seed=7)),
    )


def blocks_value() -> Tensor:
    return blocks().function(tensor(2.0, 1.0)) + 0.05 * random_numbers(6, seed=8)


@pytest.mark.parametrize("per_component", [False, True])
def test_weight_two_is_the_observation_twice(per_component: bool) -> None:
    once = Observation(blocks(), blocks_value())
    weight = torch.full((6,), 2.0, dtype=torch.float64) if per_component else 2.0
    heavy = Observation(blocks(), blocks_value(), weight=weight)
    initial = tensor(1.5, 1.5)
    assert_same(maximum_likelihood([once, once], initial), maximum_likelihood([heavy], initial))


def test_weight_zero_nan_and_mask_leave_out() -> None:
    model, value = blocks(), blocks_value()
    kept = torch.tensor([True, True, False, True, False, True])
    masked = filters.MeasurementModel(model.function, model.noise, mask=kept)
    assert isinstance(model.noise, filters.BlockDiagonal)
    only = filters.MeasurementModel(
        lambda state: model.function(state)[..., kept], model.noise.covariance()[kept][:, kept]
    )
    expected = maximum_likelihood([Observation(only, value[kept])], tensor(1.5, 1.5))
    for observation in (
        Observation(model, value, weight=kept.double()),
        Observation(model, torch.where(kept, value, torch.nan)),
        Observation(masked, value),
    ):
        estimate = maximum_likelihood([observation], tensor(1.5, 1.5))
        assert_same(estimate, expected)
        assert int(estimate.degrees_of_freedom) == 2
    nothing = Observation(ranging(0.01), torch.full((3,), torch.nan, dtype=torch.float64))
    absent = Observation(ranging(0.01), tensor(9.0, 9.0, 9.0), weight=0.0)
    assert_same(maximum_likelihood([Observation(only, value[kept]), nothing, absent], tensor(1.5, 1.5)), expected)


def test_weights_differ_between_elements_of_a_batch() -> None:
    value, initial = ranges(tensor(2.0, 1.0)) + 0.1 * random_numbers(3), tensor(1.5, 1.5)
    observations = [Observation(ranging(), value), Observation(sighting(), bearings(tensor(2.2, 1.0)))]
    of_element = tensor(0.0, 1.0, 7.0)
    batch = maximum_likelihood(
        [observations[0], Observation(observations[1].model, observations[1].value, weight=of_element)],
        initial.expand(3, 2),
    )
    of_component = tensor(1.0, 0.5, 3.0).expand(1, 3)
    weighted = maximum_likelihood([Observation(ranging(), value, weight=of_component)], initial.expand(3, 2))
    noise = filters.Diagonal(0.01 / of_component[0])
    for k in range(3):
        second = Observation(observations[1].model, observations[1].value, weight=of_element[k])
        alone = maximum_likelihood([observations[0], second], initial)
        assert_equal(batch.belief.mean[k], alone.belief.mean)
        same = maximum_likelihood([Observation(filters.MeasurementModel(ranges, noise), value)], initial)
        assert_equal(weighted.belief.mean[k], same.belief.mean)


# Manifolds


def test_rotation_from_vector_pairs_equals_the_closed_form() -> None:
    truth = filters.SO3().retract(tensor(0.0, 0.0, 0.0, 1.0).expand(5, 4), random_numbers(5, 3))
    vectors = random_numbers(6, 3, seed=1)
    weights = tensor(1.0, 2.0, 0.5, 1.0, 3.0, 1.0)
    seen = vectors @ filters.SO3().to_matrix(truth).mT + 0.05 * random_numbers(5, 6, 3, seed=2)
    model = filters.MeasurementModel(
        lambda rotation: (vectors @ filters.SO3().to_matrix(rotation).mT).flatten(-2), 0.05**2 * torch.eye(18).double()
    )
    observation = Observation(model, seen.flatten(-2), weight=weights.repeat_interleave(3).expand(1, 18))
    estimate = maximum_likelihood([observation], tensor(0.0, 0.0, 0.0, 1.0), filters.SO3())
    assert bool(estimate.converged.all())
    for k in range(5):
        rotation, _ = Rotation.align_vectors(seen[k].numpy(), vectors.numpy(), weights=weights.numpy())
        np.testing.assert_allclose(filters.SO3().to_matrix(estimate.belief.mean[k]), rotation.as_matrix(), atol=1e-8)


def test_resection_of_a_stereo_pose_equals_scipy() -> None:
    points = random_numbers(10, 3, seed=1) + tensor(0.0, 0.0, 6.0)
    start = filters.SE3().from_matrix(torch.eye(4, dtype=torch.float64))
    truth = filters.SE3().retract(start, tensor(0.3, -0.2, 0.5, 0.05, 0.2, -0.1))
    value = project(truth, points) + 0.5 * random_numbers(30)
    model = filters.MeasurementModel(project, filters.Diagonal(torch.full((30,), 0.25, dtype=torch.float64)))
    estimate = maximum_likelihood([Observation(model, value, (points,))], start, filters.SE3())

    def residuals(x: np.ndarray) -> np.ndarray:
        pose = np.concatenate([x[:3], Rotation.from_rotvec(x[3:]).as_quat()])
        return ((value - project(torch.from_numpy(pose), points)) / 0.5).numpy()

    found = least_squares(residuals, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-14)
    np.testing.assert_allclose(estimate.cost, found.cost, rtol=1e-9)
    np.testing.assert_allclose(estimate.belief.mean[:3], found.x[:3], atol=1e-6)
    rotation = filters.SO3().to_matrix(estimate.belief.mean[3:])
    np.testing.assert_allclose(rotation, Rotation.from_rotvec(found.x[3:]).as_matrix(), atol=1e-7)


@pytest.mark.parametrize("with_prior", [False, True])
def test_given_jacobian_equals_automatic_differentiation(with_prior: bool) -> None:
    def slope(state: Tensor) -> Tensor:
        away = state[..., None, :2] - BEACONS
        direction = away / torch.linalg.vector_norm(away, dim=-1, keepdim=True)
        return torch.nn.functional.pad(direction @ filters.SE2().to_matrix(state)[..., :2, :2], (0, 1))

    given = filters.MeasurementModel(ranges, ranging().noise, jacobian=slope)
    pose, tilt = tensor(2.0, 1.0, 0.4), Observation(sighting(), bearings(tensor(2.1, 1.0, 0.4)))
    value = ranges(pose) + 0.1 * random_numbers(4, 3)
    estimates = []
    for model in (given, ranging()):
        observations = [Observation(model, value), tilt]
        if with_prior:
            prior = filters.Gaussian((pose + tensor(0.3, 0.3, 0.8)).expand(4, 3), covariances(4, 3))
            estimates.append(maximum_a_posteriori(prior, observations, filters.SE2()))
        else:
            estimates.append(maximum_likelihood(observations, pose + tensor(0.3, 0.3, 0.3), filters.SE2()))
    assert_same(estimates[0], estimates[1])


# Batches, precision, gradients


def test_batch_equals_loop_and_dimensions_broadcast() -> None:
    points = tensor(2.0, 1.0) + 0.5 * random_numbers(4, 3, 2)
    value = ranges(points) + 0.1 * random_numbers(4, 3, 3, seed=1)
    initial = tensor(1.5, 1.5) + 0.3 * random_numbers(3, 2, seed=2)
    prior = filters.Gaussian(initial, covariances(3, 2))
    likeliest = maximum_likelihood([Observation(ranging(), value)], initial)
    posterior = maximum_a_posteriori(prior, [Observation(ranging(), value)])
    for batch in (likeliest, posterior):
        assert batch.belief.batch_shape == batch.cost.shape == batch.iterations.shape == (4, 3)
    for i, j in ((0, 0), (1, 2), (3, 1)):
        observation = Observation(ranging(), value[i, j])
        assert_same(maximum_likelihood([observation], initial[j]), element(likeliest, i, j))
        assert_same(maximum_a_posteriori(prior[j], [observation]), element(posterior, i, j))


def test_an_element_that_has_converged_does_not_change() -> None:
    value = ranges(tensor(2.0, 1.0)) + 0.1 * random_numbers(3)
    observations = [Observation(ranging(), value)]
    starts = torch.stack([tensor(2.0, 1.0), tensor(40.0, 60.0)])
    both = maximum_likelihood(observations, starts)
    steps = int(both.iterations[0])
    assert bool(both.converged.all())
    assert steps < int(both.iterations[1])
    stopped = maximum_likelihood(observations, starts, iterations=steps)
    assert bool(stopped.converged[0])
    assert not bool(stopped.converged[1])
    assert torch.equal(both.belief.mean[0], stopped.belief.mean[0])
    assert torch.equal(both.belief.factor[0], stopped.belief.factor[0])


def test_single_precision_finds_the_same_pose() -> None:
    points = random_numbers(10, 3, seed=1) + tensor(0.0, 0.0, 6.0)
    start = filters.SE3().from_matrix(torch.eye(4, dtype=torch.float64))
    truth = filters.SE3().retract(start.expand(3, 7), 0.03 * random_numbers(3, 6, seed=2))
    value = project(truth, points) + 0.5 * random_numbers(3, 30)
    prior_covariance = 0.1 * torch.eye(6, dtype=torch.float64)
    estimates = []
    for dtype in (torch.float64, torch.float32):
        model = filters.MeasurementModel(project, filters.Diagonal(torch.full((30,), 0.25, dtype=dtype)))
        observations = [Observation(model, value.to(dtype), (points.to(dtype),))]
        prior = filters.Gaussian(start, prior_covariance).to(dtype)
        estimates.append(maximum_likelihood(observations, prior.mean, filters.SE3()))
        estimates.append(maximum_a_posteriori(prior, observations, filters.SE3()))
    for double, single in zip(estimates[:2], estimates[2:], strict=True):
        assert single.belief.mean.dtype == single.cost.dtype == torch.float32
        assert bool(single.converged.all())
        apart = filters.SE3().local(double.belief.mean, single.belief.mean.double())
        deviation = torch.sqrt(torch.diagonal(double.belief.covariance, dim1=-2, dim2=-1))
        assert float((apart / deviation).abs().max()) < 0.02
        torch.testing.assert_close(single.belief.covariance.double(), double.belief.covariance, rtol=1e-2, atol=1e-8)


def test_single_precision_converges_where_round_off_of_a_large_cost_hides_its_slope() -> None:
    value = (100 * ranges(tensor(2.0, 1.0)) + random_numbers(100, 3)).float()
    noise = filters.Diagonal(torch.full((3,), 1e-4))  # a hundred times too sure
    model = filters.MeasurementModel(lambda state: 100 * ranges(state), noise)
    estimate = maximum_likelihood([Observation(model, value)], torch.tensor([2.5, 0.5]))
    assert float(estimate.cost.median()) > 1e3
    assert bool(estimate.converged.all())


def test_gradient_flows_through_a_linear_problem() -> None:
    H = random_numbers(3, 2)

    def solve(mean: Tensor, root: Tensor, noise_root: Tensor, value: Tensor, weight: Tensor) -> tuple[Tensor, ...]:
        noise = noise_root @ noise_root.mT + torch.eye(3, dtype=torch.float64)
        prior = filters.Gaussian(mean, root @ root.mT + torch.eye(2, dtype=torch.float64))
        observation = Observation(filters.LinearMeasurement(H, noise), value, weight=weight)
        after = maximum_a_posteriori(prior, [observation])
        likely = maximum_likelihood([observation], mean.detach())
        return after.belief.mean, after.belief.covariance, after.cost, likely.belief.mean, likely.cost

    arguments = (
        random_numbers(2),
        random_numbers(2, 2),
        random_numbers(3, 3),
        random_numbers(3),
        1 + random_numbers(3).abs(),
    )
    assert torch.autograd.gradcheck(solve, tuple(argument.requires_grad_() for argument in arguments))


def test_gradient_of_a_converged_estimate_is_that_of_its_definition() -> None:
    prior = filters.Gaussian(tensor(2.3, 0.6), covariances(2))
    value = ranges(tensor(2.0, 1.0)) + 0.3 * random_numbers(3)

    def solve(value: Tensor) -> Tensor:
        return maximum_a_posteriori(prior, [Observation(ranging(0.3), value)]).belief.mean

    assert torch.autograd.gradcheck(solve, value.requires_grad_(), atol=1e-6)


# Control of steps, and failures


def arctangent(slope: float = 1.0) -> filters.MeasurementModel:
    return filters.MeasurementModel(lambda x: slope * torch.atan(x), torch.eye(1, dtype=torch.float64))


def test_halved_steps_recover_a_start_from_which_full_steps_diverge() -> None:
    x = 3.0
    for _ in range(4):
        x = x - math.atan(x) * (1 + x * x)
    assert abs(x) > 1e6
    starts = tensor(0.5, 3.0, -10.0, 20.0)[:, None]
    for estimate in (
        maximum_likelihood([Observation(arctangent(), tensor(0.0))], starts),
        maximum_a_posteriori(
            filters.Gaussian(starts, 1e8 * torch.eye(1).double()), [Observation(arctangent(), tensor(0.0))]
        ),
    ):
        assert bool(estimate.converged.all())
        torch.testing.assert_close(estimate.belief.mean, torch.zeros_like(starts), rtol=0.0, atol=1e-6)


def test_cost_never_rises() -> None:
    value, starts = ranges(tensor(2.0, 1.0)), 20 * random_numbers(50, 2)
    costs = [
        maximum_likelihood([Observation(ranging(), value)], starts, iterations=steps).cost for steps in range(1, 8)
    ]
    for before, after in itertools.pairwise(costs):
        assert bool((after <= before + 1e-9).all())


def test_step_into_where_the_model_is_not_defined_is_shortened() -> None:
    model = filters.MeasurementModel(torch.log, torch.eye(1, dtype=torch.float64))
    estimate = maximum_likelihood([Observation(model, tensor(-2.0))], tensor(5.0))
    assert_equal(estimate.belief.mean, torch.exp(tensor(-2.0)))


def test_unobservable_elements_are_named_with_what_nothing_sees() -> None:
    matrix = random_numbers(5, 4, 3)
    matrix[[1, 3], :, 2] = matrix[[1, 3], :, 0] - 2 * matrix[[1, 3], :, 1]
    observations = [Observation(filters.LinearMeasurement(matrix, torch.eye(4).double()), random_numbers(5, 4))]
    initial = torch.zeros(5, 3, dtype=torch.float64)
    with pytest.raises(filters.FilterError, match=r"elements \(1,\), \(3,\) \(2 of 5\).*direction \[-0.5, 1, 0.5\]"):
        maximum_likelihood(observations, initial)
    held = maximum_likelihood(observations, initial, on_failure="hold")
    assert held.healthy.tolist() == [True, False, True, False, True]
    assert held.converged.tolist() == held.healthy.tolist()
    assert bool((held.belief.mean[[1, 3]] == 0.0).all())
    assert bool(held.belief.covariance[[1, 3]].isnan().any())
    well = Observation(filters.LinearMeasurement(matrix[::2], torch.eye(4).double()), random_numbers(5, 4)[::2])
    assert_equal(held.belief.mean[::2], maximum_likelihood([well], initial[::2]).belief.mean)
    maximum_a_posteriori(filters.Gaussian(initial, torch.eye(3).double()), observations)


@pytest.mark.parametrize("batch", [1, 150])
def test_too_few_observations_are_unobservable(batch: int) -> None:
    model = filters.LinearMeasurement(random_numbers(1, 3), torch.eye(1, dtype=torch.float64))
    with pytest.raises(filters.FilterError, match="do not determine the state"):
        maximum_likelihood([Observation(model, tensor(1.0))], torch.zeros(batch, 3, dtype=torch.float64))
    pose = torch.zeros(batch, 3, dtype=torch.float64) + tensor(2.0, 1.0, 0.3)
    with pytest.raises(filters.FilterError, match=r"direction \[0, 0, 1\]"):
        maximum_likelihood([Observation(ranging(), ranges(tensor(2.1, 1.0)))], pose, filters.SE2())


def test_prior_that_is_lost_in_the_round_off_of_precise_observations_is_not_passed_over() -> None:
    sum_of_both = Observation(filters.LinearMeasurement(torch.ones(1, 2), 1e-10 * torch.eye(1)), torch.ones(1))
    prior = filters.Gaussian(torch.zeros(2), 1e10 * torch.eye(2))
    with pytest.raises(filters.FilterError, match=r"differ in precision by more than the digits of torch.float32"):
        maximum_a_posteriori(prior, [sum_of_both])
    double = Observation(
        filters.LinearMeasurement(*(m.double() for m in (torch.ones(1, 2), 1e-10 * torch.eye(1)))), tensor(1)
    )
    estimate = maximum_a_posteriori(prior.to(torch.float64), [double])
    torch.testing.assert_close(estimate.belief.mean, tensor(0.5, 0.5), rtol=0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda prior, noise, value: prior[1].fill_(-1.0), "prior covariance is not positive semidefinite"),
        (lambda prior, noise, value: noise[1].mul_(-1.0), "noise covariance of observation 0"),
        (lambda prior, noise, value: noise[1].zero_(), "noise covariance of observation 0"),
        (lambda prior, noise, value: value[1].fill_(torch.inf), "not finite"),
    ],
)
def test_one_bad_element_is_named_and_does_not_take_the_batch_down(
    spoil: Callable[[Tensor, Tensor, Tensor], object], message: str
) -> None:
    mean, prior = tensor(1.5, 1.5).expand(3, 2), torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    noise, value = 0.01 * torch.eye(3, dtype=torch.float64).repeat(3, 1, 1), ranges(tensor(2.0, 1.0)).repeat(3, 1)

    def solve(on_failure: str) -> PointEstimate:
        observations = [Observation(filters.MeasurementModel(ranges, noise), value)]
        return maximum_a_posteriori(filters.Gaussian(mean, prior), observations, on_failure=on_failure)  # type: ignore[arg-type]

    good = solve("raise")
    spoil(prior, noise, value)
    with pytest.raises(filters.FilterError, match=rf"elements \(1,\) \(1 of 3\), in the first: .*{message}"):
        solve("raise")
    held = solve("hold")
    assert held.healthy.tolist() == [True, False, True]
    assert torch.equal(held.belief.mean[1], mean[1])
    assert_equal(held.belief.mean[::2], good.belief.mean[::2])


def test_what_cannot_be_asked_is_refused_with_the_reason() -> None:
    start, value = tensor(1.0, 1.0), tensor(1.0, 1.0, 1.0)
    bent = filters.MeasurementModel(lambda x, v: ranges(x) + v, torch.eye(3).double(), additive=False)
    flat = filters.LinearMeasurement(torch.eye(3).double(), torch.eye(3).double())
    with pytest.raises(ValueError, match="observation 1: only additive noise"):
        maximum_likelihood([Observation(ranging(), value), Observation(bent, value)], start)
    with pytest.raises(TypeError, match=r"LinearMeasurement is for states in R\^n"):
        maximum_likelihood([Observation(flat, value)], tensor(1.0, 1.0, 0.0), filters.SE2())
    with pytest.raises(ValueError, match="at least one observation"):
        maximum_likelihood([], start)
    with pytest.raises(ValueError, match="weights must be at least 0"):
        maximum_likelihood([Observation(ranging(), value, weight=-1.0)], start)
    with pytest.raises(ValueError, match=r"a weight has shape \(4,\), or \(4, 3\)"):
        maximum_likelihood([Observation(ranging(), value, weight=value)], start.expand(4, 2))
    with pytest.raises(ValueError, match="2 components, its noise 3"):
        maximum_likelihood([Observation(ranging(), value[:2])], start)
    with pytest.raises(ValueError, match=r"returns 3 components, its value has 2"):
        maximum_likelihood([Observation(filters.MeasurementModel(ranges, torch.eye(2).double()), value[:2])], start)
    with pytest.raises(ValueError, match=r"float32, the state torch.float64"):
        maximum_likelihood([Observation(ranging(), value.float())], start)
    with pytest.raises(ValueError, match=r"have batch \(4,\), .*expand the state"):
        maximum_likelihood(
            [Observation(filters.MeasurementModel(ranges, filters.Diagonal(torch.ones(4, 3).double())), value)], start
        )
    with pytest.raises(ValueError, match="must be at least 1"):
        maximum_likelihood([Observation(ranging(), value)], start, iterations=0)
    with pytest.raises(ValueError, match="choose raise or hold"):
        maximum_likelihood([Observation(ranging(), value)], start, on_failure="jitter")  # type: ignore[arg-type]
