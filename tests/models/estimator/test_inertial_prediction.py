import numpy as np
import pytest
import torch

from sigmaslam_filters.manifolds.se3_matrices import exp_se3, invert_se3, log_se3
from sigmaslam_models.estimator.estimator_export import _inertial_example
from sigmaslam_models.estimator.inertial_prediction import (
    BIASES_TO_FACTORS,
    GRAVITY,
    MOUNTING,
    POSE,
    STATE_SIZE,
    VELOCITY,
    InertialPredict,
)
from tests.support.filter_builders import random_numbers


@pytest.mark.long
def test_prediction_agrees_with_monte_carlo():
    """Of the state, and of the noise of the preintegrated motion."""
    example = list(_inertial_example(3))
    example[8], example[9] = 0.3 * example[8], 0.1 * example[9]
    pose, velocity, gravity, mounting, root, seconds, turn, dv, dp, slope, noise, walk = example
    count = 200_000
    covariance = root @ root.T
    offsets = random_numbers(count, STATE_SIZE, seed=1) @ root.T
    error = random_numbers(count, 9, seed=2) @ torch.linalg.cholesky(noise + 1e-18 * torch.eye(9)).T
    change = offsets[:, BIASES_TO_FACTORS] @ slope.T
    mount = exp_se3(offsets[:, MOUNTING]) @ mounting
    body = exp_se3(offsets[:, POSE]) @ pose @ mount
    R, v, g = body[:, :3, :3], velocity + offsets[:, VELOCITY], gravity + offsets[:, GRAVITY]
    zero = torch.zeros(count, 3, dtype=torch.float64)
    turned = exp_se3(torch.cat([zero, change[:, :3]], 1)) @ exp_se3(torch.cat([zero, error[:, :3]], 1))
    after = body.clone()
    after[:, :3, :3] = R @ turn @ turned[:, :3, :3]
    after[:, :3, 3] += (
        v * seconds + 0.5 * g * seconds**2 + torch.einsum("nij,nj->ni", R, dp + change[:, 6:] + error[:, 6:])
    )
    speed = v + g * seconds + torch.einsum("nij,nj->ni", R, dv + change[:, 3:6] + error[:, 3:6])
    found, found_speed, spread, carried = InertialPredict()(*example)
    errors = torch.cat(
        [log_se3(after @ invert_se3(mount) @ invert_se3(found)), speed - found_speed, offsets[:, 9:]], dim=1
    )
    biases = torch.zeros(STATE_SIZE, dtype=torch.float64)
    biases[12:15], biases[15:18] = walk[0] * seconds, walk[1] * seconds
    spread = spread - torch.diag(biases)
    sigma = spread.diagonal().sqrt()
    assert (errors.mean(dim=0).abs() / sigma).max() < 0.02
    scale = torch.outer(sigma, sigma)
    torch.testing.assert_close(errors.T.cov() / scale, spread / scale, rtol=0, atol=0.03)
    cross = (offsets.T @ errors) / count
    scale = torch.outer(covariance.diagonal().sqrt(), sigma)
    torch.testing.assert_close(cross / scale, carried / scale, rtol=0, atol=0.03)


def test_free_fall_without_uncertainty_is_a_parabola():
    example = list(_inertial_example(0))
    eye, zero = torch.eye(4, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    example[0], example[3], example[6] = eye, eye, eye[:3, :3]
    example[1], example[2] = torch.tensor([1.0, 0, 0]).double(), torch.tensor([0, 9.8, 0]).double()
    example[4], example[5] = torch.zeros(43, 43).double(), torch.tensor(0.5).double()
    example[7] = example[8] = zero
    example[10] = torch.zeros(9, 9).double()
    pose, velocity, covariance, _ = InertialPredict()(*example)
    np.testing.assert_allclose(pose[:3, 3], [0.5, 1.225, 0], atol=1e-14)
    np.testing.assert_allclose(velocity, [1, 4.9, 0], atol=1e-14)
    assert not covariance[:12, :12].any()
