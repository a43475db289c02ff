import math

import pytest
import torch
from torch import Tensor

from sigmaslam_filters.manifolds.se3_matrices import adjoint_se3, exp_se3, invert_se3, log_se3
from sigmaslam_models.estimator.pose_prediction import POSE, STATE_SIZE, TWIST, Predict
from tests.support.filter_builders import random_numbers, tensor

NO_NOISE = torch.zeros(2, dtype=torch.float64)
State = tuple[Tensor, Tensor, Tensor]


def some_state(sigma: float = 1e-3, seed: int = 0) -> State:
    """Pose, twist and covariance of a moving camera, everything correlated with everything."""
    root = sigma * random_numbers(STATE_SIZE, STATE_SIZE, seed=seed)
    return exp_se3(0.5 * random_numbers(6, seed=seed + 1)), random_numbers(6, seed=seed + 3), root @ root.T


def predict(state: State, step: float, densities: Tensor) -> State:
    pose, covariance = Predict()(*state, torch.tensor(step, dtype=torch.float64), densities)
    return pose, state[1], covariance


def constant_velocity(state: State, step: float, densities: Tensor) -> Tensor:
    """Covariance in closed form where nothing turns: the adjoint carries body velocities into the reference."""
    pose, _, covariance = state
    A = adjoint_se3(pose)
    F = torch.eye(STATE_SIZE, dtype=torch.float64)
    F[POSE, TWIST] = step * A
    six = torch.diag(torch.cat([densities[0].expand(3), densities[1].expand(3)]))
    Q = torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64)
    Q[POSE, POSE] = step**3 / 3 * A @ six @ A.T
    Q[POSE, TWIST] = step**2 / 2 * A @ six
    Q[TWIST, POSE] = step**2 / 2 * six @ A.T
    Q[TWIST, TWIST] = step * six
    return F @ covariance @ F.T + Q


def assert_same(found: Tensor, expected: Tensor, share: float) -> None:
    torch.testing.assert_close(found, expected, rtol=0, atol=share * float(expected.abs().max()))


def test_a_known_circle_is_driven_to_its_end():
    """1 m/s forward and a quarter turn a second to the right: after four seconds back, after one a quarter round."""
    twist = tensor(0, 0, 1, 0, math.pi / 2, 0)
    state = (torch.eye(4, dtype=torch.float64), twist, torch.zeros(STATE_SIZE, STATE_SIZE, dtype=torch.float64))
    radius = 2 / math.pi
    pose, _, covariance = predict(state, 1.0, NO_NOISE)
    expected = tensor(0, 0, 1, radius, 0, 1, 0, 0, -1, 0, 0, radius, 0, 0, 0, 1).reshape(4, 4)
    torch.testing.assert_close(pose, expected, rtol=0, atol=1e-15)
    assert (covariance == 0).all()
    for _ in range(4):
        state = predict(state, 1.0, NO_NOISE)
    torch.testing.assert_close(state[0], torch.eye(4, dtype=torch.float64), rtol=0, atol=1e-14)


def test_prediction_at_rest_is_the_constant_velocity_model():
    pose, _, covariance = some_state(sigma=1e-6)
    state = (pose, torch.zeros(6, dtype=torch.float64), covariance)
    densities = tensor(2e-12, 5e-12)
    found = predict(state, 0.25, densities)
    torch.testing.assert_close(found[0], pose, rtol=0, atol=1e-9)
    assert_same(found[2], constant_velocity(state, 0.25, densities), 1e-5)


def test_prediction_without_rotation_is_exact_however_uncertain():
    """Translations commute, so the sigma points meet the linear model exactly."""
    _, _, covariance = some_state(sigma=1.0)
    turning = [*range(3, 6), *range(9, 12)]
    covariance[turning], covariance[:, turning] = 0.0, 0.0
    state = (exp_se3(tensor(1, -2, 3, 0, 0, 0)), tensor(1, 0.5, -2, 0, 0, 0), covariance)
    pose, _, found = predict(state, 0.4, tensor(0.3, 0))
    torch.testing.assert_close(pose, exp_se3(tensor(1.4, -1.8, 2.2, 0, 0, 0)), rtol=0, atol=1e-13)
    assert_same(found, constant_velocity(state, 0.4, tensor(0.3, 0)), 1e-12)


def test_two_half_steps_are_one_whole_step():
    state = some_state(sigma=1e-4)
    densities = tensor(1e-6, 1e-6)
    pose, _, covariance = predict(state, 0.1, densities)
    half = predict(predict(state, 0.05, densities), 0.05, densities)
    torch.testing.assert_close(half[0], pose, rtol=0, atol=1e-7)
    # The noise is exact at rest and of second order in twist times step otherwise.
    assert_same(half[2], covariance, 5e-3)


def test_two_half_steps_without_noise_differ_only_by_the_sigma_points_curvature():
    state = some_state(sigma=1e-5)
    pose, _, covariance = predict(state, 0.2, NO_NOISE)
    half = predict(predict(state, 0.1, NO_NOISE), 0.1, NO_NOISE)
    torch.testing.assert_close(half[0], pose, rtol=0, atol=1e-9)
    assert_same(half[2], covariance, 1e-7)


def test_prediction_commutes_with_a_change_of_reference():
    pose, twist, covariance = some_state(sigma=1e-5)
    W = exp_se3(tensor(3, -2, 5, 1, -0.5, 0.7))
    A = torch.block_diag(adjoint_se3(W), torch.eye(6, dtype=torch.float64))
    densities = tensor(1e-7, 1e-8)
    found = predict((pose, twist, covariance), 0.1, densities)
    moved = predict((W @ pose, twist, A @ covariance @ A.T), 0.1, densities)
    torch.testing.assert_close(moved[0], W @ found[0], rtol=0, atol=1e-7)
    assert_same(moved[2], A @ found[2] @ A.T, 1e-6)


def test_a_pose_that_is_known_exactly_takes_all_its_uncertainty_from_the_twist():
    pose, twist, covariance = some_state(sigma=1e-4)
    covariance[POSE, :], covariance[:, POSE] = 0.0, 0.0
    _, _, found = predict((pose, twist, covariance), 0.1, NO_NOISE)
    torch.testing.assert_close(found[TWIST, TWIST], covariance[TWIST, TWIST], rtol=0, atol=1e-20)
    assert int(torch.linalg.matrix_rank(found, atol=1e-14)) == 6


def test_densities_of_translation_and_rotation_go_where_they_belong():
    state = (torch.eye(4, dtype=torch.float64), torch.zeros(6).double(), torch.zeros(12, 12).double())
    _, _, covariance = predict(state, 3.0, tensor(2.0, 5.0))
    deviations = [2 * 9.0] * 3 + [5 * 9.0] * 3 + [2 * 3.0] * 3 + [5 * 3.0] * 3
    torch.testing.assert_close(covariance.diagonal(), tensor(*deviations), rtol=1e-14, atol=0)
    torch.testing.assert_close(covariance[POSE, TWIST].diagonal(), tensor(*[9.0] * 3, *[22.5] * 3), rtol=1e-14, atol=0)


@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_prediction_agrees_with_monte_carlo(sigma):
    pose, twist, covariance = some_state(sigma=sigma, seed=4)
    count = 100_000
    offsets = random_numbers(count, STATE_SIZE, seed=1) @ torch.linalg.cholesky(covariance).T
    moved = exp_se3(offsets[:, POSE]) @ pose @ exp_se3((twist + offsets[:, TWIST]) * 0.3)
    found, _, spread = predict((pose, twist, covariance), 0.3, NO_NOISE)
    errors = torch.cat([log_se3(moved @ invert_se3(found)), offsets[:, TWIST]], dim=1)
    deviations = spread.diagonal().sqrt()
    assert (errors.mean(dim=0) / deviations).abs().max() < 0.02
    torch.testing.assert_close(
        errors.T.cov() / torch.outer(deviations, deviations),
        spread / torch.outer(deviations, deviations),
        rtol=0,
        atol=0.03 if sigma < 0.05 else 0.1,
    )
