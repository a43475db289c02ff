"""Two motions in one pair of views: which of them is the scene's."""

from functools import partial

import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.two_view.scene_pose import estimate_scene_pose
from sigmaslam.two_view.stereo_pose import RelativePose, estimate_relative_pose

CAMERA = RectifiedStereo(fx=400.0, fy=400.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)
NOISE = 0.2
CAMERA_MOTION = se3_exp([0.05, 0.0, 0.6, 0.0, 0.02, 0.0])
BODY_MOTION = se3_exp([0.03, 0.0, -0.02, 0.0, 0.0, 0.0])
"""Relative to something that drives ahead."""


def points(rng: np.random.Generator, count: int, left: float, right: float, nearest: float, farthest: float):
    """(u, v, disparity) of points in a part of the image, and in an interval of depths."""
    depth = rng.uniform(nearest, farthest, count)
    return np.c_[rng.uniform(left, right, count), rng.uniform(30, 450, count), CAMERA.focal_baseline / depth]


def views(rng: np.random.Generator, landmarks: np.ndarray, T_key_camera: np.ndarray) -> np.ndarray:
    T = se3_inverse(T_key_camera)
    seen = CAMERA.project(CAMERA.triangulate(landmarks) @ T[:3, :3].T + T[:3, 3])
    return seen + rng.normal(0.0, NOISE, seen.shape)


def estimate(function, parts: list[tuple[np.ndarray, np.ndarray]], seed: int = 0) -> RelativePose | None:
    """By matches of parts (points, T_key_camera), all of which are said to be right."""
    rng = np.random.default_rng(seed)
    landmarks = np.concatenate([part for part, _ in parts])
    measurement = np.concatenate([views(rng, *part) for part in parts])
    count = len(landmarks)
    sigma = np.tile([0.1, 0.1, NOISE], (count, 1))
    noise = np.tile(NOISE**2 * np.eye(3), (count, 1, 1))
    return function(CAMERA, landmarks, sigma, measurement, noise, np.ones(count))


def is_pose(found: RelativePose | None, T_key_camera: np.ndarray) -> bool:
    assert found is not None
    return bool(np.linalg.norm(se3_log(se3_inverse(found.T_key_camera) @ T_key_camera)) < 0.03)


@pytest.mark.parametrize("seed", range(5))
def test_most_matches_on_a_bus_ahead_are_not_the_scene(seed):
    rng = np.random.default_rng(seed)
    scene = [points(rng, 50, 10, 200, 4.0, 20.0), points(rng, 70, 400, 630, 4.0, 20.0)]
    parts = [(points(rng, 240, 220, 380, 5.0, 5.5), BODY_MOTION), *((part, CAMERA_MOTION) for part in scene)]
    assert is_pose(estimate(estimate_relative_pose, parts, seed), BODY_MOTION), "the bus must have the majority"
    found = estimate(estimate_scene_pose, parts, seed)
    assert is_pose(found, CAMERA_MOTION)
    assert found.inliers.shape == (360,)
    assert found.inliers[240:].mean() > 0.9
    assert found.inliers[:240].mean() < 0.1


@pytest.mark.parametrize("seed", range(5))
def test_what_stands_behind_is_the_scene_where_both_cover_half_of_the_image(seed):
    rng = np.random.default_rng(seed)
    near, far = points(rng, 160, 10, 330, 4.0, 5.0), points(rng, 120, 310, 630, 6.0, 14.0)
    parts = [(near, BODY_MOTION), (far, CAMERA_MOTION)]
    assert is_pose(estimate(estimate_scene_pose, parts, seed), CAMERA_MOTION)


def test_nobody_knows_where_two_halves_as_far_away_move_apart():
    rng = np.random.default_rng(0)
    left, right = points(rng, 150, 10, 315, 4.0, 8.0), points(rng, 150, 325, 630, 4.0, 8.0)
    assert estimate(estimate_scene_pose, [(left, BODY_MOTION), (right, CAMERA_MOTION)]) is None


@pytest.mark.parametrize("of_body", [150, 400])
def test_a_sensor_of_motion_knows_which_part_moves(of_body):
    def excludes(T_key_camera: np.ndarray) -> bool:
        return bool(np.linalg.norm(se3_log(se3_inverse(CAMERA_MOTION) @ T_key_camera)) > 0.2)

    rng = np.random.default_rng(0)
    left, right = points(rng, of_body, 10, 315, 4.0, 8.0), points(rng, 60, 325, 630, 4.0, 8.0)
    parts = [(left, BODY_MOTION), (right, CAMERA_MOTION)]
    assert is_pose(estimate(partial(estimate_scene_pose, excludes=excludes), parts), CAMERA_MOTION)
    for says in (True, False):
        undecided = estimate(partial(estimate_scene_pose, excludes=lambda pose, says=says: says), parts)
        assert (undecided is None) == (estimate(estimate_scene_pose, parts) is None)


def test_the_greater_part_decides_where_the_other_one_is_small():
    rng = np.random.default_rng(0)
    most, few = points(rng, 150, 10, 520, 4.0, 8.0), points(rng, 150, 540, 630, 4.0, 8.0)
    found = estimate(estimate_scene_pose, [(most, CAMERA_MOTION), (few, BODY_MOTION)])
    assert is_pose(found, CAMERA_MOTION)


def test_a_second_motion_is_sought_only_where_it_could_matter(monkeypatch):
    calls = []

    def count(*arguments):
        calls.append(len(arguments[1]))
        return estimate_relative_pose(*arguments)

    monkeypatch.setattr("sigmaslam.two_view.scene_pose.estimate_relative_pose", count)
    rng = np.random.default_rng(0)
    parts = [
        (points(rng, 150, 10, 520, 4.0, 8.0), CAMERA_MOTION),
        (points(rng, 30, 540, 630, 4.0, 8.0), BODY_MOTION),
    ]
    assert is_pose(estimate(estimate_scene_pose, parts), CAMERA_MOTION)
    assert len(calls) == 1, "a seventh of the image is no rival"
    excludes = partial(estimate_scene_pose, excludes=lambda pose: np.allclose(pose, CAMERA_MOTION, atol=0.03))
    assert is_pose(estimate(excludes, parts), BODY_MOTION)
    assert len(calls) == 3, "what a sensor excludes gives way to a small rest"


def test_motions_that_see_points_at_the_same_places_are_one():
    """Half of the image is off by half a pixel, as with a wrong calibration: no other motion."""
    rng = np.random.default_rng(0)
    left, right = points(rng, 150, 10, 315, 4.0, 8.0), points(rng, 150, 325, 630, 4.0, 8.0)
    nearly = CAMERA_MOTION @ se3_exp([0.0, 0.0, 0.0, 0.003, 0.0, 0.0])
    assert estimate(estimate_scene_pose, [(left, CAMERA_MOTION), (right, nearly)]) is not None


@pytest.mark.parametrize("seed", range(3))
def test_a_static_scene_gives_what_one_motion_gives(seed):
    rng = np.random.default_rng(seed)
    scene = points(rng, 200, 10, 630, 4.0, 20.0)
    whole = estimate(estimate_scene_pose, [(scene, CAMERA_MOTION)], seed)
    alone = estimate(estimate_relative_pose, [(scene, CAMERA_MOTION)], seed)
    assert np.array_equal(whole.T_key_camera, alone.T_key_camera)
    assert np.array_equal(whole.inliers, alone.inliers)
