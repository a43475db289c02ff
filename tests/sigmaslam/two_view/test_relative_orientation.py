"""Relative orientation where most matches are wrong, and of scenes that hardly fix it."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_log
from sigmaslam.two_view import relative_orientation
from sigmaslam.two_view.relative_orientation import RelativeOrientation, estimate_relative_orientation

K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])
SIDEWAYS, FORWARD = np.array([-1.0, 0.1, 0.2]), np.array([0.05, -0.02, -1.0])
TURN = cv2.Rodrigues(np.array([0.05, -0.12, 0.04]))[0]
SIGMA = 0.7


@dataclass(frozen=True, slots=True)
class Views:
    """Pixels (M, 2) of two views, and the direction of the translation."""

    points0: np.ndarray
    points1: np.ndarray
    direction: np.ndarray

    def estimate(self) -> RelativeOrientation:
        count = len(self.points0)
        covariance = np.tile(SIGMA**2 * np.eye(2), (count, 1, 1))
        found = estimate_relative_orientation(K, self.points0, self.points1, np.ones(count), covariance)
        assert found is not None
        return found

    def errors(self, found: RelativeOrientation) -> np.ndarray:
        """(6,) of direction, as angles, and of rotation."""
        along = self.direction - (self.direction @ found.direction) * found.direction
        length = float(np.linalg.norm(along))
        angle = np.arctan2(length, self.direction @ found.direction)
        return np.r_[along * angle / max(length, 1e-15), rotation_log(TURN @ found.R.T)]


def views(seed: int, translation: np.ndarray, wrong: float = 0.0, plane: bool = False, sigma: float = SIGMA) -> Views:
    """200 points 4 to 12 units away, or on a plane; a share of their matches anywhere."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform((20, 20), (620, 460), (200, 2))
    rays = np.c_[points0, np.ones(200)] @ np.linalg.inv(K).T
    depth = 8.0 / (1.0 + rays @ (0.3, 0.2, 0.0)) if plane else rng.uniform(4.0, 12.0, 200)
    seen = (depth[:, None] * rays @ TURN.T + translation) @ K.T
    points1 = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, sigma, (200, 2))
    bad = rng.random(200) < wrong
    points1[bad] = rng.uniform((0, 0), (640, 480), (int(bad.sum()), 2))
    return Views(points0, points1, translation / max(float(np.linalg.norm(translation)), 1e-15))


def nees(scene: Views) -> float:
    """Per degree of freedom, of 5."""
    found = scene.estimate()
    basis = np.zeros((6, 5))
    basis[:3, :2], basis[3:, 2:] = np.linalg.svd(found.direction[None])[2][1:].T, np.eye(3)
    error = basis.T @ scene.errors(found)
    return float(error @ np.linalg.solve(basis.T @ found.covariance @ basis, error)) / 5.0


@pytest.mark.parametrize("translation", [SIDEWAYS, -SIDEWAYS, FORWARD, -FORWARD])
def test_exact_matches_have_the_exact_pose(translation: np.ndarray):
    scene = views(0, translation, sigma=0.0)
    found = scene.estimate()
    assert np.abs(scene.errors(found)).max() < 1e-6
    assert found.inliers.all()
    assert found.rival == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("translation", [SIDEWAYS, FORWARD], ids=["sideways", "forward"])
def test_the_pose_is_found_though_seven_matches_in_ten_are_wrong(translation: np.ndarray):
    for seed in range(8):
        scene = views(seed, translation, wrong=0.7)
        assert np.degrees(np.abs(scene.errors(scene.estimate())).max()) < 5.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("translation", "plane"),
    [(SIDEWAYS, False), (SIDEWAYS, True), (0.05 * SIDEWAYS, False)],
    ids=["depth", "plane", "small baseline"],
)
def test_errors_are_as_the_covariance_says_with_wrong_matches(translation: np.ndarray, plane: bool):
    found = [nees(views(seed, translation, 0.3, plane)) for seed in range(12)]
    assert 0.4 < np.mean(found) < 2.0


@pytest.mark.long
def test_a_mere_turn_leaves_the_direction_unknown_and_the_rotation_known():
    scene = views(0, np.zeros(3))
    found = scene.estimate()
    assert np.degrees(np.sqrt(np.linalg.eigvalsh(found.covariance[:3, :3])[-1])) > 45.0
    assert np.degrees(np.abs(scene.errors(found)[3:]).max()) < 0.2
    # No direction is farther than any other one.
    assert np.isfinite(found.covariance).all()


@pytest.mark.long
def test_the_other_pose_of_a_plane_is_told_and_allowed_for():
    """Far from a plane, seen straight, either of its two poses has all points before both cameras."""
    rng = np.random.default_rng(1)
    points0 = rng.uniform((270, 190), (370, 290), (200, 2))
    rays = np.c_[points0, np.ones(200)] @ np.linalg.inv(K).T
    translation = np.array([-1.0, 0.0, 0.3])
    seen = (8.0 * rays / (1.0 + rays @ (0.3, 0.2, 0.0))[:, None] @ TURN.T + translation) @ K.T
    points1 = seen[:, :2] / seen[:, 2:] + rng.normal(0.0, 0.05, (200, 2))
    scene = Views(points0, points1, translation / np.linalg.norm(translation))
    found = scene.estimate()
    assert found.rival > 0.05
    assert found.rival_angles[1] > np.radians(5.0)
    assert nees(scene) < 3.0


@pytest.mark.long
def test_a_pose_that_no_match_agrees_with_is_not_that_of_a_plane(monkeypatch: pytest.MonkeyPatch):
    """The camera goes towards a plane; the pose of the opposite direction is refined to one without inliers."""
    scene, starts = views(1, FORWARD, plane=True), relative_orientation._starts

    def both_ways(*given) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(R, sign * direction) for R, direction in starts(*given) for sign in (1.0, -1.0)]

    monkeypatch.setattr(relative_orientation, "_starts", both_ways)
    assert np.degrees(np.abs(scene.errors(scene.estimate())).max()) < 30.0


@pytest.mark.long
def test_points_on_a_plane_count_in_both_coordinates_and_others_do_not(monkeypatch: pytest.MonkeyPatch):
    scenes = views(2, SIDEWAYS, 0.3, plane=True), views(2, SIDEWAYS, 0.3)
    found = [scene.estimate() for scene in scenes]
    plane_nees = nees(scenes[0])
    monkeypatch.setattr(relative_orientation, "_on_plane", lambda *given: None)
    plane, depth = (scene.estimate() for scene in scenes)
    assert np.trace(found[0].covariance) < 0.5 * np.trace(plane.covariance)
    assert plane_nees < 3.0
    np.testing.assert_array_equal(found[1].covariance, depth.covariance)


@pytest.mark.long
def test_a_match_with_a_parallax_beyond_all_others_has_no_vote():
    """It lies on its line, where any direction of so short a baseline would bend to it."""
    scene = views(3, 0.05 * SIDEWAYS)
    lured = scene.points1.copy()
    lured[0] = scene.points0[0] + (200.0, 100.0)
    assert not Views(scene.points0, lured, scene.direction).estimate().inliers[0]


def test_neighbours_that_err_alike_widen_the_covariance():
    apart = views(5, SIDEWAYS)
    rng = np.random.default_rng(0)
    parts = (apart.points0 // 80).astype(int) @ (1, 8)
    errors = rng.normal(0.0, SIGMA, (parts.max() + 1, 2))
    exact = views(5, SIDEWAYS, sigma=0.0)
    alike = Views(exact.points0, exact.points1 + errors[parts], exact.direction)
    assert np.trace(alike.estimate().covariance) > 2.0 * np.trace(apart.estimate().covariance)


def test_too_few_matches_have_no_pose():
    scene = views(0, SIDEWAYS)
    covariance = np.tile(np.eye(2), (200, 1, 1))
    probability = np.where(np.arange(200) < 7, 0.9, 0.4)
    assert estimate_relative_orientation(K, scene.points0, scene.points1, probability, covariance) is None


def test_the_same_call_gives_the_same_pose():
    scene = views(0, SIDEWAYS, 0.3)
    one, other = scene.estimate(), scene.estimate()
    np.testing.assert_array_equal(one.R, other.R)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_intrinsics_may_be_a_part_of_a_projection_matrix():
    scene, part = views(0, SIDEWAYS), np.c_[K, np.zeros(3)][:, :3]
    covariance = np.tile(SIGMA**2 * np.eye(2), (200, 1, 1))
    found = estimate_relative_orientation(part, scene.points0, scene.points1, np.ones(200), covariance)
    assert found is not None
    np.testing.assert_array_equal(found.R, scene.estimate().R)
