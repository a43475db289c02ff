"""Derivatives by hand are those that automatic differentiation finds."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sigmaslam_filters import ExtendedKalmanFilter, Gaussian, several
from sigmaslam_localisation.mapping_robot import MappingRobot
from sigmaslam_localisation.wheeled_robot import SPACE, WheeledRobot

pytestmark = pytest.mark.usefixtures("one_thread")


def some_belief(space, batch, seed):
    generator = np.random.default_rng(seed)
    size = space.tangent_size
    root = 0.1 * generator.normal(size=(batch, size, size)) / np.sqrt(size)
    mean = 0.3 * generator.normal(size=(batch, size))
    return Gaussian(torch.from_numpy(mean), torch.from_numpy(root @ np.swapaxes(root, -1, -2) + 1e-4 * np.eye(size)))


@pytest.mark.parametrize("turn", [0.0, 1e-6, 9.9e-3, 1.01e-2, -0.3, 2.0])
def test_the_motion_s_derivative(turn):
    robot, bayes = WheeledRobot("cartesian", 0.0), ExtendedKalmanFilter(SPACE)
    belief = some_belief(SPACE, 3, 0)
    belief.mean[:, [4, 6]] = 0.0
    path, time = torch.tensor([[0.4, turn]] * 3, dtype=torch.float64), torch.full((3,), 0.2, dtype=torch.float64)
    by_hand = robot.motion(path, time)
    expected, found = (
        bayes.predict(belief, model, path, time[:, None]).belief for model in (replace(by_hand, jacobian=None), by_hand)
    )
    np.testing.assert_allclose(found.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(found.covariance, expected.covariance, atol=1e-10)


@pytest.mark.parametrize("kind", ["range-bearing", "cartesian"])
@pytest.mark.parametrize("mapping", [False, True])
def test_the_sightings_derivative(kind, mapping):
    robot = WheeledRobot(kind, 0.2)
    platform = MappingRobot(robot, 4) if mapping else robot
    space = platform.space if mapping else SPACE
    landmarks = torch.tensor([[[2.0], [0.0]], [[1.0], [3.0]]]).double()
    if not mapping:
        landmarks = torch.tensor([[[2.0, 1.0], [-1.0, 3.0]], [[0.5, -2.0], [1.0, 4.0]]]).double()
    belief, value = some_belief(space, 2, 1), torch.tensor([[2.0, 0.4, 2.5, 1.7]] * 2).double()
    by_hand = several(platform.measurement(), 2)
    expected, found = (
        ExtendedKalmanFilter(space).update(belief, model, value, landmarks)
        for model in (replace(by_hand, jacobian=None), by_hand)
    )
    np.testing.assert_allclose(found.innovation_covariance, expected.innovation_covariance, rtol=1e-9)
    np.testing.assert_allclose(found.belief.mean, expected.belief.mean, atol=1e-9)
    np.testing.assert_allclose(found.belief.covariance, expected.belief.covariance, atol=1e-9)
