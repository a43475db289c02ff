"""Predict and update against the textbook, against each other, and one filter against many."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.solve import FORMS
from tests.support.filter_assertions import assert_close, assert_same_belief, assert_same_update
from tests.support.filter_builders import (
    beliefs,
    bent_measurement,
    bent_motion,
    covariances,
    noises,
    random_numbers,
    tensor,
)

SIGMA_SETS = {
    "cubature": filters.cubature(),
    "julier": filters.julier(1.0),
    "merwe": filters.merwe(1.0, 2.0),
    "simplex": filters.Simplex(),
}
FILTERS = {name: filters.UnscentedKalmanFilter(points=points) for name, points in SIGMA_SETS.items()}
FILTERS["ekf"] = filters.ExtendedKalmanFilter()
EACH_FILTER = list(FILTERS)

SIZE, CONTROLS, NOISES, MEASUREMENTS = 5, 2, 3, 3
A = torch.eye(SIZE, dtype=torch.float64) + 0.2 * random_numbers(SIZE, SIZE, seed=1)
B1 = random_numbers(SIZE, CONTROLS, seed=2)
B2 = random_numbers(SIZE, NOISES, seed=3)
Q = covariances(NOISES, seed=4, scale=0.1)
# The last two states are seen through their correlation with the others only.
H = torch.cat([random_numbers(MEASUREMENTS, 3, seed=5), torch.zeros(MEASUREMENTS, 2, dtype=torch.float64)], dim=1)
R = covariances(MEASUREMENTS, seed=6, scale=0.2)
PRIOR = beliefs(SIZE, seed=7)
STEPS = 4
CONTROL = random_numbers(STEPS, CONTROLS, seed=9)
VALUES = random_numbers(STEPS, MEASUREMENTS, seed=10)


def linear_models(
    additive: bool = True, jacobian: bool = False
) -> tuple[filters.MotionModel, filters.MeasurementModel]:
    """The linear-Gaussian system as plain functions."""
    if not additive:
        return (
            filters.MotionModel(lambda x, w, u: x @ A.mT + u @ B1.mT + w @ B2.mT, Q, additive=False),
            filters.MeasurementModel(lambda x, v: x @ H.mT + v, R, additive=False),
        )
    return (
        filters.MotionModel(
            lambda x, u: x @ A.mT + u @ B1.mT, Q, noise_matrix=B2, jacobian=(lambda x, u: A) if jacobian else None
        ),
        filters.MeasurementModel(lambda x: x @ H.mT, R, jacobian=(lambda x: H) if jacobian else None),
    )


def assert_equals_textbook(bayes: filters.BayesFilter, motion, measurement) -> None:
    """Several steps against (9.22)-(9.25) in numpy, the likelihood against scipy."""
    belief = PRIOR
    mean, P = PRIOR.mean.numpy(), PRIOR.covariance.numpy()
    a, b1, b2, q, h, r = (matrix.numpy() for matrix in (A, B1, B2, Q, H, R))
    for k in range(STEPS):
        predicted = bayes.predict(belief, motion, CONTROL[k])
        mean, P = a @ mean + b1 @ CONTROL[k].numpy(), a @ P @ a.T + b2 @ q @ b2.T
        assert_same_belief(predicted.belief, filters.Gaussian(torch.as_tensor(mean), torch.as_tensor(P)), 1e-10)

        update = bayes.update(predicted.belief, measurement, VALUES[k])
        z, S = VALUES[k].numpy(), h @ P @ h.T + r
        K, innovation = P @ h.T @ np.linalg.inv(S), z - h @ mean
        expected = {
            "innovation": innovation,
            "innovation_covariance": S,
            "gain": K,
            "nis": innovation @ np.linalg.solve(S, innovation),
            "log_likelihood": multivariate_normal.logpdf(z, h @ mean, S),
        }
        for name, value in expected.items():
            assert_close(getattr(update, name), torch.as_tensor(value), 1e-10)
        mean, P = mean + K @ innovation, P - K @ S @ K.T
        assert_same_belief(update.belief, filters.Gaussian(torch.as_tensor(mean), torch.as_tensor(P)), 1e-10)
        assert bool(update.healthy)
        assert update.count == MEASUREMENTS
        belief = update.belief


@pytest.mark.parametrize("form", ["auto", *FORMS])
def test_kalman_filter_equals_textbook(form):
    motion, measurement = filters.LinearMotion(A, Q, B1, B2), filters.LinearMeasurement(H, R)
    assert_equals_textbook(filters.KalmanFilter(form=form), motion, measurement)


@pytest.mark.parametrize("name", EACH_FILTER)
def test_nonlinear_filters_equal_textbook_on_a_linear_model(name):
    assert_equals_textbook(FILTERS[name], *linear_models())


@pytest.mark.parametrize("form", FORMS)
def test_unscented_filter_equals_textbook_in_every_form(form):
    assert_equals_textbook(filters.UnscentedKalmanFilter(form=form), *linear_models())


def test_extended_filter_with_given_jacobians_equals_textbook():
    assert_equals_textbook(filters.ExtendedKalmanFilter(), *linear_models(jacobian=True))


@pytest.mark.parametrize("iterations", [2, 3])
@pytest.mark.parametrize("name", EACH_FILTER)
def test_iterations_change_nothing_on_a_linear_model(name, iterations):
    bayes = FILTERS[name]
    again = filters.BayesFilter(bayes.transform, iterations=iterations)
    assert_equals_textbook(again, *linear_models())


@pytest.mark.parametrize("name", EACH_FILTER)
def test_augmented_equals_additive_on_a_linear_model(name):
    """x' = f(x, w) and z = h(x, v) with the noise among the arguments, against the textbook with noise added."""
    assert_equals_textbook(FILTERS[name], *linear_models(additive=False))


@pytest.mark.parametrize("form", FORMS)
def test_augmented_equals_additive_in_every_form(form):
    assert_equals_textbook(filters.UnscentedKalmanFilter(form=form), *linear_models(additive=False))


def augmented(model):
    """The same noise declared as an argument of the function."""
    return type(model)(lambda x, w: model.function(x) + w, model.noise, additive=False)


def test_augmented_extended_filter_equals_additive_on_a_nonlinear_model():
    motion, measurement = bent_motion(4), bent_measurement(4, 3)
    prior, z, bayes = beliefs(4, seed=3), random_numbers(3, seed=5), filters.ExtendedKalmanFilter()
    added, argument = bayes.predict(prior, motion), bayes.predict(prior, augmented(motion))
    assert_same_belief(argument.belief, added.belief, 1e-12)
    assert_same_update(bayes.update(prior, augmented(measurement), z), bayes.update(prior, measurement, z), 1e-12)


def test_extended_filter_takes_derivatives_that_equal_its_own():
    landmark = tensor(3.0, 1.0)

    def slope(x: Tensor) -> Tensor:
        offset = landmark - x
        return -offset[..., None, :] / offset.norm(dim=-1)[..., None, None]

    def distance(x: Tensor) -> Tensor:
        return (landmark - x).norm(dim=-1, keepdim=True)

    prior, z, noise = beliefs(7, 2, seed=3), tensor(2.5), filters.Diagonal(tensor(0.1))
    for iterations in (1, 3):
        bayes = filters.ExtendedKalmanFilter(iterations=iterations)
        given = bayes.update(prior, filters.MeasurementModel(distance, noise, jacobian=slope), z)
        assert_same_update(given, bayes.update(prior, filters.MeasurementModel(distance, noise), z), 1e-12)


def test_iterated_extended_filter_stops_at_the_maximum_of_the_posterior():
    prior, measurement, z = beliefs(3, seed=4), bent_measurement(3, 5), random_numbers(5, seed=8)
    found = filters.ExtendedKalmanFilter(iterations=60).update(prior, measurement, z).belief.mean.requires_grad_()
    error, residual = found - prior.mean, z - measurement.function(found)
    cost = error @ torch.linalg.solve(prior.covariance, error) + residual @ torch.linalg.solve(
        measurement.noise, residual
    )
    (gradient,) = torch.autograd.grad(cost, found)
    assert_close(gradient, torch.zeros_like(gradient), 1e-8)


@pytest.mark.parametrize("kind", ["kf", "ekf", "ukf"])
@pytest.mark.parametrize("batch", [(3,), (2, 3), (1, 2, 2)])
def test_batch_equals_loop(kind, batch):
    motion, measurement = bent_motion(4), bent_measurement(4, 3)
    bayes = filters.ExtendedKalmanFilter() if kind == "ekf" else filters.UnscentedKalmanFilter()
    if kind == "kf":
        bayes = filters.KalmanFilter()
        motion = filters.LinearMotion(random_numbers(4, 4), covariances(4))
        measurement = filters.LinearMeasurement(random_numbers(3, 4), covariances(3))
    prior, values = beliefs(*batch, 4), random_numbers(*batch, 3, seed=6)
    predicted, update = bayes.predict(prior, motion).belief, bayes.update(prior, measurement, values)
    for index in np.ndindex(*batch):
        assert_same_belief(predicted[index], bayes.predict(prior[index], motion).belief, 1e-12)
        alone = bayes.update(prior[index], measurement, values[index])
        assert_same_belief(update.belief[index], alone.belief, 1e-12)
        for name in ("innovation", "nis", "log_likelihood", "innovation_covariance", "gain"):
            assert_close(getattr(update, name)[index], getattr(alone, name), 1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_noise_matrices_and_inputs_broadcast_over_the_batch(form):
    """Each of them single, per element of the last batch dimension, and per element of both."""
    bayes, prior = filters.UnscentedKalmanFilter(form=form), beliefs(2, 3, 4)
    values = random_numbers(2, 3, 2, seed=5)
    for batch in ((), (3,), (2, 3), (2, 1)):
        Qs, Rs = covariances(*batch, 2, seed=1), covariances(*batch, 2, seed=2)
        matrix, control, scale = (
            random_numbers(*batch, *shape, seed=3 + k) for k, shape in enumerate(((4, 2), (4,), (1,)))
        )
        motion = filters.MotionModel(lambda x, u: x + torch.sin(u), Qs, noise_matrix=matrix)
        measurement = filters.MeasurementModel(lambda x, s: torch.sin(x[..., :2] * s), Rs)
        predicted, update = bayes.predict(prior, motion, control), bayes.update(prior, measurement, values, scale)

        def at(array: Tensor, index: tuple[int, int], leading: int = len(batch)) -> Tensor:
            return array.expand(2, 3, *array.shape[leading:])[index]

        for index in np.ndindex(2, 3):
            single = filters.MotionModel(motion.function, at(Qs, index), noise_matrix=at(matrix, index))
            alone = bayes.predict(prior[index], single, at(control, index))
            assert_same_belief(predicted.belief[index], alone.belief, 1e-12)
            seen = filters.MeasurementModel(measurement.function, at(Rs, index))
            again = bayes.update(prior[index], seen, values[index], at(scale, index))
            assert_same_belief(update.belief[index], again.belief, 1e-12)
            assert_close(update.log_likelihood[index], again.log_likelihood, 1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_order_of_independent_measurements_does_not_matter(form):
    variance, order = random_numbers(6, seed=1).square() + 0.1, torch.tensor([3, 0, 5, 1, 2, 4])
    prior, z = beliefs(3), random_numbers(6, seed=4)
    measurement = bent_measurement(3, 6, filters.Diagonal(variance))
    shuffled = filters.MeasurementModel(
        lambda x: measurement.function(x)[..., order], filters.Diagonal(variance[order])
    )
    bayes = filters.UnscentedKalmanFilter(form=form)
    first, second = bayes.update(prior, measurement, z), bayes.update(prior, shuffled, z[order])
    assert_same_belief(second.belief, first.belief, 1e-12)
    assert_close(second.nis, first.nis, 1e-12)
    assert_close(second.log_likelihood, first.log_likelihood, 1e-12)


@pytest.mark.parametrize("form", FORMS)
def test_two_updates_equal_one_joint_update_on_a_linear_model(form):
    first, second = noises(4, seed=1)["blocks"], noises(2, seed=2)["dense"]
    joint = torch.block_diag(first.covariance(), second.covariance())
    matrix, z, prior = random_numbers(6, 5, seed=3), random_numbers(6, seed=4), beliefs(5)
    bayes = filters.KalmanFilter(form=form)
    one = bayes.update(prior, filters.LinearMeasurement(matrix[:4], first), z[:4])
    two = bayes.update(one.belief, filters.LinearMeasurement(matrix[4:], second), z[4:])
    both = bayes.update(prior, filters.LinearMeasurement(matrix, joint), z)
    assert_same_belief(two.belief, both.belief, 1e-12)
    assert_close(one.nis + two.nis, both.nis, 1e-12)
    assert_close(one.log_likelihood + two.log_likelihood, both.log_likelihood, 1e-12)


def test_two_predictions_equal_one_of_the_product():
    bayes, prior = filters.KalmanFilter(), beliefs(SIZE)
    motion = filters.LinearMotion(A, covariances(SIZE, seed=5))
    twice = bayes.predict(bayes.predict(prior, motion).belief, motion).belief
    both = filters.LinearMotion(A @ A, motion.noise + A @ motion.noise @ A.mT)
    assert_same_belief(twice, bayes.predict(prior, both).belief, 1e-12)


def test_arguments_are_not_changed():
    prior, z = beliefs(2, 4), random_numbers(2, 3)
    z[0, 1] = torch.nan
    kept = prior.mean.clone(), prior.covariance.clone(), z.clone()
    bayes = filters.UnscentedKalmanFilter(on_failure="hold")
    bayes.predict(prior, bent_motion(4))
    bayes.update(prior, bent_measurement(4, 3), z)
    for before, after in zip(kept, (prior.mean, prior.covariance, z), strict=True):
        assert torch.equal(before.nan_to_num(), after.nan_to_num())


@pytest.mark.parametrize("form", ["auto", *FORMS])
def test_dtype_follows_the_belief(form):
    bayes, prior = filters.UnscentedKalmanFilter(form=form), beliefs(4).to(torch.float32)
    motion = filters.MotionModel(torch.sin, covariances(4).float())
    measurement = filters.MeasurementModel(lambda x: torch.sin(x[..., :2]), filters.Diagonal(torch.ones(2)))
    update = bayes.update(bayes.predict(prior, motion).belief, measurement, torch.zeros(2))
    for array in (update.belief.mean, update.belief.covariance, update.nis, update.log_likelihood, update.gain):
        assert array.dtype == torch.float32


def test_wrong_options_are_refused_by_name():
    for options in ({"form": "joseph"}, {"on_failure": "ignore"}, {"iterations": 0}):
        (name,) = options
        with pytest.raises(ValueError, match=name):
            filters.UnscentedKalmanFilter(**options)
    with pytest.raises(TypeError, match="UnscentedKalmanFilter"):
        filters.KalmanFilter().predict(PRIOR, linear_models()[0], CONTROL[0])
    with pytest.raises(ValueError, match=r"value has 2 components, but MeasurementModel.function returns 3"):
        filters.UnscentedKalmanFilter().update(PRIOR, linear_models()[1], torch.zeros(2, dtype=torch.float64))
    with pytest.raises(ValueError, match="control"):
        filters.KalmanFilter().predict(PRIOR, filters.LinearMotion(A, covariances(SIZE), B1))
