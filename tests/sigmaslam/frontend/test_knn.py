"""The tree of nearest points against all distances."""

import numpy as np
import pytest

from sigmaslam.frontend.knn import nearest_points


def brute_force(points: np.ndarray, queries: np.ndarray, count: int) -> np.ndarray:
    distance = np.linalg.norm(queries[:, None].astype(np.float64) - points[None].astype(np.float64), axis=2)
    return np.argsort(distance, axis=1)[:, :count]


@pytest.mark.parametrize(("size", "count"), [(1, 1), (7, 7), (500, 1), (500, 13)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nearest_points_equal_brute_force_in_their_order(size: int, count: int, dtype: type):
    rng = np.random.default_rng(0)
    points = rng.uniform((0, 0), (640, 480), (size, 2)).astype(dtype)
    queries = rng.uniform((-50, -50), (700, 500), (300, 2)).astype(dtype)
    found = nearest_points(points, queries, count)
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, brute_force(points, queries, count))


def test_a_point_of_the_set_is_its_own_nearest():
    points = np.random.default_rng(1).uniform(0, 100, (400, 2)).astype(np.float32)
    np.testing.assert_array_equal(nearest_points(points, points, 3)[:, 0], np.arange(400))


def test_points_that_coincide_are_all_found():
    points = np.repeat(np.array([[10.0, 10.0], [50.0, 50.0]], np.float32), 30, axis=0)
    found = nearest_points(points, points[:1], 30)[0]
    assert sorted(found.tolist()) == list(range(30))


def test_every_other_column_of_an_array_is_taken():
    """Of memory that is not contiguous."""
    wide = np.random.default_rng(2).uniform(0, 100, (200, 4)).astype(np.float32)
    found = nearest_points(wide[:, ::2], wide[:50, 1::2], 5)
    np.testing.assert_array_equal(found, brute_force(wide[:, ::2], wide[:50, 1::2], 5))


@pytest.mark.parametrize("count", [1, 5])
def test_no_queries_have_no_neighbours(count: int):
    found = nearest_points(np.zeros((20, 2), np.float32), np.zeros((0, 2), np.float32), count)
    assert found.shape == (0, count)
    assert found.dtype == np.int64
