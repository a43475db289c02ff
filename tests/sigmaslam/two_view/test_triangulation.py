"""Triangulation: exact without noise, the order of the methods under noise, and covariances that hold."""

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.two_view.triangulation import METHODS, TwoViews, triangulate, triangulate_optimal, triangulate_parallel

K = np.array([[520.0, 0.0, 310.0], [0.0, 500.0, 250.0], [0.0, 0.0, 1.0]])


def views(turn: tuple[float, float, float] = (0.02, -0.3, 0.05), shift: tuple[float, float, float] = (-1.0, 0.1, 0.3)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_exp(np.array(turn)), shift
    return TwoViews(K, np.array([[480.0, 0.0, 330.0], [0.0, 490.0, 230.0], [0.0, 0.0, 1.0]]), T)


def parallel() -> TwoViews:
    T = np.eye(4)
    T[0, 3] = -0.3
    return TwoViews(K, K, T)


def points(count: int, seed: int = 0, far: float = 12.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(3.0, far, count)
    return np.column_stack([rng.uniform(-0.4, 0.4, (count, 2)) * depth[:, None], depth])


@pytest.mark.parametrize("method", METHODS)
def test_every_method_is_exact_without_noise(method: str):
    pair, true = parallel() if method == "parallel" else views(), points(200)
    pixels = pair.project(true)
    assert METHODS[method](pair, pixels) == pytest.approx(true, abs=1e-9)
    # And for any leading dimensions.
    assert METHODS[method](pair, pixels.reshape(4, 50, 4)).shape == (4, 50, 3)


def test_points_fulfil_the_epipolar_constraint():
    pair, true = views(), points(50)
    p = pair.project(true)
    rays0, rays1 = (np.column_stack([p[:, k : k + 2], np.ones(50)]) for k in (0, 2))
    np.testing.assert_allclose(np.einsum("mi,ij,mj->m", rays1, pair.fundamental, rays0), 0.0, atol=1e-9)


def test_the_optimal_point_is_hartley_and_sturm_s():
    # Small baseline and much noise, where the methods differ.
    pair, true = views(shift=(-0.3, 0.05, 0.6)), points(300, far=8.0)
    measured = pair.project(true) + np.random.default_rng(3).normal(0.0, 1.0, (300, 4))
    corrected = cv2.correctMatches(pair.fundamental, measured[None, :, :2], measured[None, :, 2:])
    ideal = np.concatenate([each[0] for each in corrected], axis=1)
    ours = pair.project(triangulate_optimal(pair, measured))
    ahead = np.isfinite(ours).all(axis=1)
    assert ahead.mean() > 0.95
    # The least error is the same; the corrected places are, but for a flat minimum here and there.
    least = np.linalg.norm(ideal - measured, axis=1)
    assert np.linalg.norm(ours - measured, axis=1)[ahead] == pytest.approx(least[ahead], rel=1e-4, abs=1e-6)


def test_reprojection_is_least_for_the_optimal_point():
    pair, true = views(shift=(-0.2, 0.0, 1.0)), points(400, seed=1)
    measured = pair.project(true) + np.random.default_rng(2).normal(0.0, 0.8, (400, 4))

    def reprojection(method: str) -> np.ndarray:
        return ((pair.project(METHODS[method](pair, measured)) - measured) ** 2).sum(axis=1)

    optimal = reprojection("optimal")
    ahead = np.isfinite(optimal)
    assert ahead.mean() > 0.9
    for other in ("midpoint", "linear"):
        assert (optimal <= reprojection(other) + 1e-6)[ahead].all()
        assert optimal[ahead].sum() < reprojection(other)[ahead].sum()


def test_noise_that_differs_moves_the_optimal_point():
    pair, true = views(), points(500)
    sigma = np.array([0.05, 0.05, 1.5, 1.5])
    measured = pair.project(true) + sigma * np.random.default_rng(4).standard_normal((500, 4))
    told = triangulate_optimal(pair, measured, np.tile(np.diag(sigma**2), (500, 1, 1)))
    untold = triangulate_optimal(pair, measured)
    side = np.s_[:, :2]
    # The sharp image says where the point is across its ray.
    error = [np.linalg.norm((each / each[:, 2:] - true / true[:, 2:])[side], axis=1).mean() for each in (told, untold)]
    assert error[0] < 0.2 * error[1]


@pytest.mark.long
@pytest.mark.parametrize("method", METHODS)
def test_the_covariance_is_what_monte_carlo_finds(method: str):
    pair = parallel() if method == "parallel" else views()
    true = points(3, seed=5, far=6.0)
    covariance = np.diag([0.3, 0.4, 0.5, 0.2]) ** 2
    draws = np.random.default_rng(6).multivariate_normal(np.zeros(4), covariance, (20_000, 3))
    cloud = METHODS[method](pair, pair.project(true) + draws)
    if method == "optimal":
        cloud = triangulate_optimal(pair, pair.project(true) + draws, covariance)
    _, spread = triangulate(pair, pair.project(true), covariance, method)
    for k in range(3):
        np.testing.assert_allclose(np.cov(cloud[:, k].T), spread[k], atol=0.06 * np.trace(spread[k]))


def test_parallel_is_refused_where_views_are_not():
    with pytest.raises(ValueError, match="rectified"):
        triangulate_parallel(views(), views().project(points(2)))


def test_an_unknown_method_is_named():
    with pytest.raises(ValueError, match="middle"):
        triangulate(views(), np.zeros((1, 4)), np.eye(4), "middle")


def test_far_and_backward_points():
    pair = parallel()
    far = np.array([[0.1, 0.2, 1.0]]) * 1e6
    assert triangulate_optimal(pair, pair.project(far)) == pytest.approx(far, rel=1e-3)
    behind = pair.project(far) + [0.0, 0.0, 2.0, 0.0]
    assert np.isnan(triangulate_optimal(pair, behind)).all()
