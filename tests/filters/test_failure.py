"""One bad element leaves the others alone; what fails says where and why; exactly known states are no failure."""

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.factors import cholesky
from sigmaslam_filters.core.solve import FORMS
from tests.support.filter_assertions import assert_close, assert_same_belief, assert_same_update
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

BAD = 7
BATCHES = {"large": 1_000, "few": 20}


def with_negative_eigenvalue(covariance: Tensor, share: float) -> Tensor:
    """The smallest eigenvalue made -share of the largest."""
    values, vectors = torch.linalg.eigh(covariance)
    values = torch.cat([-share * values[..., -1:], values[..., 1:]], dim=-1)
    return vectors @ torch.diag_embed(values) @ vectors.mT


def spoil(kind: str, belief: filters.Gaussian, z: Tensor, variance: Tensor) -> tuple[filters.Gaussian, Tensor, Tensor]:
    mean, P, z, variance = (a.clone() for a in (belief.mean, belief.covariance, z, variance))
    if kind == "mean":
        mean[BAD, 1] = torch.nan
    elif kind == "covariance":
        P[BAD, 1, 1] = torch.nan
    elif kind == "indefinite":
        P[BAD] = with_negative_eigenvalue(P[BAD], 0.5)
    elif kind == "measurement":
        z[BAD, 0] = torch.inf
    else:
        variance[BAD, 0] = -10.0
    return filters.Gaussian(mean, P), z, variance


@pytest.mark.parametrize("policy", ["hold", "jitter"])
@pytest.mark.parametrize("kind", ["mean", "covariance", "indefinite", "measurement", "noise"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("count", BATCHES.values(), ids=BATCHES)
def test_one_bad_element_is_held_and_flagged_and_leaves_the_others_alone(count, form, kind, policy):
    belief, z = beliefs(count, 3), random_numbers(count, 2, seed=4)
    variance = 0.1 + random_numbers(count, 2, seed=5).square()
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure=policy)
    see = bent_measurement(3, 2).function
    good = bayes.update(belief, filters.MeasurementModel(see, filters.Diagonal(variance)), z)
    spoilt, z, variance = spoil(kind, belief, z, variance)
    update = bayes.update(spoilt, filters.MeasurementModel(see, filters.Diagonal(variance)), z)
    others = torch.arange(count) != BAD
    assert bool(good.healthy.all())
    assert torch.equal(update.healthy, others)
    # Not bitwise: LAPACK looks for semidefinite matrices as soon as one is not definite.
    assert_same_belief(update.belief[others], good.belief[others], 1e-12)
    assert_close(update.log_likelihood[others], good.log_likelihood[others], 1e-12)
    held = update.belief[BAD]
    torch.testing.assert_close(held.mean, spoilt.mean[BAD], equal_nan=True)
    if form != "qr":
        torch.testing.assert_close(held.covariance, spoilt.covariance[BAD], equal_nan=True)
    if kind in ("mean", "covariance", "indefinite"):
        motion = bent_motion(3)
        before, after = bayes.predict(belief, motion), bayes.predict(spoilt, motion)
        assert torch.equal(after.healthy, others)
        assert_same_belief(after.belief[others], before.belief[others], 1e-12)


@pytest.mark.parametrize("size", [3, 10])
@pytest.mark.parametrize("count", [5, 200])
def test_jitter_mends_a_slightly_indefinite_covariance(count, size):
    """The mended element goes on as one whose covariance is the nearest definite one, and is flagged."""
    belief, z = beliefs(count, size), random_numbers(count, 2, seed=4)
    P = belief.covariance.clone()
    P[2] = with_negative_eigenvalue(P[2], 1e-5)
    bayes = filters.UnscentedKalmanFilter(on_failure="jitter")
    measurement = bent_measurement(size, 2)
    update = bayes.update(filters.Gaussian(belief.mean, P), measurement, z)
    nearest = P[2] + 1e-5 * torch.linalg.matrix_norm(P[2], 2) * torch.eye(size, dtype=torch.float64)
    expected = bayes.update(filters.Gaussian(belief.mean[2], nearest), measurement, z[2])
    assert not bool(update.healthy[2])
    assert int(update.healthy.sum()) == count - 1
    assert_same_belief(update.belief[2], expected.belief, 1e-2)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    ("count", "size"),
    [(1, 4), (1, 10), (200, 4)],
)
def test_indefinite_matrices_are_not_taken_for_semidefinite(count, size, dtype):
    """Far beyond round-off: a tenth of the root of epsilon, relative to the largest eigenvalue."""
    share = 0.1 * torch.finfo(dtype).eps ** 0.5
    P = with_negative_eigenvalue(covariances(size), share).to(dtype)
    _, healthy = cholesky(P.expand(count, size, size))
    assert healthy is not None
    assert not bool(healthy.any())


@pytest.mark.parametrize("count", [1, 200], ids=["LAPACK", "unrolled"])
def test_strong_correlation_is_not_taken_for_a_copy(count):
    """In float32, two states that differ by 4 per mille of their own spread."""
    P = torch.tensor([[1.0, 0.99999], [0.99999, 1.0]]).expand(count, 2, 2)
    factor, _ = cholesky(P)
    assert_close(factor[..., 1, 1], torch.full((count,), (1 - 0.99999**2) ** 0.5), 1e-4)


def test_error_names_stage_element_matrix_and_smallest_eigenvalue():
    belief = beliefs(4, 5, 3)
    P = belief.covariance.clone()
    P[2, 3] = torch.diag(tensor(1.0, -2.5, 1.0))
    bad = filters.Gaussian(belief.mean, P)
    for stage in ("predict", "update"):
        step = {"predict": (bent_motion(3),), "update": (bent_measurement(3, 2), random_numbers(4, 5, 2))}[stage]
        with pytest.raises(
            filters.FilterError, match=rf"{stage}.*\(2, 3\).*1 of 20.*prior covariance.*eigenvalue -2\.5"
        ):
            getattr(filters.UnscentedKalmanFilter(), stage)(bad, *step)
    measurement = bent_measurement(3, 2, -5.0 * torch.eye(2, dtype=torch.float64))
    with pytest.raises(filters.FilterError, match=r"update.*the filter.*measurement noise.*eigenvalue -"):
        filters.UnscentedKalmanFilter(form="dense").update(belief[0, 0], measurement, random_numbers(2))


def test_error_of_a_sequence_begins_with_the_step():
    values = random_numbers(6, 3, 2)
    values[4, 1, 0] = torch.inf
    with pytest.raises(filters.FilterError, match=r"^step 4 of 6: update failed.*\(1,\).*1 of 3"):
        filters.UnscentedKalmanFilter().filter(beliefs(3, 3), bent_motion(3), bent_measurement(3, 2), values)


def test_held_element_goes_on_after_a_bad_step():
    values, prior = random_numbers(6, 3, 2), beliefs(3, 3)
    broken, missing = values.clone(), values.clone()
    broken[2, 1, 0] = torch.inf
    missing[2, 1] = torch.nan
    bayes = filters.UnscentedKalmanFilter(on_failure="hold")
    found = bayes.filter(prior, bent_motion(3), bent_measurement(3, 2), broken)
    expected = bayes.filter(prior, bent_motion(3), bent_measurement(3, 2), missing)
    assert_same_belief(found.filtered, expected.filtered, 1e-12)
    assert found.healthy.sum() == 17
    assert not bool(found.healthy[2, 1])


@pytest.mark.parametrize("form", ["dense", "qr"])
def test_error_of_an_unbatched_prior_with_batched_noise_is_a_filter_error(form):
    variance = torch.ones(3, 2, dtype=torch.float64)
    variance[1, 0] = torch.nan
    measurement = bent_measurement(3, 2, filters.Diagonal(variance))
    with pytest.raises(filters.FilterError, match=r"\(1,\)"):
        filters.UnscentedKalmanFilter(form=form).update(beliefs(3), measurement, random_numbers(2))


@pytest.mark.parametrize("kind", ["kf", "ukf"])
@pytest.mark.parametrize("form", FORMS)
def test_component_without_noise_is_never_dropped_silently(form, kind):
    """It is either fused as exact, or the element is flagged."""
    prior, z, noise = beliefs(3), tensor(0.3, -0.2), filters.Diagonal(tensor(0.0, 1.0))
    if kind == "kf":
        measurement = filters.LinearMeasurement(torch.eye(3, dtype=torch.float64)[:2], noise)
        update = filters.KalmanFilter(form=form, on_failure="hold").update(prior, measurement, z)
    else:
        measurement = filters.MeasurementModel(lambda x: x[..., :2], noise)
        update = filters.UnscentedKalmanFilter(form=form, on_failure="hold").update(prior, measurement, z)
    assert not bool(update.healthy) or abs(float(update.belief.mean[0] - z[0])) < 1e-9


@pytest.mark.parametrize("form", ["low-rank", "qr"])
def test_indefinite_block_of_noise_is_flagged(form):
    """Unless the sum with the spread of the state is definite, which is all that the dense form asks."""
    blocks = torch.stack([torch.eye(2), -1e3 * torch.eye(2)]).double()
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure="hold")
    measurement = bent_measurement(3, 4, filters.BlockDiagonal(blocks))
    update = bayes.update(beliefs(3), measurement, random_numbers(4))
    assert not bool(update.healthy)
    assert_same_belief(update.belief, beliefs(3), 1e-12)


def known_and_copied(batch: int, by_root: bool) -> tuple[filters.Gaussian, Tensor]:
    """States a, b, a copy of both, and a known one, (batch, 5); and the matrix that makes it of a, b."""
    spread = torch.zeros(5, 2, dtype=torch.float64)
    spread[0, 0] = spread[1, 1] = spread[2, 0] = spread[3, 1] = 1.0
    P, mean = covariances(batch, 2, seed=3), random_numbers(batch, 2, seed=4) @ spread.mT
    if by_root:
        return filters.Gaussian(mean, factor=spread @ torch.linalg.cholesky(P)), spread
    return filters.Gaussian(mean, spread @ P @ spread.mT), spread


@pytest.mark.parametrize("iterations", [1, 3])
@pytest.mark.parametrize("kind", ["ekf", "ukf"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("by_root", [False, True])
@pytest.mark.parametrize("batch", [3, 200])
def test_copies_and_known_states_update_as_the_states_they_stand_for(batch, by_root, form, kind, iterations):
    belief, spread = known_and_copied(batch, by_root)
    full = bent_measurement(5, 3)
    reduced = filters.MeasurementModel(lambda x: full.function(x @ spread.mT), full.noise)
    z, P = random_numbers(batch, 3, seed=6), belief.covariance[..., :2, :2]
    bayes = again = filters.ExtendedKalmanFilter(form=form, iterations=iterations)
    if kind == "ukf":
        # Three of the five pairs of points are at the centre, which the set of two states gives the same weight.
        bayes = filters.UnscentedKalmanFilter(form=form, iterations=iterations)
        again = filters.UnscentedKalmanFilter(points=filters.julier(3.0), form=form, iterations=iterations)
    update = bayes.update(belief, full, z)
    expected = again.update(filters.Gaussian(belief.mean[..., :2], P), reduced, z).belief
    lifted = filters.Gaussian(expected.mean @ spread.mT, spread @ expected.covariance @ spread.mT)
    assert_same_belief(update.belief, lifted, 1e-7)
    assert bool(update.healthy.all())
    found = update.belief
    assert_close(found.mean[..., 2:4], found.mean[..., :2], 1e-7)
    assert_close(found.mean[..., 4], torch.zeros(batch, dtype=torch.float64), 1e-12)
    assert_close(found.covariance[..., 4, :], torch.zeros(batch, 5, dtype=torch.float64), 1e-12)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("batch", [3, 200])
def test_no_process_noise_keeps_what_is_known(batch, form):
    belief, _ = known_and_copied(batch, False)
    bayes = filters.UnscentedKalmanFilter(form=form)
    still = filters.MotionModel(lambda x: x, filters.Diagonal(torch.zeros(5, dtype=torch.float64)))
    measurement = filters.LinearMeasurement(random_numbers(3, 5), covariances(3))
    exact, values = belief, random_numbers(5, batch, 3)
    for z in values:
        predicted = bayes.predict(belief, still)
        belief = bayes.update(predicted.belief, measurement, z).belief
        exact = (
            filters.KalmanFilter(form="dense")
            .predict(
                exact, filters.LinearMotion(torch.eye(5, dtype=torch.float64), torch.zeros(5, 5, dtype=torch.float64))
            )
            .belief
        )
        exact = filters.KalmanFilter(form="dense").update(exact, measurement, z).belief
        assert bool(predicted.healthy.all())
    assert_same_belief(belief, exact, 1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_prior_without_any_uncertainty_stays(form):
    belief = filters.Gaussian(random_numbers(2, 3), torch.zeros(2, 3, 3, dtype=torch.float64))
    update = filters.UnscentedKalmanFilter(form=form).update(belief, bent_measurement(3, 4), random_numbers(2, 4))
    assert_same_belief(update.belief, belief, 1e-15)
    moved = filters.UnscentedKalmanFilter(form=form).predict(belief, bent_motion(3))
    assert_close(moved.belief.covariance, bent_motion(3).noise.expand(2, 3, 3), 1e-14)


def test_points_behind_the_camera_are_the_models_to_guard():
    """A prior so wide that some sigma points have the landmark behind them.

    With the depth clamped in the function the update is finite, positive definite and healthy. The filter itself knows
    nothing of depths: it takes points at negative depth at their word, and flags only what is not finite.
    """
    landmark = tensor(0.2, 2.0)

    def seen(x: Tensor, nearest: float) -> Tensor:
        depth = landmark[1] - x[..., 1]
        depth = depth.clamp_min(nearest) if nearest > 0 else depth
        across = landmark[0] - x[..., 0]
        return torch.stack([500 * across / depth, 500 * (across - 0.1) / depth], dim=-1)

    prior = filters.Gaussian(torch.zeros(2, dtype=torch.float64), torch.diag(tensor(1.0, 9.0)))
    assert float(prior.mean[1] + 3.0 * 2**0.5) > float(landmark[1])
    z = seen(tensor(0.1, 0.3), 0.1)
    for form in FORMS:
        bayes = filters.UnscentedKalmanFilter(form=form, iterations=3)
        update = bayes.update(
            prior, filters.MeasurementModel(lambda x: seen(x, 0.1), filters.Diagonal(tensor(1.0, 1.0))), z
        )
        assert bool(update.healthy)
        assert bool(update.belief.mean.isfinite().all())
        assert float(torch.linalg.eigvalsh(update.belief.covariance)[0]) > 0
        # A depth of exactly zero is infinite, which is flagged.
        touching = filters.Gaussian(tensor(0.0, 2.0), prior.covariance)
        ekf = filters.ExtendedKalmanFilter(form=form, on_failure="hold")
        flagged = ekf.update(
            touching, filters.MeasurementModel(lambda x: seen(x, 0.0), filters.Diagonal(tensor(1.0, 1.0))), z
        )
        assert not bool(flagged.healthy)
        assert_same_belief(flagged.belief, touching, 1e-15)


def test_policies_do_not_matter_where_nothing_fails():
    prior, measurement, z = beliefs(4, 3), bent_measurement(3, 2), random_numbers(4, 2)
    updates = [
        filters.UnscentedKalmanFilter(on_failure=p).update(prior, measurement, z) for p in ("raise", "hold", "jitter")
    ]
    for update in updates[1:]:
        assert_same_update(update, updates[0], 0.0)
