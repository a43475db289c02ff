"""Absolute orientation: exact, weighted, with a scale, never a reflection, and a covariance that holds."""

import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp, rotation_log
from sigmaslam.two_view.absolute_orientation import absolute_orientation

R, T = rotation_exp(np.array([0.3, 2.0, -1.0])), np.array([1.0, -5.0, 2.0])


@pytest.mark.parametrize("scale", [1.0, 0.2, 7.0])
@pytest.mark.parametrize("count", [3, 30])
def test_it_is_exact_and_never_a_reflection(scale: float, count: int):
    source = np.random.default_rng(1).normal(size=(count, 3))
    found = absolute_orientation(source, scale * source @ R.T + T, with_scale=scale != 1.0)
    np.testing.assert_allclose(found.R, R, atol=1e-12)
    np.testing.assert_allclose(found.translation, T, atol=1e-12)
    assert found.scale == pytest.approx(scale, rel=1e-12)
    np.testing.assert_allclose(found.apply(source), scale * source @ R.T + T, atol=1e-11)
    assert np.linalg.det(absolute_orientation(source, source * [1, 1, -1]).R) == pytest.approx(1.0)


def test_of_one_place_it_is_a_shift_of_unknown_turn():
    found = absolute_orientation(np.zeros((5, 3)), np.ones((5, 3)))
    np.testing.assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(found.translation, 1.0)
    assert np.isinf(found.covariance).all()


def test_points_of_no_weight_do_not_count_and_weights_do():
    rng = np.random.default_rng(2)
    source = rng.normal(size=(40, 3))
    sigma = np.where(np.arange(40) < 20, 0.01, 1.0)
    target = source @ R.T + T + sigma[:, None] * rng.standard_normal((40, 3))
    weighted = absolute_orientation(source, target, sigma**-2.0)
    alone = absolute_orientation(source[:20], target[:20])
    none = absolute_orientation(source, target, (np.arange(40) < 20).astype(float))
    np.testing.assert_allclose(none.R, alone.R, atol=1e-12)
    error = [np.linalg.norm(rotation_log(each.R @ R.T)) for each in (weighted, absolute_orientation(source, target))]
    assert error[0] < 0.1 * error[1]


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("told", [True, False])
def test_errors_are_as_the_covariance_says(with_scale: bool, told: bool):
    squared, size = [], 7 if with_scale else 6
    for seed in range(300):
        rng = np.random.default_rng(seed)
        source, weight = rng.normal(size=(25, 3)) * [3.0, 1.0, 0.3], rng.uniform(0.5, 4.0, 25)
        noise = 0.05 / np.sqrt(weight)[:, None] * rng.standard_normal((25, 3))
        target = 1.4**with_scale * source @ R.T + T + noise
        found = absolute_orientation(source, target, weight, with_scale, 0.05 if told else None)
        centroid = weight @ source / weight.sum()
        error = np.r_[
            1.4**with_scale * R @ centroid + T - found.apply(centroid),
            rotation_log(R @ found.R.T),
            np.log(1.4 / found.scale) if with_scale else [],
        ]
        squared.append(error @ np.linalg.solve(found.covariance, error))
    mean = np.mean(squared) / size
    spread = np.sqrt(2.0 / size / 300)
    assert abs(mean - 1.0) < 4.0 * spread + (0.0 if told else 0.08)


@pytest.mark.parametrize(
    ("source", "target", "weight"),
    [
        (np.zeros((4, 3)), np.zeros((3, 3)), None),
        (np.zeros((4, 2)), np.zeros((4, 2)), None),
        (np.zeros((4, 3)), np.zeros((4, 3)), -np.ones(4)),
        (np.zeros((4, 3)), np.zeros((4, 3)), np.zeros(4)),
        (np.zeros((4, 3)), np.zeros((4, 3)), np.ones(3)),
    ],
)
def test_wrong_arguments_are_named(source: np.ndarray, target: np.ndarray, weight: np.ndarray | None):
    with pytest.raises(ValueError, match="must"):
        absolute_orientation(source, target, weight)
