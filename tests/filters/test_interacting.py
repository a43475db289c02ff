"""The interacting multiple model: known answers, a change that it finds, and filterpy."""

import pytest
import torch

import sigmaslam_filters as filters
from tests.support.filter_assertions import assert_close, assert_same_belief
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

EYE = torch.eye(2, dtype=torch.float64)
TRANSITION = torch.tensor([[0.9, 0.1], [0.2, 0.8]], dtype=torch.float64)
SEE = filters.LinearMeasurement(random_numbers(1, 2, seed=3), covariances(1, seed=4))
MOTIONS = [
    filters.LinearMotion(EYE + 0.1 * random_numbers(2, 2, seed=k), covariances(2, seed=k, scale=0.1 + k))
    for k in range(2)
]


@pytest.mark.parametrize("space", [None, filters.SE2()], ids=["R^n", "SE(2)"])
def test_equal_motions_are_one_filter(space):
    ukf = filters.UnscentedKalmanFilter(space)
    size = 2 if space is None else 3
    motion = bent_motion(size)
    imm = filters.InteractingMultipleModels(ukf, [motion, motion], TRANSITION)
    belief, see = beliefs(3, size, scale=0.05), bent_measurement(size, 2)
    mixture = imm.start(belief)
    for value in random_numbers(4, 3, 2, seed=8):
        belief, mixture = ukf.predict(belief, motion).belief, imm.predict(mixture)
        update, mixture = ukf.update(belief, see, value), imm.update(mixture, see, value)
        belief = update.belief
        assert_same_belief(imm.gaussian(mixture), belief, 1e-10)
        assert_close(mixture.log_likelihood, update.log_likelihood, 1e-10)
    # The motions are as probable as the chain alone makes them.
    expected = tensor(0.5, 0.5)
    for _ in range(4):
        expected = expected @ TRANSITION
    assert_close(mixture.probability, expected.expand(3, 2), 1e-10)


def test_it_equals_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    prior = beliefs(1, 2)[0]
    others = []
    for motion in MOTIONS:
        other = kalman.KalmanFilter(2, 1)
        other.x, other.P = prior.mean.numpy()[:, None].copy(), prior.covariance.numpy().copy()
        other.F, other.Q = motion.matrix.numpy(), motion.noise.numpy()
        other.H, other.R = SEE.matrix.numpy(), SEE.noise.numpy()
        others.append(other)
    theirs = kalman.IMMEstimator(others, (0.5, 0.5), TRANSITION.numpy())
    ours = filters.InteractingMultipleModels(filters.KalmanFilter(), MOTIONS, TRANSITION)
    mixture = ours.start(prior)
    for value in random_numbers(8, 1, seed=5):
        theirs.predict()
        theirs.update(value.numpy())
        mixture = ours.update(ours.predict(mixture), SEE, value)
        found = ours.gaussian(mixture)
        assert_close(found.mean, torch.as_tensor(theirs.x[:, 0]), 1e-10)
        assert_close(found.covariance, torch.as_tensor(theirs.P), 1e-10)
        assert_close(mixture.probability, torch.as_tensor(theirs.mu), 1e-10)


def test_a_change_of_motion_is_found():
    """Still, then a walk with a hundred times the noise; one element of the batch stays still."""
    still, walk = (filters.LinearMotion(EYE, variance * EYE) for variance in (1e-4, 1.0))
    see = filters.LinearMeasurement(EYE, 0.01 * EYE)
    stay = torch.tensor([[0.95, 0.05], [0.05, 0.95]], dtype=torch.float64)
    imm = filters.InteractingMultipleModels(filters.KalmanFilter(), [still, walk], stay)
    mixture = imm.start(filters.Gaussian(torch.zeros(2, 2, dtype=torch.float64), EYE))
    moves, noise = random_numbers(40, 2, seed=6), 0.1 * random_numbers(40, 2, 2, seed=7)
    state = torch.zeros(2, 2, dtype=torch.float64)
    walking = []
    for k in range(40):
        state = state + (torch.stack([moves[k], torch.zeros(2)]) if k >= 20 else 0.0)
        mixture = imm.update(imm.predict(mixture), see, state + noise[k])
        walking.append(mixture.probability[:, 1])
    found = torch.stack(walking)
    assert float(found[10:20].mean()) < 0.1
    assert float(found[25:, 0].median()) > 0.9
    assert float(found[25:, 1].mean()) < 0.1


def test_probabilities_that_are_none_are_refused():
    ukf = filters.UnscentedKalmanFilter()
    with pytest.raises(ValueError, match="negative probability"):
        filters.InteractingMultipleModels(ukf, MOTIONS, torch.tensor([[1.1, -0.1], [0.2, 0.8]], dtype=torch.float64))
    imm = filters.InteractingMultipleModels(ukf, MOTIONS, TRANSITION)
    for probability in (tensor(2.0, 2.0), tensor(0.5, 0.3, 0.2)):
        with pytest.raises(ValueError, match="2 probabilities that add up to 1"):
            imm.start(beliefs(3, 2, scale=0.05), probability)


def test_a_transition_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"transition is \(2, 2\), but 1 motions need 1 x 1"):
        filters.InteractingMultipleModels(filters.KalmanFilter(), MOTIONS[:1], TRANSITION)
    with pytest.raises(ValueError, match="rows of the transition must add up to 1"):
        filters.InteractingMultipleModels(filters.KalmanFilter(), MOTIONS, TRANSITION.mT.contiguous())


def test_a_motion_whose_update_failed_is_not_the_one_that_holds():
    """Its log-likelihood of zero is no likelihood; where all failed nothing was learned."""
    ukf = filters.UnscentedKalmanFilter(on_failure="hold")
    imm = filters.InteractingMultipleModels(ukf, [MOTIONS[0]] * 2, TRANSITION)
    near, far = (filters.Gaussian(tensor(x, 0.0), 0.01 * EYE) for x in (4.0, -4.0))
    root = filters.MeasurementModel(lambda x: torch.sqrt(x[..., :1]), tensor([0.01]))
    mixture = imm.update(filters.Mixture([near, far], tensor(0.5, 0.5), tensor(0.0).squeeze()), root, tensor(2.5))
    assert_close(mixture.probability, tensor(1.0, 0.0), 1e-12)
    assert imm.gaussian(mixture).mean[0] > 4.0
    mixture = imm.update(filters.Mixture([far, far], tensor(0.3, 0.7), tensor(0.0).squeeze()), root, tensor(2.5))
    assert_close(mixture.probability, tensor(0.3, 0.7), 1e-12)
