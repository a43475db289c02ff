"""Nearest points against all distances, by the compiled cells and by the tree of OpenCV."""

import numpy as np
import pytest

from sigmaslam.frontend import patch_kernels
from sigmaslam.frontend.knn import nearest_points


@pytest.fixture(params=["compiled", "tree"], autouse=True)
def search(request, monkeypatch):
    """Both ways."""
    if request.param == "tree":
        monkeypatch.setattr(patch_kernels, "_kernels", None)
    else:
        pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")


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


@pytest.mark.parametrize("shape", ["a line", "two heaps far apart", "one place"])
def test_points_that_leave_most_of_their_box_empty_are_found(shape: str):
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 100, (300, 2)).astype(np.float32)
    if shape == "a line":
        points[:, 1] = 7.0
    elif shape == "two heaps far apart":
        points[::2] += 1e5
    else:
        points[:] = 5.0
    queries = np.concatenate([points[:40], rng.uniform(-1e3, 1e3, (40, 2)).astype(np.float32)])
    for query, found in zip(queries, nearest_points(points, queries, 9), strict=True):
        squared = ((points - query) ** 2).sum(axis=1)
        np.testing.assert_array_equal(squared[found], np.sort(squared)[:9])
        assert len(set(found.tolist())) == 9


def test_points_that_are_not_finite_are_refused():
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            kernels.nearest_points(np.full((5, 2), value), np.zeros((1, 2)), 1)
    assert 0 <= kernels.nearest_points(np.zeros((5, 2)), np.full((1, 2), np.nan), 1)[0, 0] < 5
    with pytest.raises(ValueError, match="fewer points"):
        kernels.nearest_points(np.zeros((5, 2)), np.zeros((1, 2)), 6)
