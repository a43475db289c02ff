"""Propagation of uncertainty against known answers and Monte Carlo; the error of depth grows with its square (9.36)."""

import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.uncertainty import propagate

CAMERA = RectifiedStereo(500.0, 480.0, 320.0, 240.0, 0.12, 640, 480)


def test_a_linear_function_is_propagated_exactly():
    rng = np.random.default_rng(0)
    A, root = rng.standard_normal((3, 4)), rng.standard_normal((5, 4, 4))
    mean, covariance = rng.standard_normal((5, 4)), root @ root.transpose(0, 2, 1)
    for order in (1, 2):
        found, spread = propagate(lambda x: x @ A.T, mean, covariance, order)
        np.testing.assert_allclose(found, mean @ A.T, atol=1e-8)
        np.testing.assert_allclose(spread, A @ covariance @ A.T, rtol=1e-6, atol=1e-8)


def test_the_second_order_of_a_quadratic_is_exact():
    # Of x^2 and x y, correlated: E x^2 = m^2 + p, var x^2 = 4 m^2 p + 2 p^2, ...
    (m, n), P = (1.3, -0.4), np.array([[0.5, 0.2], [0.2, 0.8]])
    found, spread = propagate(
        lambda x: np.stack([x[..., 0] ** 2, x[..., 0] * x[..., 1]], -1), np.array([m, n]), P, order=2
    )
    np.testing.assert_allclose(found, [m * m + P[0, 0], m * n + P[0, 1]], rtol=1e-8)
    expected = [
        [4 * m * m * P[0, 0] + 2 * P[0, 0] ** 2, 2 * m * (n * P[0, 0] + m * P[0, 1]) + 2 * P[0, 0] * P[0, 1]],
        [0.0, n * n * P[0, 0] + m * m * P[1, 1] + 2 * m * n * P[0, 1] + P[0, 0] * P[1, 1] + P[0, 1] ** 2],
    ]
    expected[1][0] = expected[0][1]
    np.testing.assert_allclose(spread, expected, rtol=1e-6)


def test_a_covariance_may_be_singular():
    found, spread = propagate(np.sin, np.array([0.1, 0.2]), np.diag([0.04, 0.0]))
    np.testing.assert_allclose(found, np.sin([0.1, 0.2]))
    np.testing.assert_allclose(spread, np.diag([0.04 * np.cos(0.1) ** 2, 0.0]), rtol=1e-6, atol=1e-15)


def test_a_stereo_point_agrees_with_monte_carlo_to_second_order():
    # A fifth of a disparity of error: the first order misses the bias of the depth, the second does not.
    mean, sigma = np.array([400.0, 300.0, 5.0]), np.array([0.5, 0.5, 0.6])
    draws = mean + sigma * np.random.default_rng(1).standard_normal((400_000, 3))
    points = CAMERA.triangulate(draws)
    first, first_spread = propagate(CAMERA.triangulate, mean, np.diag(sigma**2))
    second, second_spread = propagate(CAMERA.triangulate, mean, np.diag(sigma**2), order=2)
    bias, error = points.mean(axis=0) - first, points.std(axis=0) / np.sqrt(len(points))
    assert abs(bias[2]) > 20.0 * error[2]
    assert np.all(np.abs(second - points.mean(axis=0)) < 0.1 * np.abs(bias) + 4.0 * error)
    true = np.cov(points.T)
    # Products of the first and third derivatives are of the same order, and are in neither.
    assert np.linalg.norm(second_spread - true) < 0.85 * np.linalg.norm(first_spread - true)


def test_the_error_of_depth_grows_with_its_square():
    depth = np.geomspace(0.5, 50.0, 30)
    uvd = np.column_stack([np.full(30, 320.0), np.full(30, 240.0), CAMERA.focal_baseline / depth])
    for sigma in (0.1, 0.4):
        _, spread = propagate(CAMERA.triangulate, uvd, np.diag([0.3, 0.3, sigma]) ** 2)
        sigma_z = np.sqrt(spread[:, 2, 2])
        np.testing.assert_allclose(sigma_z, depth**2 / CAMERA.focal_baseline * sigma, rtol=1e-4)
        assert np.polyfit(np.log(depth), np.log(sigma_z), 1)[0] == pytest.approx(2.0, abs=1e-3)
