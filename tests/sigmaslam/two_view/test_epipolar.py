"""Relative pose from judged matches: exact ones, noise of known covariance, wrong ones, and scenes that are hard."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from sigmaslam.two_view.epipolar import EpipolarPose, estimate_epipolar_pose

K = np.array([[500.0, 0.0, 320.0], [0.0, 480.0, 240.0], [0.0, 0.0, 1.0]])
SIDEWAYS, FORWARD = np.array([-1.0, 0.1, 0.2]), np.array([0.03, -0.02, -1.0])
TURN = np.array([0.05, -0.12, 0.04])
SIGMA = 0.4


@dataclass(frozen=True, slots=True)
class Scene:
    """Matches of two views and the truth.

    Attributes:
        R, direction: the pose.
        points0, points1: (M, 2) pixels.
        probability, covariance: (M,), (M, 2, 2) as told.
    """

    R: np.ndarray
    direction: np.ndarray
    points0: np.ndarray
    points1: np.ndarray
    probability: np.ndarray
    covariance: np.ndarray

    def estimate(self) -> EpipolarPose:
        pose = estimate_epipolar_pose(K, self.points0, self.points1, self.probability, self.covariance)
        assert pose is not None
        return pose


def scene(
    count: int = 300, seed: int = 0, translation: np.ndarray = SIDEWAYS, turn: np.ndarray = TURN, plane: bool = False
) -> Scene:
    """Points 4 to 12 baselines away, or on a slanted plane, matched without error."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform((20, 20), (620, 460), (count, 2))
    rays = np.c_[points0, np.ones(count)] @ np.linalg.inv(K).T
    depth = 6.0 / (1.0 + rays @ (0.3, 0.2, 0.0)) if plane else rng.uniform(4.0, 12.0, count)
    R = cv2.Rodrigues(turn)[0]
    in_camera1 = (depth[:, None] * rays) @ R.T + translation
    points1 = (in_camera1 / in_camera1[:, 2:]) @ K.T
    covariance = np.tile(SIGMA**2 * np.eye(2), (count, 1, 1))
    return Scene(R, translation / np.linalg.norm(translation), points0, points1[:, :2], np.ones(count), covariance)


def noisy(exact: Scene, seed: int, covariance: np.ndarray | None = None) -> Scene:
    """Disturbed by draws of the covariance (M, 2, 2), which is told as well."""
    covariance = exact.covariance if covariance is None else covariance
    draws = np.random.default_rng((seed, 1)).standard_normal(exact.points1.shape)
    error = np.einsum("mij,mj->mi", np.linalg.cholesky(covariance), draws)
    return replace(exact, points1=exact.points1 + error, covariance=covariance)


def with_wrong(exact: Scene, share: float, probability: tuple[float, float], seed: int = 5) -> Scene:
    """That share of matches anywhere, and the probability of wrong and of right ones."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(exact.points1)) < share
    points1 = np.where(wrong[:, None], rng.uniform((0, 0), (640, 480), exact.points1.shape), exact.points1)
    return replace(exact, points1=points1, probability=np.where(wrong, *probability))


def errors(found: EpipolarPose, truth: Scene) -> tuple[float, float]:
    """Angle between directions and between rotations, degrees."""
    between = np.arctan2(np.linalg.norm(np.cross(found.direction, truth.direction)), found.direction @ truth.direction)
    return float(np.degrees(between)), float(np.degrees(np.linalg.norm(cv2.Rodrigues(found.R @ truth.R.T)[0])))


def standardised(found: EpipolarPose, matches: Scene) -> np.ndarray:
    """Distances (M,) of points1 from their epipolar lines over the standard deviation of that."""
    K_inverse = np.linalg.inv(K)
    F = K_inverse.T @ np.cross(np.eye(3), found.direction) @ found.R @ K_inverse
    line = np.c_[matches.points0, np.ones(len(matches.points0))] @ F.T
    sigma = np.sqrt(np.einsum("mi,mij,mj->m", line[:, :2], matches.covariance, line[:, :2]))
    return np.einsum("mi,mi->m", np.c_[matches.points1, np.ones(len(line))], line) / sigma


def standard_deviations(truth: Scene) -> np.ndarray:
    """Of the five degrees of freedom, radians: inverse root of the information of the matches, by differences."""
    tangent = np.linalg.svd(truth.direction[None])[2][1:].T

    def distances(step: np.ndarray) -> np.ndarray:
        R, direction = cv2.Rodrigues(step[:3])[0] @ truth.R, truth.direction + tangent @ step[3:]
        return standardised(EpipolarPose(R, direction, np.zeros(0, bool)), truth)

    J = np.stack([(distances(1e-5 * e) - distances(-1e-5 * e)) / 2e-5 for e in np.eye(5)], axis=1)
    return np.sqrt(np.diag(np.linalg.inv(J.T @ J)))


# Exact matches


@pytest.mark.parametrize(
    ("translation", "turn"),
    [
        (SIDEWAYS, TURN),
        (SIDEWAYS, np.zeros(3)),
        (-SIDEWAYS, -TURN),
        (FORWARD, TURN),
        (FORWARD, np.zeros(3)),
        (-FORWARD, TURN),
        (SIDEWAYS, 5.0 * TURN),
    ],
    ids=["sideways", "sideways without a turn", "the other way", "forward", "straight on", "backward", "far turned"],
)
def test_exact_matches_have_the_exact_pose(translation: np.ndarray, turn: np.ndarray):
    exact = scene(translation=translation, turn=turn)
    found = exact.estimate()
    assert max(errors(found, exact)) < 1e-3
    assert found.inliers.all()


@pytest.mark.parametrize("count", [8, 12, 40])
def test_few_exact_matches_are_enough(count: int):
    exact = scene(count, seed=count)
    assert max(errors(exact.estimate(), exact)) < 0.01


def test_the_pose_is_a_rotation_and_a_unit_vector():
    found = noisy(scene(), 0).estimate()
    np.testing.assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found.R) > 0
    assert np.linalg.norm(found.direction) == pytest.approx(1.0)


@pytest.mark.parametrize("translation", [SIDEWAYS, FORWARD], ids=["sideways", "forward"])
def test_points_of_a_plane_have_a_pose_that_explains_them(translation: np.ndarray):
    for seed in range(10):
        disturbed = noisy(scene(translation=translation, plane=True), seed)
        assert np.sqrt(np.mean(standardised(disturbed.estimate(), disturbed) ** 2)) < 1.1


def test_of_the_poses_that_explain_a_plane_the_one_that_has_it_before_both_cameras_is_found():
    """The other one of this plane, 82 degrees off, has a fifth of it behind them."""
    exact = scene(plane=True)
    assert max(errors(exact.estimate(), exact)) < 0.01
    assert max(errors(noisy(exact, seed).estimate(), exact)[0] for seed in range(10)) < 2.0


# Noise


@pytest.mark.parametrize("translation", [SIDEWAYS, FORWARD], ids=["sideways", "forward"])
def test_errors_are_as_large_as_the_information_of_the_matches_allows(translation: np.ndarray):
    exact = scene(translation=translation)
    sigma = standard_deviations(exact)
    off = np.radians([errors(noisy(exact, seed).estimate(), exact) for seed in range(30)])
    expected = np.array([np.linalg.norm(sigma[3:]), np.linalg.norm(sigma[:3])])
    assert (off.max(axis=0) < 4.0 * expected).all()
    rms = np.sqrt(np.mean(off**2, axis=0))
    assert (rms < 1.5 * expected).all()
    assert (rms > 0.6 * expected).all()


def median_error(exact: Scene, covariance: np.ndarray, told: np.ndarray) -> float:
    """Of the direction over 20 draws of the covariance (M, 2, 2) when another one is told, degrees."""
    told = np.broadcast_to(told, covariance.shape)
    return float(
        np.median(
            [errors(replace(noisy(exact, s, covariance), covariance=told).estimate(), exact)[0] for s in range(20)]
        )
    )


@pytest.mark.parametrize("translation", [SIDEWAYS, FORWARD], ids=["sideways", "forward"])
def test_covariances_told_as_they_are_beat_equal_ones(translation: np.ndarray):
    """Half of the matches ten times as uncertain."""
    exact = scene(translation=translation)
    sigma = np.where(np.random.default_rng(7).random(300) < 0.5, 3.0, 0.3)
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    told, equal = (median_error(exact, covariance, each) for each in (covariance, covariance.mean(axis=0)))
    assert told < 0.5 * equal


def test_ellipses_told_as_they_are_beat_circles_and_those_that_lie_across():
    """Matches as on edges: ten times as uncertain along a direction of their own."""
    exact = scene()
    angle = np.random.default_rng(7).uniform(0.0, np.pi, 300)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    covariance = 0.3**2 * np.eye(2) + (3.0**2 - 0.3**2) * along[:, :, None] * along[:, None, :]
    quarter_turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    told, circles, across = (
        median_error(exact, covariance, each)
        for each in (covariance, covariance.mean(axis=0), quarter_turn @ covariance @ quarter_turn.T)
    )
    assert told < 0.8 * circles
    assert told < 0.5 * across


def test_inliers_are_what_three_standard_deviations_hold():
    share = np.mean([noisy(scene(), seed).estimate().inliers.mean() for seed in range(5)])
    assert 0.97 < share <= 1.0


# Wrong matches


def test_many_wrong_matches_of_low_probability_do_not_disturb():
    for seed in range(5):
        exact = scene(500, seed=seed)
        mixed = with_wrong(noisy(exact, seed), 0.6, (0.02, 0.98), seed)
        alone = mixed.probability > 0.5
        found, without = (
            each.estimate()
            for each in (
                mixed,
                Scene(
                    exact.R,
                    exact.direction,
                    *(array[alone] for array in (mixed.points0, mixed.points1, mixed.probability, mixed.covariance)),
                ),
            )
        )
        assert errors(found, exact)[0] < errors(without, exact)[0] + 0.2
        assert not found.inliers[~alone].any()
        assert found.inliers[alone].mean() > 0.95


def test_some_wrong_matches_that_look_right_are_told_apart():
    exact = scene(400)
    mixed = with_wrong(noisy(exact, 0), 0.2, (0.9, 0.9))
    found = mixed.estimate()
    assert max(errors(found, exact)) < 1.0
    wrong = np.linalg.norm(mixed.points1 - exact.points1, axis=1) > 5.0
    # Those that lie near their epipolar lines by chance are not.
    assert found.inliers[wrong].mean() < 0.15
    assert found.inliers[~wrong].mean() > 0.95


# What cannot be, and what must not matter


@pytest.mark.parametrize("probable", [0, 5, 7])
def test_fewer_than_eight_probable_matches_have_no_pose(probable: int):
    exact = scene(100)
    probability = np.where(np.arange(100) < probable, 0.9, 0.4)
    assert estimate_epipolar_pose(K, exact.points0, exact.points1, probability, exact.covariance) is None


def test_no_matches_have_no_pose():
    none = np.zeros((0, 2))
    assert estimate_epipolar_pose(K, none, none, np.zeros(0), np.zeros((0, 2, 2))) is None


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [8, 50])
def test_pure_noise_is_no_error(count: int, seed: int):
    rng = np.random.default_rng(seed)
    points0, points1 = rng.uniform((0, 0), (640, 480), (2, count, 2))
    found = estimate_epipolar_pose(K, points0, points1, np.ones(count), np.tile(np.eye(2), (count, 1, 1)))
    if found is not None:
        assert np.isfinite(found.R).all()
        assert np.linalg.norm(found.direction) == pytest.approx(1.0)
        assert found.inliers.shape == (count,)


@pytest.mark.parametrize("kind", ["no motion", "a turn alone", "one place", "one line"])
def test_matches_that_fix_no_direction_are_no_error(kind: str):
    exact = scene(60)
    points0 = exact.points0
    if kind == "one place":
        points0 = np.full((60, 2), 100.0)
    if kind == "one line":
        points0 = np.linspace((50.0, 60.0), (500.0, 300.0), 60)
    turned = np.c_[points0, np.ones(60)] @ (K @ exact.R @ np.linalg.inv(K)).T
    points1 = turned[:, :2] / turned[:, 2:] if kind == "a turn alone" else points0
    found = estimate_epipolar_pose(K, points0, points1, exact.probability, exact.covariance)
    assert found is None or (np.isfinite(found.R).all() and np.isfinite(found.direction).all())


def test_a_pure_turn_is_found_though_there_is_no_direction():
    exact = scene(200, translation=1e-9 * SIDEWAYS)
    for seed in range(3):
        assert errors(noisy(exact, seed).estimate(), exact)[1] < 0.3


def test_matches_at_infinity_are_inliers():
    """Their rays are parallel: neither before nor behind the cameras."""
    exact = scene(200)
    turned = np.c_[exact.points0, np.ones(200)] @ (K @ exact.R @ np.linalg.inv(K)).T
    far = np.arange(200) < 60
    points1 = np.where(far[:, None], turned[:, :2] / turned[:, 2:], exact.points1)
    for seed in range(3):
        found = noisy(replace(exact, points1=points1), seed).estimate()
        assert found.inliers[far].mean() > 0.9


def test_the_same_call_gives_the_same_pose_and_leaves_its_arguments():
    mixed = with_wrong(noisy(scene(), 0), 0.3, (0.6, 0.9))
    before = [array.copy() for array in (mixed.points0, mixed.points1, mixed.probability, mixed.covariance)]
    first, second = mixed.estimate(), mixed.estimate()
    np.testing.assert_array_equal(first.R, second.R)
    np.testing.assert_array_equal(first.direction, second.direction)
    for array, copy in zip((mixed.points0, mixed.points1, mixed.probability, mixed.covariance), before, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_float32_matches_are_taken():
    exact = noisy(scene(), 0)
    single = replace(
        exact,
        points0=exact.points0.astype(np.float32),
        points1=exact.points1.astype(np.float32),
        probability=exact.probability.astype(np.float32),
        covariance=exact.covariance.astype(np.float32),
    )
    a, b = exact.estimate(), single.estimate()
    np.testing.assert_allclose(a.direction, b.direction, atol=1e-4)
    np.testing.assert_allclose(a.R, b.R, atol=1e-4)
