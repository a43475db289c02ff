"""What users of other libraries write at first: it works, or one error names the argument and the mend."""

import numpy as np
import pytest
import torch
from scipy.stats import chi2, multivariate_normal

import sigmaslam_filters as filters
from sigmaslam_filters import Event
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

UKF, EKF, KF = filters.UnscentedKalmanFilter(), filters.ExtendedKalmanFilter(), filters.KalmanFilter()
EYE = torch.eye(2, dtype=torch.float64)
SEE = filters.LinearMeasurement(EYE, EYE)
UPPER = torch.tensor([[1.0, 0.9], [0.0, 1.0]], dtype=torch.float64)


def move(x, u):
    return x + u


DRIVE = filters.MotionModel(move, filters.Diagonal(tensor(0.1, 0.1)))


@pytest.mark.parametrize("spelling", ["tensor", "list", "tuple", "names"])
def test_inputs_have_one_spelling_everywhere(spelling):
    prior, values, controls = beliefs(2), random_numbers(4, 2), random_numbers(3, 2, seed=1)
    spell = {
        "tensor": lambda u: u, "list": lambda u: [u], "tuple": lambda u: (u,), "names": lambda u: {"control": u}
    }[spelling]  # fmt: skip
    events = [Event(None, SEE, values[0])]
    events += [Event(DRIVE, SEE, values[k + 1], motion_inputs=spell(controls[k])) for k in range(3)]
    expected = prior
    for k in range(4):
        moved = UKF.predict(expected, DRIVE, controls[k - 1]).belief if k else expected
        expected = UKF.update(moved, SEE, values[k]).belief
    assert_same_belief(UKF.filter(prior, DRIVE, SEE, values, spell(controls)).filtered[-1], expected, 1e-13)
    assert_same_belief(UKF.filter_events(prior, events).filtered[-1], expected, 1e-13)
    example = filters.StepExample(prior, values[0], spell(controls[0]))
    assert list(example.named("motion")) == ["control" if spelling == "names" else "motion_input_0"]


REFUSED = {
    "covariance": (ValueError, "covariance is not symmetric: entry .0, 1. is 0.9, entry .1, 0. is 0",
                   lambda: filters.Gaussian(torch.zeros(2).double(), UPPER)),
    "its transpose, of one element": (ValueError, r"entry .0, 1. of batch element .1,. is 0",
                   lambda: filters.Gaussian(torch.zeros(3, 2).double(), torch.stack([EYE, UPPER.mT, EYE]))),
    "noise": (ValueError, "LinearMeasurement.noise is not symmetric",
              lambda: KF.update(beliefs(2), filters.LinearMeasurement(EYE, UPPER), tensor(0.0, 0.0))),
    "blocks": (ValueError, "BlockDiagonal's blocks is not symmetric", lambda: filters.BlockDiagonal(UPPER[None])),
    "swapped": (TypeError, "event's motion, its first argument, must be a MotionModel.*got a? ?LinearMeasurement",
                lambda: Event(SEE, DRIVE, tensor(0.0, 0.0))),
    "swapped in filter": (TypeError, "must be a MeasurementModel or LinearMeasurement, got MotionModel",
                          lambda: UKF.filter(beliefs(2), bent_measurement(2, 2), bent_motion(2), random_numbers(3, 2))),
    "points by name": (TypeError, "points is 'merwe'.*merwe.alpha",
                       lambda: filters.UnscentedKalmanFilter(points="merwe")),
    "space": (TypeError, "space is 3.*retract", lambda: filters.UnscentedKalmanFilter(3)),
    "class of a space": (TypeError, "the class SE2", lambda: filters.UnscentedKalmanFilter(filters.SE2)),
    "too few inputs": (TypeError, r"MotionModel.function takes \(x, u\), but was given the state and 0 inputs",
                       lambda: UKF.predict(beliefs(2), DRIVE)),
    "too many inputs": (TypeError, "the state and 2 inputs",
                        lambda: EKF.predict(beliefs(2), DRIVE, tensor(1.0, 1.0), tensor(1.0, 1.0))),
    "size of the value": (ValueError, "value has 3 components, but MeasurementModel.function returns 2",
                          lambda: UKF.update(beliefs(2), bent_measurement(2, 2), tensor(0.0, 0.0, 0.0))),
    "infinite value": (filters.FilterError, "measured value of the first has entries that are not finite",
                       lambda: UKF.update(beliefs(2), bent_measurement(2, 2), tensor(0.0, torch.inf))),
    "mean": (filters.FilterError, "prior mean of the first has entries that are not finite",
             lambda: UKF.predict(filters.Gaussian(tensor(0.0, torch.nan), EYE), bent_motion(2))),
    "function": (filters.FilterError, "not finite, unlike prior and noise: look at inputs and at what the model's",
                 lambda: UKF.predict(filters.Gaussian(tensor(0.0, 0.0), EYE), filters.MotionModel(torch.log, EYE))),
    "matrices by time": (ValueError, "step 1 of 4.*list of models, one for each step", lambda: KF.filter(
        beliefs(2), filters.LinearMotion(EYE.expand(3, 2, 2), EYE), SEE, random_numbers(4, 2))),
    "noises by time": (ValueError, "batch of the covariance .3,.*list of models, one for each step", lambda: UKF.filter(
        beliefs(2), filters.MotionModel(lambda x: x, EYE.expand(3, 2, 2)), SEE, random_numbers(4, 2))),
    "masks by time": (ValueError, "step 0 of 4.*list of models, one for each step", lambda: KF.filter(
        beliefs(2), filters.LinearMotion(EYE, EYE), filters.LinearMeasurement(EYE, EYE, torch.ones(4, 2) > 0),
        random_numbers(4, 2))),
    "masks by time of a batch": (ValueError, r"LinearMeasurement.mask \(4,\).*list of models", lambda: KF.filter(
        beliefs(3, 2), filters.LinearMotion(EYE, EYE), filters.LinearMeasurement(EYE, EYE, torch.ones(4, 2) > 0),
        random_numbers(4, 3, 2))),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_one_clear_error(name):
    kind, message, call = REFUSED[name]
    with pytest.raises(kind, match=message):
        call()


@pytest.mark.parametrize("bayes", [UKF, EKF], ids=["ukf", "ekf"])
@pytest.mark.parametrize("batch", [(), (2,), (3,)], ids=str)
@pytest.mark.parametrize(
    ("function", "kind"),
    [
        pytest.param(lambda x: np.asarray(x.detach()), TypeError, id="numpy"),
        pytest.param(lambda x: [x[..., 0], x[..., 1]], TypeError, id="list"),
        pytest.param(lambda x: filters.stack([x[0] + 0.1 * x[1], x[1]]), ValueError, id="x[0]"),
        pytest.param(lambda x: filters.stack([x[2], x[7]]), ValueError, id="x[7]"),
        pytest.param(lambda x: x[..., 0], ValueError, id="without a dimension"),
    ],
)
def test_functions_of_one_state_are_told_how_components_are_read(bayes, batch, function, kind):
    with pytest.raises(kind, match=r"MotionModel.function.*(x\[\.\.\., i\]|torch.as_tensor)"):
        bayes.predict(beliefs(*batch, 2), filters.MotionModel(function, EYE))


def test_models_by_time_are_lists():
    """As events of a model each."""
    values = random_numbers(4, 3, 2)
    motions = [filters.LinearMotion(EYE + 0.1 * k * UPPER, (k + 1) * EYE) for k in range(3)]
    masks = torch.tensor([[True, True], [True, False], [False, False], [True, True]])
    seen = [filters.LinearMeasurement(EYE, EYE, mask) for mask in masks]
    track = KF.filter(beliefs(3, 2), motions, seen, values)
    missing = torch.where(masks[:, None], values, torch.nan)
    events = [Event(motion, SEE, value) for motion, value in zip([None, *motions], missing, strict=True)]
    assert_same_belief(track.filtered, KF.filter_events(beliefs(3, 2), events).filtered, 1e-14)
    assert track.count[:, 0].tolist() == [2, 1, 0, 2]
    with pytest.raises(ValueError, match="3 motions expected, one for each step, got 2"):
        KF.filter(beliefs(3, 2), motions[:2], seen, values)


def test_a_gate_on_a_single_sensor_gates():
    prior, S = filters.Gaussian(tensor(0.0, 0.0), 0.01 * EYE), 1.01
    at = (float(chi2.ppf(0.999, 2)) * S) ** 0.5
    for bayes, see in ((KF, SEE), (UKF, filters.MeasurementModel(lambda x: x, EYE))):
        outside = bayes.update(prior, see, tensor(1.001 * at, 0.0), gate=0.999)
        assert outside.weight.tolist() == [0.0]
        assert outside.count == 0
        assert_same_belief(outside.belief, prior, 1e-15)
        assert float(outside.log_likelihood) == 0.0
        inside = bayes.update(prior, see, tensor(0.999 * at, 0.0), gate=0.999)
        assert_same_belief(inside.belief, bayes.update(prior, see, tensor(0.999 * at, 0.0)).belief, 1e-14)


@pytest.mark.parametrize("by_root", [False, True])
def test_a_belief_is_sampled_marginalised_and_conditioned(by_root):
    """Samples have its moments, and p(a, b) = p(a | b) p(b)."""
    mean, P = random_numbers(4), covariances(4, seed=1)
    belief = filters.Gaussian(mean, factor=torch.linalg.cholesky(P)) if by_root else filters.Gaussian(mean, P)
    drawn = belief.sample(200_000, torch.Generator().manual_seed(0))
    assert_close(drawn.mean(dim=0), mean, 0.01)
    assert_close(drawn.mT.cov(), P, 0.02)
    x = random_numbers(4, seed=2)
    known, others = belief.marginal([3, 1]), belief.conditional([3, 1], x[[3, 1]])
    assert_close(known.covariance, P[[3, 1]][:, [3, 1]], 1e-14)
    assert others.is_square_root == known.is_square_root == by_root
    parts = [(known, x[[3, 1]]), (others, x[[0, 2]])]
    total = sum(multivariate_normal.logpdf(at, part.mean, part.covariance) for part, at in parts)
    assert total == pytest.approx(multivariate_normal.logpdf(x, mean, P), abs=1e-10)
    batch = filters.Gaussian(random_numbers(3, 4), covariances(3, 4))
    alone = batch[1].conditional([0], tensor(1.0))
    assert_same_belief(batch.conditional([0], tensor(1.0))[1], alone, 1e-14)
    with pytest.raises(ValueError, match="2 components are known"):
        batch.conditional([0, 1], tensor(1.0))
    with pytest.raises(ValueError, match="not all different"):
        belief.marginal([1, -3])
    with pytest.raises(ValueError, match="points of a manifold"):
        filters.Gaussian(tensor(0.0, 0.0, 0.0, 1.0), covariances(3)).marginal([0])


def test_samples_on_a_manifold_are_points_of_it():
    space, P = filters.SO3(), 0.1 * covariances(3)
    at = space.retract(tensor(0.0, 0.0, 0.0, 1.0), tensor(1.0, 2.0, -1.0))
    points = filters.Gaussian(at, P).sample(100_000, torch.Generator().manual_seed(0), space)
    assert_close(space.local(at.expand_as(points), points).mT.cov(), P, 1e-3)


def test_a_loop_of_ones_own_makes_a_track():
    motion, see, values = bent_motion(2), bent_measurement(2, 2), random_numbers(5, 3, 2)
    prior = belief = beliefs(3, 2)
    steps = []
    for k, value in enumerate(values):
        moved = UKF.predict(belief, motion) if k else None
        seen = None if k == 2 else UKF.update(belief if moved is None else moved.belief, see, value)
        belief = moved.belief if seen is None else seen.belief
        steps.append((moved, seen))
    track = filters.Track.of(prior, steps)
    values[2] = torch.nan
    expected = UKF.filter(prior, motion, see, values)
    assert_same_belief(track.predicted, expected.predicted, 1e-13)
    assert_same_belief(UKF.smooth(track), UKF.smooth(expected), 1e-12)
    assert_close(track.log_likelihood, expected.log_likelihood, 1e-12)


def test_a_thousand_filters_print_as_one_line():
    see, prior = bent_measurement(2, 2), beliefs(1000, 2)
    result, moved = UKF.update(prior, see, random_numbers(1000, 2)), UKF.predict(prior, bent_motion(2))
    track = UKF.filter(prior, bent_motion(2), see, random_numbers(2, 1000, 2))
    wide = filters.MotionModel(move, covariances(1000, 2))
    mixture = filters.InteractingMultipleModels(UKF, [bent_motion(2)] * 2, 0.5 + 0.0 * EYE).start(prior)
    cloud = filters.ParticleFilter(torch.Generator()).sample(prior, 100)
    event = Event(wide, see, random_numbers(1000, 2))
    for each in (prior, result, moved, track, wide, filters.Diagonal(prior.mean), mixture, cloud, event):
        assert "\n" not in repr(each)
        assert len(repr(each)) < 500
        assert "1000" in repr(each)


def test_a_value_without_a_dimension_is_named():
    see = filters.LinearMeasurement(tensor([[1.0, 0.0]]), tensor([[0.04]]))
    with pytest.raises(ValueError, match=r"the value has no dimension: \(\.\.\., m\) is expected"):
        filters.KalmanFilter().update(beliefs(1, 2)[0], see, torch.tensor(3.0, dtype=torch.float64))
