from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.geometry.se3 import se3_exp, se3_inverse
from sigmaslam.slam.point_map import PointMap, merge_maps, window_points
from tests.support.dense_window import CAMERA, DEPTH, NO_WALK, make_window
from tests.support.quantiles import squared_sigmas

SIGMA = np.array([0.3, 0.4, 0.5])
OFFSET = 0.7
WORLD = se3_exp([3.0, -1.0, 2.0, 0.4, -0.8, 0.2])
# Poses and calibration are as good as known: what is left is the landmarks' own uncertainty.
CERTAIN = 1e-8
TIMES = 10.0 + np.arange(100)


def points_in_view(count: int, seed: int = 0) -> np.ndarray:
    """True (u, v, disparity) in the keyframe, without the offset; 2 to 10 m away."""
    rng = np.random.default_rng(seed)
    return np.c_[rng.uniform(50, 590, count), rng.uniform(50, 430, count), 80.0 / rng.uniform(2, 10, count)]


def measure(truth: np.ndarray, T_key_camera: np.ndarray) -> np.ndarray:
    """What a camera at T_key_camera sees, its disparity too large by the offset."""
    T = se3_inverse(T_key_camera)
    seen = CAMERA.triangulate(truth) @ T[:3, :3].T + T[:3, 3]
    return np.asarray(CAMERA.project(seen) + np.array([0.0, 0.0, OFFSET]))


def noise_of(count: int) -> np.ndarray:
    return np.tile(np.diag(SIGMA**2), (count, 1, 1))


def world_points(truth: np.ndarray) -> np.ndarray:
    return np.asarray(CAMERA.triangulate(truth) @ WORLD[:3, :3].T + WORLD[:3, 3])


def window_of(measured: np.ndarray, sigma: np.ndarray = SIGMA, own: float = 0.0) -> KeyframeWindow:
    """One keyframe with landmarks; `own` is the deviation of what a landmark's disparities are all off by."""
    window = make_window(np.ones(3))
    # By now the calibration is known, and the offset is one that its prior allows for.
    known = replace(
        window.posterior,
        calibration=np.eye(CALIBRATION_SIZE)[0] * OFFSET,
        covariance=CERTAIN**2 * window.posterior.covariance,
    )
    window.prior = window.posterior = known
    window.add_keyframe(WORLD, WORLD, CERTAIN**2 * np.eye(6), NO_WALK, DEPTH)
    count = len(measured)
    variance = np.column_stack([np.tile(sigma**2, (count, 1)), np.full(count, max(own, CERTAIN) ** 2)])
    window.add_landmarks(np.arange(count), measured, variance)
    return window


def see(window: KeyframeWindow, T_key_camera: np.ndarray, seen: np.ndarray) -> None:
    """One more keyframe, in a known place, that sees all landmarks."""
    step = se3_inverse(window.posterior.poses[-1]) @ WORLD @ T_key_camera
    window.add_keyframe(WORLD @ T_key_camera, step, CERTAIN**2 * np.eye(6), NO_WALK, DEPTH)
    window.add_views(LandmarkViews(np.arange(len(seen)), seen, noise_of(len(seen)), np.zeros((len(seen), 3, 2))))
    window.landmarks.views = window.landmarks.views + 1


def map_of(window: KeyframeWindow, min_views: int = 1) -> PointMap:
    return window_points(window, TIMES[: len(window)], min_views)


def nees(found: PointMap, truth: np.ndarray) -> np.ndarray:
    return squared_sigmas(found.points - world_points(truth), found.covariances)


def refined_by_views(truth: np.ndarray, views: int, seed: int) -> KeyframeWindow:
    rng = np.random.default_rng(seed)
    count = len(truth)
    window = window_of(measure(truth, np.eye(4)) + SIGMA * rng.standard_normal((count, 3)))
    for _ in range(views):
        T = se3_exp(rng.normal(0, [0.1, 0.1, 0.2, 0.03, 0.03, 0.03]))
        see(window, T, measure(truth, T) + SIGMA * rng.standard_normal((count, 3)))
    window.solve(4)
    return window


def test_refined_landmarks_are_consistent():
    """Chi-square of all points at once; near enough that (9.34) is nearly linear over their noise."""
    truth = points_in_view(400)
    truth[:, 2] += 15.0
    for views in (0, 1, 8):
        values = nees(map_of(refined_by_views(truth, views, seed=views)), truth)
        low, high = chi2.ppf([0.005, 0.995], 3 * 400) / 400
        # Of the views one in a thousand is beyond the gate.
        assert low < values.mean() < high, (views, values.mean())
        assert (values < chi2.ppf(0.95, 3)).mean() == pytest.approx(0.95, abs=0.035)


def test_every_view_shrinks_the_covariance():
    truth = points_in_view(50)
    volumes = [np.linalg.det(map_of(refined_by_views(truth, views, seed=0)).covariances) for views in (0, 1, 3, 7)]
    for before, after in pairwise(volumes):
        assert (after < before).mean() > 0.98


def test_views_from_the_same_place_average():
    truth = points_in_view(30)
    measured = measure(truth, np.eye(4))
    window = window_of(measured)
    once = map_of(window)
    for _ in range(3):
        see(window, np.eye(4), measured)
    window.solve()
    found = map_of(window)
    np.testing.assert_allclose(found.points, once.points, atol=1e-9)
    np.testing.assert_allclose(found.covariances, once.covariances / 4, rtol=1e-4)
    assert (found.observations == 4).all()


def test_what_disparities_have_in_common_does_not_average():
    """A landmark's own error is as large after many views of the same place as after one."""
    truth = points_in_view(30)
    measured = measure(truth, np.eye(4))
    window = window_of(measured, 1e-3 * SIGMA, own=0.5)
    once = map_of(window)
    for _ in range(3):
        see(window, np.eye(4), measured)
    window.solve()
    np.testing.assert_allclose(map_of(window).covariances, once.covariances, rtol=1e-4, atol=1e-9)


def test_exact_views_keep_the_exact_place():
    truth = points_in_view(40)
    window = window_of(measure(truth, np.eye(4)))
    for k in range(4):
        T = se3_exp(np.array([0.1, 0.05, 0.2, 0.02, -0.03, 0.01]) * k)
        see(window, T, measure(truth, T))
    window.solve()
    np.testing.assert_allclose(map_of(window).points, world_points(truth), atol=1e-7)


def test_only_points_that_were_seen_often_enough_enter_the_map():
    window = window_of(measure(points_in_view(10), np.eye(4)))
    window.landmarks.views[[2, 7]] = 3
    found = map_of(window, min_views=3)
    np.testing.assert_array_equal(found.points, map_of(window).points[[2, 7]])
    assert found.observations.tolist() == [3, 3]
    assert found.timestamps.tolist() == [10.0, 10.0]
    np.testing.assert_array_equal(found.pixels, window.landmarks.measured[[2, 7], :2])


def test_map_covariance_agrees_with_monte_carlo():
    """With an error of the disparity that is the landmark's own, which counts as much as that of one view."""
    truth = points_in_view(4)
    rng = np.random.default_rng(1)
    own = 0.1
    found = map_of(window_of(measure(truth, np.eye(4)), 0.2 * SIGMA, own))
    for k in range(4):
        samples = truth[k] + 0.2 * SIGMA * rng.standard_normal((40_000, 3))
        samples[:, 2] += own * rng.standard_normal(40_000)
        expected = np.cov(world_points(samples).T)
        deviations = np.outer(*2 * [np.sqrt(np.diag(expected))])
        np.testing.assert_allclose(found.covariances[k] / deviations, expected / deviations, atol=0.03)


def test_depth_deviation_grows_with_the_square_of_the_depth():
    depth = np.geomspace(1.0, 50.0, 20)
    truth = np.c_[np.full(20, 350.0), np.full(20, 200.0), 80.0 / depth]
    covariances = WORLD[:3, :3].T @ map_of(window_of(measure(truth, np.eye(4)))).covariances @ WORLD[:3, :3]
    np.testing.assert_allclose(np.sqrt(covariances[:, 2, 2]), depth**2 / 80.0 * SIGMA[2], rtol=1e-9)


def test_points_at_infinity_do_not_enter_the_map():
    measured = measure(points_in_view(3), np.eye(4))
    measured[1, 2] = OFFSET + 0.1
    measured[2, 2] = OFFSET - 0.5
    assert len(map_of(window_of(measured)).points) == 1


def test_a_turned_right_camera_is_taken_out_of_the_disparity():
    truth = points_in_view(20)
    window = window_of(truth)
    calibration = np.pad([0.3, 2.0, -1.0], (0, CALIBRATION_SIZE - 3))
    window.posterior = replace(window.posterior, calibration=calibration)
    x, y = (truth[:, 0] - truth[:, 2] - CAMERA.cx) / CAMERA.fx, (truth[:, 1] - CAMERA.cy) / CAMERA.fy
    biased = window_of(truth + np.array([0, 0, 1]) * (0.3 + 2 * x * x - x * y)[:, None])
    biased.posterior = replace(biased.posterior, calibration=calibration)
    # To first order: the bias is taken at the measured disparity.
    np.testing.assert_allclose(biased.as_calibrated(biased.landmarks.measured), truth, atol=0.02)


def test_merged_maps_hold_all_points():
    parts = [map_of(window_of(measure(points_in_view(count, seed=count), np.eye(4)))) for count in (3, 0, 5)]
    merged = merge_maps(parts)
    np.testing.assert_array_equal(merged.points, np.concatenate([parts[0].points, parts[2].points]))
    assert merged.covariances.shape == (8, 3, 3)
    assert merged.observations.shape == (8,)


def test_merging_nothing_gives_an_empty_map():
    empty = merge_maps([])
    assert empty.points.shape == (0, 3)
    assert empty.covariances.shape == (0, 3, 3)
    assert empty.observations.shape == (0,)


def test_a_point_may_lie_on_either_surface_of_its_patch():
    """Disparities off by half their range, along the ray: what the covariance gains, by finite differences."""
    truth = points_in_view(20)
    window = window_of(measure(truth, np.eye(4)))
    smooth = map_of(window).covariances
    window.landmarks.disparity_range = np.linspace(0.0, 8.0, 20)
    gained = map_of(window).covariances - smooth
    nudge = np.array([0.0, 0.0, 1e-5])
    by_disparity = (world_points(truth + nudge) - world_points(truth - nudge)) / 2e-5
    step = 0.5 * window.landmarks.disparity_range[:, None] * by_disparity
    np.testing.assert_allclose(gained, step[:, :, None] * step[:, None, :], atol=1e-6 * np.abs(gained).max())
