from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.camera import RectifiedStereo
from sigmaslam.landmarks import KeyframeLandmarks, PointMap, merge_maps
from sigmaslam.rotation import se3_exp, se3_inverse

CAMERA = RectifiedStereo(fx=400.0, fy=410.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)
SIGMA = np.array([0.3, 0.4, 0.5])
OFFSET = 0.7
WORLD = se3_exp([3.0, -1.0, 2.0, 0.4, -0.8, 0.2])


def points_in_view(count: int, seed: int = 0) -> np.ndarray:
    """True (u, v, disparity) in the keyframe, without the offset; 2 to 10 m away."""
    rng = np.random.default_rng(seed)
    return np.c_[rng.uniform(50, 590, count), rng.uniform(50, 430, count), 80.0 / rng.uniform(2, 10, count)]


def measure(truth: np.ndarray, T_key_camera: np.ndarray, offset: float = OFFSET) -> np.ndarray:
    """What a camera at T_key_camera sees, its disparity too large by the offset."""
    T = se3_inverse(T_key_camera)
    seen = CAMERA.triangulate(truth) @ T[:3, :3].T + T[:3, 3]
    return np.asarray(CAMERA.project(seen) + np.array([0.0, 0.0, offset]))


def landmarks_of(measured: np.ndarray, sigma: np.ndarray = SIGMA) -> KeyframeLandmarks:
    return KeyframeLandmarks(np.arange(len(measured)), measured, np.tile(sigma, (len(measured), 1)))


def noise_of(count: int) -> np.ndarray:
    return np.tile(np.diag(SIGMA**2), (count, 1, 1))


def world_points(truth: np.ndarray) -> np.ndarray:
    return np.asarray(CAMERA.triangulate(truth) @ WORLD[:3, :3].T + WORLD[:3, 3])


def nees(found: PointMap, truth: np.ndarray) -> np.ndarray:
    error = found.points - world_points(truth)
    return np.einsum("ki,ki->k", error, np.linalg.solve(found.covariances, error[..., None])[..., 0])


def refined_by_views(truth: np.ndarray, views: int, seed: int) -> KeyframeLandmarks:
    rng = np.random.default_rng(seed)
    count = len(truth)
    landmarks = landmarks_of(measure(truth, np.eye(4)) + SIGMA * rng.standard_normal((count, 3)))
    for _ in range(views):
        T = se3_exp(rng.normal(0, [0.1, 0.1, 0.2, 0.03, 0.03, 0.03]))
        seen = measure(truth, T) + SIGMA * rng.standard_normal((count, 3))
        landmarks.observe(np.arange(count), seen, noise_of(count), T, CAMERA, OFFSET)
    return landmarks


def test_refined_landmarks_are_consistent():
    """Chi-square of all points at once; near enough that (9.34) is nearly linear over their noise."""
    truth = points_in_view(400)
    truth[:, 2] += 15.0
    for views in (0, 1, 8):
        found = refined_by_views(truth, views, seed=views).to_map(WORLD, CAMERA, OFFSET, 1)
        values = nees(found, truth)
        low, high = chi2.ppf([0.005, 0.995], 3 * 400) / 400
        assert low < values.mean() < high, (views, values.mean())
        assert (values < chi2.ppf(0.95, 3)).mean() == pytest.approx(0.95, abs=0.035)


def test_every_observation_shrinks_the_covariance():
    truth = points_in_view(50)
    volumes = [
        np.linalg.det(refined_by_views(truth, views, seed=0).to_map(WORLD, CAMERA, OFFSET, 1).covariances)
        for views in (0, 1, 4, 16)
    ]
    for before, after in pairwise(volumes):
        assert (after < before).mean() > 0.98


def test_views_from_the_same_place_average():
    truth = points_in_view(30)
    measured = measure(truth, np.eye(4))
    landmarks = landmarks_of(measured)
    for _ in range(3):
        landmarks.observe(np.arange(30), measured, noise_of(30), np.eye(4), CAMERA, OFFSET)
    once = landmarks_of(measured).to_map(WORLD, CAMERA, OFFSET, 1)
    found = landmarks.to_map(WORLD, CAMERA, OFFSET, 1)
    np.testing.assert_allclose(found.points, once.points, atol=1e-9)
    np.testing.assert_allclose(found.covariances, once.covariances / 4, rtol=1e-6)
    assert (found.observations == 4).all()


def test_exact_views_keep_the_exact_place():
    truth = points_in_view(40)
    landmarks = landmarks_of(measure(truth, np.eye(4)))
    for k in range(4):
        T = se3_exp(np.array([0.1, 0.05, 0.2, 0.02, -0.03, 0.01]) * k)
        landmarks.observe(np.arange(40), measure(truth, T), noise_of(40), T, CAMERA, OFFSET)
    found = landmarks.to_map(WORLD, CAMERA, OFFSET, 1)
    np.testing.assert_allclose(found.points, world_points(truth), atol=1e-9)


def test_order_of_the_views_does_not_matter():
    truth = points_in_view(20)
    rng = np.random.default_rng(0)
    poses = [se3_exp(rng.normal(0, 0.05, 6)) for _ in range(3)]
    seen = [measure(truth, T) + rng.normal(0, 0.3, (20, 3)) for T in poses]
    maps = []
    for order in ([0, 1, 2], [2, 0, 1]):
        landmarks = landmarks_of(measure(truth, np.eye(4)))
        for k in order:
            landmarks.observe(np.arange(20), seen[k], noise_of(20), poses[k], CAMERA, OFFSET)
        maps.append(landmarks.to_map(WORLD, CAMERA, OFFSET, 1))
    np.testing.assert_allclose(maps[0].points, maps[1].points, atol=1e-10)
    np.testing.assert_allclose(maps[0].covariances, maps[1].covariances, rtol=1e-9, atol=1e-12)


def test_only_the_rows_that_were_seen_change():
    truth = points_in_view(10)
    measured = measure(truth, np.eye(4))
    landmarks = landmarks_of(measured)
    landmarks.observe(np.array([2, 7]), measured[[2, 7]], noise_of(2), np.eye(4), CAMERA, OFFSET)
    assert np.flatnonzero(landmarks.observations == 2).tolist() == [2, 7]
    assert len(landmarks.to_map(WORLD, CAMERA, OFFSET, 2).points) == 2


def test_the_first_estimate_stays_for_the_tracker():
    landmarks = landmarks_of(measure(points_in_view(5), np.eye(4)))
    before = landmarks.measured.copy()
    landmarks.observe(np.arange(5), before + 1.0, noise_of(5), np.eye(4), CAMERA, OFFSET)
    np.testing.assert_array_equal(landmarks.measured, before)


def test_a_measurement_that_is_no_number_is_left_out():
    truth = points_in_view(3)
    landmarks = landmarks_of(measure(truth, np.eye(4)))
    seen = measure(truth, np.eye(4))
    seen[1] = np.nan
    landmarks.observe(np.arange(3), seen, noise_of(3), np.eye(4), CAMERA, OFFSET)
    assert landmarks.observations.tolist() == [2, 1, 2]
    assert np.isfinite(landmarks.to_map(WORLD, CAMERA, OFFSET, 1).points).all()


def test_a_point_measured_behind_the_keyframe_is_left_out():
    """A camera that looks back sees it in front; the keyframe, which saw it first, had it in front too: a mismatch."""
    truth = points_in_view(1)
    landmarks = landmarks_of(measure(truth, np.eye(4)))
    looking_back = se3_exp([0, 0, 0, 0, np.pi - 0.1, 0])
    seen = np.array([[320.0, 240.0, 20.0 + OFFSET]])
    landmarks.observe(np.arange(1), seen, noise_of(1), looking_back, CAMERA, OFFSET)
    assert landmarks.observations.tolist() == [1]


def test_map_covariance_agrees_with_monte_carlo():
    truth = points_in_view(4)
    rng = np.random.default_rng(1)
    found = landmarks_of(measure(truth, np.eye(4)), 0.2 * SIGMA).to_map(WORLD, CAMERA, OFFSET, 1)
    for k in range(4):
        samples = truth[k] + 0.2 * SIGMA * rng.standard_normal((40_000, 3))
        expected = np.cov(world_points(samples).T)
        deviations = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            found.covariances[k] / np.outer(deviations, deviations),
            expected / np.outer(deviations, deviations),
            atol=0.03,
        )


def test_depth_deviation_grows_with_the_square_of_the_depth():
    depth = np.geomspace(1.0, 50.0, 20)
    truth = np.c_[np.full(20, 350.0), np.full(20, 200.0), 80.0 / depth]
    found = landmarks_of(measure(truth, np.eye(4))).to_map(np.eye(4), CAMERA, OFFSET, 1)
    sigma_Z = np.sqrt(found.covariances[:, 2, 2])
    np.testing.assert_allclose(sigma_Z, depth**2 / 80.0 * SIGMA[2], rtol=1e-9)
    slope = np.polyfit(np.log(depth), np.log(sigma_Z), 1)[0]
    assert slope == pytest.approx(2.0, abs=1e-9)


def test_points_at_infinity_do_not_enter_the_map():
    truth = points_in_view(3)
    measured = measure(truth, np.eye(4))
    measured[1, 2] = OFFSET + 0.1
    measured[2, 2] = OFFSET - 0.5
    assert len(landmarks_of(measured).to_map(WORLD, CAMERA, OFFSET, 1).points) == 1


def test_merged_maps_hold_all_points():
    parts = [
        landmarks_of(measure(points_in_view(count, seed=count), np.eye(4))).to_map(WORLD, CAMERA, OFFSET, 1)
        for count in (3, 0, 5)
    ]
    merged = merge_maps(parts)
    np.testing.assert_array_equal(merged.points, np.concatenate([parts[0].points, parts[2].points]))
    assert merged.covariances.shape == (8, 3, 3)
    assert merged.observations.shape == (8,)


def test_merging_nothing_gives_an_empty_map():
    empty = merge_maps([])
    assert empty.points.shape == (0, 3)
    assert empty.covariances.shape == (0, 3, 3)
    assert empty.observations.shape == (0,)
