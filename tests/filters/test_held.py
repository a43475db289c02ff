"""An element that is held keeps its belief, and does no harm to sums, gradients and smoothing."""

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.solve import FORMS
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, covariances, random_numbers, tensor

DRIFT = filters.MotionModel(lambda x, u: torch.sin(x) + u, covariances(2, seed=5, scale=0.1))
PUSH = filters.LinearMotion(
    torch.eye(2, dtype=torch.float64), covariances(2, seed=5, scale=0.1), torch.eye(2, dtype=torch.float64)
)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("motion", [DRIFT, PUSH], ids=["function", "linear"])
def test_a_held_prediction_is_smoothed_as_a_state_that_stood_still(motion, form):
    """The other elements are smoothed as if it were not there."""
    values, controls = random_numbers(6, 3, 2), 0.1 * random_numbers(5, 3, 2, seed=1)
    spoilt = controls.clone()
    spoilt[2, 1] = torch.nan
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure="hold")
    see = bent_measurement(2, 2)
    good = bayes.smooth(bayes.filter(beliefs(3, 2), motion, see, values, (controls,)))
    track = bayes.filter(beliefs(3, 2), motion, see, values, (spoilt,))
    found = bayes.smooth(track)
    assert (~track.healthy).nonzero().tolist() == [[3, 1]]
    others = torch.tensor([0, 2])
    assert_same_belief(found[:, others], good[:, others], 1e-12)
    assert_same_belief(found[2, 1], found[3, 1], 1e-12)
    assert bool(found.mean.isfinite().all())
    assert bool((torch.linalg.eigvalsh(found.covariance) > 0).all())


@pytest.mark.parametrize("policy", ["hold", "raise"])
@pytest.mark.parametrize("kind", ["diagonal", "dense"])
@pytest.mark.parametrize("form", FORMS)
def test_a_negative_variance_is_never_healthy(form, kind, policy):
    """Whether the sum with the spread of the state is positive or not."""
    variance = tensor(-0.5, 1.0)
    noise = filters.Diagonal(variance) if kind == "diagonal" else torch.diag(variance)
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure=policy)
    prior = filters.Gaussian(tensor(0.0, 0.0), torch.eye(2, dtype=torch.float64))
    steps = (
        lambda: bayes.update(prior, filters.MeasurementModel(lambda x: x, noise), tensor(1.0, 1.0)),
        lambda: bayes.predict(prior, filters.MotionModel(lambda x: x, noise)),
        lambda: bayes.predict(prior, filters.LinearMotion(torch.eye(2, dtype=torch.float64), noise)),
    )
    for step in steps:
        if policy == "raise":
            with pytest.raises(filters.FilterError, match=r"noise of the first has the smallest eigenvalue -0\.5"):
                step()
        else:
            held = step()
            assert not bool(held.healthy)
            assert_same_belief(held.belief, prior, 1e-15)


def test_an_indefinite_noise_that_makes_a_variance_negative_is_never_healthy():
    """Its diagonal is positive, and so is the innovation covariance."""
    noise = torch.tensor([[0.5, 1.2], [1.2, 0.5]], dtype=torch.float64)
    prior = filters.Gaussian(tensor(0.0, 0.0), torch.eye(2, dtype=torch.float64))
    update = filters.KalmanFilter(on_failure="hold").update(
        prior, filters.LinearMeasurement(torch.eye(2, dtype=torch.float64), noise), tensor(1.0, 1.0)
    )
    assert not bool(update.healthy)


@pytest.mark.parametrize("count", [1, 200])
@pytest.mark.parametrize("form", FORMS)
def test_a_held_measurement_has_no_likelihood_and_finite_derivatives(form, count):
    values = random_numbers(count + 1, 2)
    spoilt = values.clone()
    spoilt[0, 0] = torch.inf
    prior, noise = beliefs(count + 1, 3), tensor(0.3, 0.2)

    def likelihood(variance: Tensor, given: Tensor, first: int) -> Tensor:
        bayes = filters.UnscentedKalmanFilter(form=form, on_failure="hold")
        see = bent_measurement(3, 2, filters.Diagonal(variance))
        update = bayes.update(prior[first:], see, given[first:])
        return update.log_likelihood.sum() + update.belief.mean.sum() - prior.mean[0].sum() * (first == 0)

    gradients = []
    for given, first in ((spoilt, 0), (values, 1)):
        variance = noise.clone().requires_grad_()
        total = likelihood(variance, given, first)
        total.backward()
        gradients.append((total.detach(), variance.grad))
    assert_close(gradients[0][0], gradients[1][0], 1e-11)
    assert_close(gradients[0][1], gradients[1][1], 1e-11)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", ["measurement", "prior", "function"])
def test_a_held_element_takes_part_with_nothing(kind, form):
    """Its likelihood, NIS and degrees of freedom are zero."""
    prior, value = beliefs(3, 3), random_numbers(3, 2)
    see = bent_measurement(3, 2)
    if kind == "measurement":
        value[1, 0] = -torch.inf
    elif kind == "prior":
        covariance = prior.covariance.clone()
        covariance[1, 0, 0] = -1.0
        prior = filters.Gaussian(prior.mean, covariance)
    else:
        spoilt = torch.tensor([[0.0], [torch.inf], [0.0]], dtype=torch.float64)
        see = filters.MeasurementModel(lambda x: bent_measurement(3, 2).function(x) + spoilt, see.noise)
    update = filters.UnscentedKalmanFilter(form=form, on_failure="hold").update(prior, see, value)
    assert update.healthy.tolist() == [True, False, True]
    for name in ("log_likelihood", "nis", "count"):
        found = torch.as_tensor(getattr(update, name)).expand(3)
        assert found[1] == 0, name
        assert bool((found[[0, 2]] != 0).all()), name


def test_a_held_element_keeps_a_covariance_that_has_no_root():
    """Beside healthy ones that go on with roots; and it is flagged at every step that follows."""
    covariance = torch.stack([torch.eye(2), torch.diag(torch.tensor([-0.001, 1.0]))]).double()
    prior = filters.Gaussian(random_numbers(2, 2), covariance)
    bayes = filters.UnscentedKalmanFilter(form="qr", on_failure="hold")
    updated = bayes.update(prior, bent_measurement(2, 2), random_numbers(2, 2))
    moved = bayes.predict(updated.belief, filters.MotionModel(lambda x: x, 0.1 * torch.eye(2, dtype=torch.float64)))
    for result in (updated, moved):
        assert result.belief.is_square_root
        assert result.healthy.tolist() == [True, False]
        for held in (result.belief[1], result.belief.expand((4, 2))[3, 1], result.belief.batch_last()[1]):
            assert_same_belief(held, prior[1], 1e-15)
    assert_close(result.belief.to(torch.float32).covariance[1], covariance[1].float(), 1e-9)
