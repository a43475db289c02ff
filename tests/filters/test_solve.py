"""The three forms of the update against each other, the masks, and the unrolled path against LAPACK."""

from dataclasses import replace

import pytest
import torch

import sigmaslam_filters as filters
from sigmaslam_filters.core.solve import FORMS
from tests.support.filter_assertions import assert_close, assert_same_belief, assert_same_update
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, noises, random_numbers

KINDS = ("diagonal", "blocks", "dense")
STATES = 4
# The likelihood has a test of its own for the last digits with missing components.
OF_LIKELIHOOD = 1e-6


def kalman_filters(form: str) -> dict[str, filters.BayesFilter]:
    return {
        "ukf": filters.UnscentedKalmanFilter(form=form),
        "ukf julier": filters.UnscentedKalmanFilter(points=filters.julier(1.0), form=form),
        "ukf iterated": filters.UnscentedKalmanFilter(form=form, iterations=3),
        "ekf": filters.ExtendedKalmanFilter(form=form),
    }


@pytest.mark.parametrize("name", kalman_filters("qr"))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("measurements", [2, 8, 40])
def test_low_rank_and_qr_updates_equal_dense(measurements, kind, name):
    """Fewer measurements than columns, about as many, and more."""
    prior, z = beliefs(3, STATES), random_numbers(3, measurements, seed=5)
    measurement = bent_measurement(STATES, measurements, noises(measurements)[kind])
    dense, low_rank, qr = (kalman_filters(form)[name].update(prior, measurement, z) for form in FORMS)
    assert (dense.form, low_rank.form, qr.form) == FORMS
    assert_same_update(low_rank, dense, 1e-12)
    assert_same_update(qr, dense, 1e-12)


@pytest.mark.parametrize("measurements", [2, 30])
def test_forms_agree_over_several_steps(measurements):
    motion, measurement = bent_motion(STATES), bent_measurement(STATES, measurements, noises(measurements)["blocks"])
    values = random_numbers(8, 3, measurements, seed=5)
    tracks = [
        filters.UnscentedKalmanFilter(form=form).filter(beliefs(3, STATES), motion, measurement, values)
        for form in FORMS
    ]
    for track in tracks[1:]:
        assert_same_belief(track.filtered, tracks[0].filtered, 1e-11)
        assert_same_belief(track.predicted, tracks[0].predicted, 1e-11)
        assert_close(track.log_likelihood, tracks[0].log_likelihood, 1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_noise_agree_where_they_are_the_same_matrix(kind):
    noise, prior, z = noises(6)[kind], beliefs(STATES), random_numbers(6, seed=3)
    for form in FORMS:
        bayes = filters.UnscentedKalmanFilter(form=form)
        found = bayes.update(prior, bent_measurement(STATES, 6, noise), z)
        expected = bayes.update(prior, bent_measurement(STATES, 6, filters.Dense(noise.covariance())), z)
        assert_same_update(found, expected, 1e-12)


@pytest.mark.parametrize(
    ("bayes", "measurements", "expected"),
    [
        (filters.UnscentedKalmanFilter(), 2 * STATES, "dense"),
        (filters.UnscentedKalmanFilter(), 2 * STATES + 1, "low-rank"),
        (filters.ExtendedKalmanFilter(), STATES, "dense"),
        (filters.ExtendedKalmanFilter(), STATES + 1, "low-rank"),
        (filters.UnscentedKalmanFilter(points=filters.merwe(0.5, 0.0, allow_negative=True)), 40, "dense"),
    ],
)
def test_form_follows_the_larger_of_measurement_and_columns(bayes, measurements, expected):
    prior, z = beliefs(STATES), random_numbers(measurements)
    noise = filters.Diagonal(torch.ones(measurements, dtype=torch.float64))
    assert bayes.update(prior, bent_measurement(STATES, measurements, noise), z).form == expected


def test_form_is_qr_in_float32_and_for_square_roots():
    prior, measurement = beliefs(STATES), bent_measurement(STATES, 2, filters.Diagonal(torch.ones(2)))
    by_root = filters.Gaussian(prior.mean, factor=random_numbers(STATES, 2 * STATES))
    double = replace(measurement, noise=filters.Diagonal(torch.ones(2, dtype=torch.float64)))
    bayes = filters.UnscentedKalmanFilter()
    assert bayes.update(prior.to(torch.float32), measurement, torch.zeros(2)).form == "qr"
    update = bayes.update(by_root, double, torch.zeros(2, dtype=torch.float64))
    assert update.form == "qr"
    assert update.belief.is_square_root
    assert bayes.predict(by_root, bent_motion(STATES)).belief.is_square_root
    assert not bayes.predict(prior, bent_motion(STATES)).belief.is_square_root


@pytest.mark.parametrize("form", FORMS)
def test_belief_by_any_root_equals_belief_by_covariance(form):
    root = random_numbers(3, STATES, 2 * STATES, seed=2)
    mean, z = random_numbers(3, STATES), random_numbers(3, 6, seed=3)
    bayes = filters.UnscentedKalmanFilter(form=form)
    measurement = bent_measurement(STATES, 6)
    found = bayes.update(filters.Gaussian(mean, factor=root), measurement, z)
    assert_same_update(found, bayes.update(filters.Gaussian(mean, root @ root.mT), measurement, z), 1e-11)


def test_negative_weights_update_as_the_textbook_in_the_dense_form():
    points, prior, z = filters.merwe(0.4, 0.0, allow_negative=True), beliefs(STATES), random_numbers(2, seed=3)
    measurement = bent_measurement(STATES, 2)
    update = filters.UnscentedKalmanFilter(points=points, form="dense").update(prior, measurement, z)
    spread = 0.4**2 * STATES
    root = torch.linalg.cholesky(prior.covariance) * spread**0.5
    x = torch.cat([prior.mean + root.mT, prior.mean - root.mT, prior.mean[None]])
    weight = torch.full((2 * STATES + 1,), 0.5 / spread, dtype=torch.float64)
    weight[-1] = 1 - STATES / spread
    values = measurement.function(x)
    mean = weight @ values
    weight[-1] += 1 - 0.4**2
    dz, dx = values - mean, x - prior.mean
    S = dz.mT @ (weight[:, None] * dz) + measurement.noise
    gain = dx.mT @ (weight[:, None] * dz) @ torch.linalg.inv(S)
    assert weight[-1] < 0
    assert_close(update.innovation_covariance, S, 1e-12)
    assert_close(update.belief.mean, prior.mean + gain @ (z - mean), 1e-12)
    assert_close(update.belief.covariance, prior.covariance - gain @ S @ gain.mT, 1e-12)


@pytest.mark.parametrize("form", ["low-rank", "qr"])
def test_negative_weights_are_refused_by_forms_that_cannot_take_them(form):
    bayes = filters.UnscentedKalmanFilter(points=filters.merwe(0.5, 0.0, allow_negative=True), form=form)
    with pytest.raises(ValueError, match="form='dense'"):
        bayes.update(beliefs(STATES), bent_measurement(STATES, 6), random_numbers(6))


@pytest.mark.parametrize("augmented", [False, True], ids=["additive", "augmented"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("measurements", "kept"), [(4, (1, 2)), (4, (3,)), (12, (0, 1, 3, 6, 7, 10))])
def test_missing_components_equal_a_model_without_them(measurements, kept, form, kind, augmented):
    """NaN in the value and False in the mask, with the noise added or among the arguments."""
    bayes = filters.ExtendedKalmanFilter(form=form) if augmented else filters.UnscentedKalmanFilter(form=form)
    prior, z, keep = beliefs(3, STATES), random_numbers(3, measurements, seed=6), torch.tensor(kept)
    full = bent_measurement(STATES, measurements, noises(measurements)[kind])
    seen, covariance = full.function, noises(measurements)[kind].covariance()
    less = filters.MeasurementModel(lambda x: seen(x)[..., keep], covariance[keep][:, keep])
    if augmented:
        full = replace(full, function=lambda x, v: seen(x) + v, additive=False)
    mask = torch.zeros(measurements, dtype=torch.bool).index_fill(0, keep, True)
    nan = bayes.update(prior, full, torch.where(mask, z, torch.nan))
    masked = bayes.update(prior, replace(full, mask=mask), z)
    without = bayes.update(prior, less, z[:, keep])
    assert_same_update(masked, nan, 1e-13)
    assert_same_belief(nan.belief, without.belief, 1e-11)
    assert_close(nan.nis, without.nis, 1e-11)
    assert_close(nan.log_likelihood, without.log_likelihood, OF_LIKELIHOOD)
    assert_close(nan.innovation[:, keep], without.innovation, 1e-12)
    assert_close(nan.gain[..., keep], without.gain, 1e-11)
    assert bool((nan.innovation[:, ~mask] == 0).all())
    assert bool((torch.as_tensor(nan.count) == len(kept)).all())


@pytest.mark.parametrize("size", [2, 3])
def test_missing_components_leave_noise_that_is_not_additive_alone(size):
    """v reaches both components: with one of them missing, all of v still disturbs the other.

    Also with more noises than measurements.
    """
    prior, z = beliefs(STATES), random_numbers(2, seed=3)
    H, spread, noise = random_numbers(2, STATES), random_numbers(2, size, seed=4), covariances(size)
    augmented = filters.MeasurementModel(lambda x, v: x @ H.mT + v @ spread.mT, noise, additive=False)
    z[0] = torch.nan
    found = filters.ExtendedKalmanFilter().update(prior, augmented, z)
    expected = filters.KalmanFilter().update(prior, filters.LinearMeasurement(H, spread @ noise @ spread.mT), z)
    assert_same_belief(found.belief, expected.belief, 1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("measurements", [4, 12])
def test_nothing_measured_changes_nothing(form, kind, measurements):
    prior = beliefs(3, STATES)
    z = torch.full((3, measurements), torch.nan, dtype=torch.float64)
    bayes = filters.UnscentedKalmanFilter(form=form, iterations=2)
    update = bayes.update(prior, bent_measurement(STATES, measurements, noises(measurements)[kind]), z)
    assert_same_belief(update.belief, prior, 1e-14)
    for array in (update.innovation, update.nis, update.log_likelihood, update.gain, torch.as_tensor(update.count)):
        assert_close(array.double(), torch.zeros_like(array).double(), 1e-14)
    assert bool(update.healthy.all())


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("form", FORMS)
def test_each_element_of_the_batch_has_its_own_mask(form, kind):
    prior, z = beliefs(6, STATES), random_numbers(6, 8, seed=5)
    z[random_numbers(6, 8, seed=8) > 0.3] = torch.nan
    z[0] = random_numbers(8)
    bayes, measurement = filters.UnscentedKalmanFilter(form=form), bent_measurement(STATES, 8, noises(8)[kind])
    update = bayes.update(prior, measurement, z)
    assert update.count.tolist() == (~z.isnan()).sum(dim=-1).tolist()
    for k in range(6):
        alone = bayes.update(prior[k], measurement, z[k])
        assert_same_belief(update.belief[k], alone.belief, 1e-12)
        assert_close(update.log_likelihood[k], alone.log_likelihood, OF_LIKELIHOOD)
        assert_close(update.nis[k], alone.nis, 1e-12)
        assert_close(update.innovation_covariance[k], alone.innovation_covariance, 1e-12)


def test_missing_components_of_a_linear_measurement_equal_a_model_without_them():
    prior, H, noise = beliefs(STATES), random_numbers(4, STATES), covariances(4)
    z, keep = random_numbers(4, seed=3), torch.tensor([0, 3])
    nan = z.clone()
    nan[[1, 2]] = torch.nan
    for form in FORMS:
        found = filters.KalmanFilter(form=form).update(prior, filters.LinearMeasurement(H, noise), nan)
        expected = filters.KalmanFilter(form=form).update(
            prior, filters.LinearMeasurement(H[keep], noise[keep][:, keep]), z[keep]
        )
        assert_same_belief(found.belief, expected.belief, 1e-12)
        assert_close(found.log_likelihood, expected.log_likelihood, OF_LIKELIHOOD)


def test_likelihood_with_missing_components_keeps_its_digits():
    prior, H, noise, z = beliefs(STATES), random_numbers(4, STATES), covariances(4), random_numbers(4, seed=3)
    found = filters.KalmanFilter().update(
        prior, filters.LinearMeasurement(H, noise, mask=torch.tensor([True] * 3 + [False])), z
    )
    expected = filters.KalmanFilter().update(prior, filters.LinearMeasurement(H[:3], noise[:3, :3]), z[:3])
    assert_close(found.log_likelihood, expected.log_likelihood, 1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6])
def test_large_batch_equals_single_filters(size, form):
    """The unrolled path of many small filters against LAPACK's of each alone."""
    count, measurements = 130, min(size + 1, 4)
    bayes = filters.UnscentedKalmanFilter(form=form)
    motion, measurement = bent_motion(size), bent_measurement(size, measurements)
    prior, z = beliefs(count, size), random_numbers(count, measurements, seed=6)
    z[:7, 0] = torch.nan
    predicted, update = bayes.predict(prior, motion), bayes.update(prior, measurement, z)
    for k in (0, 5, 6, 7, 64, 129):
        assert_same_belief(predicted.belief[k], bayes.predict(prior[k], motion).belief, 1e-12)
        alone = bayes.update(prior[k], measurement, z[k])
        assert_same_belief(update.belief[k], alone.belief, 1e-11)
        assert_close(update.log_likelihood[k], alone.log_likelihood, OF_LIKELIHOOD)
        for name in ("nis", "innovation_covariance", "gain"):
            assert_close(getattr(update, name)[k], getattr(alone, name), 1e-11)
