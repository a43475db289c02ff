"""What matches that disagree with a pose can explain at most, and bodies that draw a pose along."""

from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.estimation.prediction_errors import surprise
from sigmaslam.geometry.image_cells import explained_area
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log, transform_points
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.localisation import Localiser
from sigmaslam.slam.moving_region import MovingRegion
from sigmaslam.slam.phase import Course
from sigmaslam.slam.scrutiny import Scrutiny
from sigmaslam.slam.second_motion import _among, _most_departing, find_scene_behind
from sigmaslam.two_view.scene_pose import see_the_same
from tests.support.dense_window import CAMERA, DEPTH, ITERATIONS, NO_WALK, make_window

FAR, NEAR, POSE = 160, 50, se3_exp(np.array([0.02, 0.01, 0.02, 0.004, -0.003, 0.002]))


@pytest.mark.parametrize("seed", range(6))
def test_no_matches_that_depart_explain_more_than_the_bound(seed: int) -> None:
    """Nor are they more; the bound is reached."""
    rng = np.random.default_rng(seed)
    cells, equal = rng.integers(0, 5, 24), np.ones(24)
    others, departs = np.sort(rng.choice(24, 9, replace=False)), rng.choice([1.0, 4.0], 9, p=[0.7, 0.3])
    bound = _most_departing(cells, others, departs)
    most, reached = explained_area(cells, bound, equal), 0.0
    for count in range(1, 10):
        for subset in map(list, combinations(range(9), count)):
            if not see_the_same(departs[subset]):
                assert count <= bound.sum()
                reached = max(reached, explained_area(cells, _among(others[subset], 24), equal))
    assert reached == pytest.approx(most)


def test_matches_that_stay_where_they_are_bound_nothing_else_in() -> None:
    assert not _most_departing(np.zeros(12, np.int64), np.arange(9), np.full(9, 1.0)).any()


@pytest.mark.parametrize("way", [[0.0, 0.0, 0.0], [-0.02, 0.0, 0.0]])
def test_what_moves_makes_a_keyframe_as_uncertain_where_the_stamp_is_doubtful_too(way: list[float]) -> None:
    """An image of another time is a keyframe as good as any, but what moves may have drawn its pose all the same."""
    found = []
    for expects in (False, True):
        localiser, matches, fit = scene(0, way, sigma=0.001)
        scrutiny = Scrutiny(localiser, FrameClock(), Course(), MovingRegion(8.0, 10), False)
        scrutiny._had_other_times = expects
        found.append(scrutiny.doubt(black(), matches, fit)[2])
    assert [Doubt.TIME in each.reasons for each in found] == [False, True]
    assert [each.published.any() for each in found] == [False, True]
    assert found[0].spread.any()
    assert np.array_equal(found[0].spread, found[1].spread)


def black() -> Any:
    """A frame that shows nothing."""
    image = np.zeros((CAMERA.height, CAMERA.width), np.uint8)
    return SimpleNamespace(left=image, right=image)


def scene(seed: int, way: list[float], sigma: float = 0.2) -> tuple[Localiser, GuidedMatches, FrameFit]:
    """Matches of a scene and of a body before it that has gone some way, metres, and the pose by all of them.

    A prediction that the camera stands has `sigma`, metres, and half of it, radians.
    """
    rng, count = np.random.default_rng(seed), FAR + NEAR
    window = make_window(np.full(3, 1e-3))
    window.add_keyframe(np.eye(4), np.eye(4), np.zeros((6, 6)), NO_WALK, DEPTH)
    far = np.c_[rng.uniform([20.0, 20.0], [620.0, 460.0], (FAR, 2)), rng.uniform(8.0, 24.0, FAR)]
    near = np.c_[rng.uniform([200.0, 150.0], [400.0, 330.0], (NEAR, 2)), rng.uniform(60.0, 70.0, NEAR)]
    seen = np.concatenate([far, near])
    window.add_landmarks(np.arange(count), seen, np.full((count, 4), 0.01))
    window.solve()
    points = CAMERA.triangulate(seen) + np.repeat([np.zeros(3), way], [FAR, NEAR], axis=0)
    found = CAMERA.project(transform_points(se3_inverse(POSE), points)) + rng.normal(0.0, 0.3, (count, 3))
    views = LandmarkViews(np.arange(count), found, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3, 2)))
    motion = MotionFilter()
    motion.step_covariance[:] = np.diag(np.repeat([sigma, 0.5 * sigma], 3) ** 2)
    config: Any = SimpleNamespace(min_inliers=15)
    follower = SimpleNamespace(is_ready=False)
    given: list[Any] = [window, motion, FrameUpdate(window, ITERATIONS), None, follower, None, config, None]
    localiser, matches = Localiser(*given), GuidedMatches(views, np.ones(count), np.arange(count))
    fit = localiser.update.fit(views, np.eye(4), motion.step_covariance, 15)
    assert fit is not None
    return localiser, matches, fit


@pytest.mark.parametrize("seed", range(3))
def test_a_body_before_the_scene_that_draws_the_pose_along_is_found(seed: int) -> None:
    """All agree with a pose between both motions."""
    localiser, matches, fit = scene(seed, [-0.02, 0.0, 0.0])
    second = find_scene_behind(localiser, matches, fit, doubts := Doubts())
    assert second is not None
    assert second.is_mover
    assert np.mean(second.agreeing >= FAR) > 0.95
    errors = [np.linalg.norm((se3_inverse(POSE) @ each.pose)[:3, 3]) for each in (fit, second.first)]
    assert errors[1] < 0.2 * errors[0]
    assert not doubts.spoils_keyframe


@pytest.mark.parametrize("seed", range(3))
def test_a_body_at_rest_before_the_scene_is_none_that_moves(seed: int) -> None:
    second = find_scene_behind(*scene(seed, [0.0, 0.0, 0.0]), doubts := Doubts())
    assert second is None
    assert not doubts.spread.any()
    assert not doubts.spoils_keyframe


@pytest.mark.parametrize("seed", range(3))
def test_far_parts_do_not_side_with_a_prediction_that_the_image_contradicts(seed: int) -> None:
    """As after a frame that was lost unnoticed, at twice the speed: near points at rest would seem to move."""
    localiser, matches, fit = scene(seed, [0.0, 0.0, 0.0], sigma=0.001)
    assert surprise(localiser.motion, fit.pose) > 5.0
    assert find_scene_behind(localiser, matches, fit, Doubts()) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_body_that_moves_by_too_little_to_be_told_is_in_the_covariance(seed: int) -> None:
    """A pixel: nothing is left out, and the pose that the body draws along stays the frame's."""
    localiser, matches, fit = scene(seed, [-0.004, 0.0, 0.0])
    scrutiny = Scrutiny(localiser, FrameClock(), Course(), MovingRegion(8.0, 10), False)
    kept, same, doubts = scrutiny.doubt(black(), matches, fit)
    assert kept is matches
    assert same is fit
    error = se3_log(POSE @ se3_inverse(fit.pose))
    assert squared_mahalanobis(error[None], fit.relative[None])[0] > 50.0
    assert squared_mahalanobis(error[None], (fit.relative + doubts.spread)[None])[0] < 22.5


def test_a_pose_that_a_body_draws_far_along_is_as_uncertain_as_the_others_know_it() -> None:
    """And it spoils a keyframe: its error would be in all later poses. Two pixels; of one the step says enough."""
    moving = MovingRegion(8.0, 10)
    for way, spoils, most in ((-0.008, True, 2.0), (-0.004, False, 8.0)):
        localiser, matches, fit = scene(2, [way, 0.0, 0.0])
        _, same, doubts = Scrutiny(localiser, FrameClock(), Course(), moving, False).doubt(black(), matches, fit)
        assert same is fit
        assert doubts.spoils_keyframe == spoils
        assert doubts.status == "tracking"
        error = se3_log(POSE @ se3_inverse(fit.pose))
        assert squared_mahalanobis(error[None], (fit.relative + doubts.spread)[None])[0] < most
