"""Poses of remembered keyframes: what features alone say is sought again by all landmarks that they foresee."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import Features, KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.unguided_matching import UnguidedMatcher
from sigmaslam.two_view.stereo_pose import RelativePose

CAMERA = RectifiedStereo(fx=400.0, fy=400.0, cx=319.5, cy=239.5, baseline=0.2, width=640, height=480)
IMAGE = np.zeros((480, 640), np.uint8)
COUNT, SIGMA = 400, 0.3


def key_view(seed: int, farthest: float = 15.0) -> StereoView:
    """Points 3 m away and more."""
    rng = np.random.default_rng(seed)
    places = rng.uniform((20, 20), (620, 460), (COUNT, 2)).astype(np.float32)
    features = Features(places, np.zeros((COUNT, 64), np.float32), np.ones(COUNT, np.float32), np.ones(COUNT))
    return StereoView(IMAGE, IMAGE, features, 80.0 / rng.uniform(3, farthest, COUNT), np.full(COUNT, SIGMA))


class Sights:
    """A front-end that finds keypoints where a pose sees them, of which only some look like themselves to features."""

    def __init__(self, key: StereoView, T_key_camera: np.ndarray, known: np.ndarray, there: np.ndarray) -> None:
        T = se3_inverse(T_key_camera)
        points = CAMERA.triangulate(key.measured(np.arange(COUNT)))
        noise = np.random.default_rng(7).normal(0.0, SIGMA, (COUNT, 3))
        self.seen = CAMERA.project(points @ T[:3, :3].T + T[:3, 3]) + noise
        self.known, self.there = known, there

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        near = np.abs(search.predicted - self.seen[search.index, :2]).max(axis=1) < 20.0
        found = self.known if search.covariance is None else self.there
        index = search.index[found[search.index] & (near | (search.covariance is None))]
        seen, covariance = self.seen[index], np.tile(SIGMA**2 * np.eye(2), (len(index), 1, 1))
        sigma, ones = np.full(len(index), SIGMA), np.ones(len(index))
        return TemporalMatches(index, seen[:, :2], seen[:, 2], covariance, sigma, ones)


def matcher_of(sights: Sights, calibration: float = 0.0) -> UnguidedMatcher:
    """Beside a window whose errors of the calibration have so large a covariance, each for itself."""
    state = SimpleNamespace(whole_covariance=calibration * np.eye(CALIBRATION_SIZE))
    window = SimpleNamespace(as_calibrated=lambda measured: measured, posterior=state)
    noise = SimpleNamespace(of_matches=lambda matches: np.tile(SIGMA**2 * np.eye(3), (len(matches), 1, 1)))
    return UnguidedMatcher(CAMERA, sights, window, noise, TrackerConfig())  # type: ignore[arg-type]


def some(count: int) -> np.ndarray:
    return np.random.default_rng(3).permutation(COUNT) < count


@pytest.mark.parametrize("motion", [[0.1, 0.0, 0.3, 0.0, 0.05, 0.0], [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])
def test_a_pose_that_a_few_features_find_is_told_by_all_landmarks(motion: list[float]):
    departures = []
    for seed in range(8):
        key, pose = key_view(seed), se3_exp(np.array(motion))
        matcher = matcher_of(Sights(key, pose, some(60), np.ones(COUNT, bool)))
        few, all_of_them = matcher.relative_pose_to(key, key), matcher.confirmed_pose_to(key, key)
        assert few is not None
        assert all_of_them is not None
        assert all_of_them.inliers.sum() > 2 * few.inliers.sum()
        departures.append([se3_log(se3_inverse(pose) @ each.T_key_camera) for each in (few, all_of_them)])
    few_errors, errors = np.sqrt(np.mean(np.square(departures), axis=0))
    assert np.linalg.norm(errors) < 0.7 * np.linalg.norm(few_errors)


def test_the_covariance_has_the_calibrations_part():
    key, pose = key_view(0), se3_exp(np.array([0.1, 0.0, 0.3, 0.0, 0.05, 0.0]))
    sights = Sights(key, pose, some(60), np.ones(COUNT, bool))
    exact, rough = (matcher_of(sights, variance).confirmed_pose_to(key, key) for variance in (0.0, 1e-2))
    assert exact is not None
    assert rough is not None
    more = rough.covariance - exact.covariance
    np.testing.assert_allclose(more, 1e-2 * rough.by_calibration @ rough.by_calibration.T, atol=1e-12)
    assert np.trace(more) > 10.0 * np.trace(exact.covariance)


@pytest.mark.parametrize(("share", "is_found"), [(0.12, False), (0.2, False), (0.5, True)])
def test_repeated_texture_is_no_place_where_the_other_landmarks_are_missing(share: float, is_found: bool):
    """Dozens of features agree with a pose; of what looks alike from there only a share is to be found."""
    key, pose = key_view(1), se3_exp(np.array([0.1, 0.0, 0.2, 0.0, 0.01, 0.0]))
    agreeing = some(int(share * COUNT))
    matcher = matcher_of(Sights(key, pose, agreeing, agreeing))
    assert matcher.relative_pose_to(key, key) is not None
    assert (matcher.confirmed_pose_to(key, key) is not None) == is_found


def test_landmarks_that_an_offset_moves_behind_infinity_are_left_out():
    key = key_view(1)
    matcher = matcher_of(Sights(key, np.eye(4), some(COUNT), np.ones(COUNT, bool)))
    matcher.window.as_calibrated = lambda measured: measured - (0.0, 0.0, 6.0)  # type: ignore[method-assign]
    assert (key.disparity < 6.0).any()
    found = matcher.confirmed_pose_to(key, key)
    assert found is not None
    assert found.foreseen <= (key.disparity > 6.0).sum()


def test_few_landmarks_suffice_where_none_can_look_alike():
    """From so much nearer a keyframe's landmarks look different, and a right pose finds a few of them."""
    key, pose = key_view(2, 6.0), se3_exp(np.array([0.0, 0.0, 1.6, 0.0, 0.0, 0.0]))
    agreeing = some(80)
    assert matcher_of(Sights(key, pose, agreeing, agreeing)).confirmed_pose_to(key, key) is not None


@pytest.mark.parametrize(
    ("agreeing", "foreseen", "is_clear"), [(44, 60, False), (60, 0, True), (60, 200, True), (60, 300, False)]
)
def test_what_motion_excludes_is_believed_by_many_and_a_share_of_all_foreseen(
    agreeing: int, foreseen: int, is_clear: bool
):
    relative = RelativePose(np.eye(4), np.arange(400) < agreeing, np.eye(6), 1.0, foreseen=foreseen)
    matcher = matcher_of(Sights(key_view(0), np.eye(4), some(60), some(60)))
    assert matcher.is_beyond_chance(relative) == is_clear
