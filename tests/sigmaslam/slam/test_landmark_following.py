"""Landmarks followed without features, and frames whose features are made when asked for, or beside the tracking."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from sigmaslam import StereoTracker
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView, TemporalMatches, build_frontend
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.landmark_following import LandmarkFollower
from tests.support.estimates import Demo, track

SEARCHED = 200
# So that there are some keyframes within few frames: every second one of the demo, and keyframes sooner.
OFTEN, EVERY, FRAMES = TrackerConfig(keyframe_ratio=0.95), 2, 15


class CarryingOnly:
    """In place of a `GuidedMatcher`: notes where landmarks are carried to.

    Args:
        landmark_id, predicted: (K,), (K, 2) of the landmarks that are searched for.
    """

    camera = RectifiedStereo(200.0, 200.0, 160.0, 120.0, 0.1, 320, 240)

    def __init__(self, landmark_id: np.ndarray, predicted: np.ndarray) -> None:
        self._landmark_id, self._predicted = landmark_id, predicted
        self.start = np.zeros((0, 2))

    def follow(
        self,
        frame: Frame,
        keyframes: list[StereoView],
        pose: np.ndarray,
        covariance: np.ndarray,
        carry: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    ) -> tuple[GuidedMatches, float]:
        self.start = carry(frame.left, self._landmark_id, self._predicted)
        return GuidedMatches.empty(), 1.0


class CountingFrontend:
    """Another front-end, and how often it observed."""

    def __init__(self, frontend: Frontend) -> None:
        self._frontend = frontend
        self.name = frontend.name
        self.observed = 0

    def observe(self, left: np.ndarray, right: np.ndarray) -> StereoView:
        self.observed += 1
        return self._frontend.observe(left, right)

    def match(self, search: KeypointSearch, view: StereoView) -> TemporalMatches:
        return self._frontend.match(search, view)

    def follow(
        self, searches: list[KeypointSearch], starts: list[np.ndarray], left: np.ndarray, right: np.ndarray
    ) -> list[TemporalMatches]:
        return self._frontend.follow(searches, starts, left, right)


@pytest.fixture(scope="module")
def learned() -> Frontend:
    return build_frontend("learned", 1000, threads=1)


# Less than usual


def found(stereo: float, share: float = 0.8) -> tuple[GuidedMatches, np.ndarray]:
    """Matches with that share of the landmarks, a few of them outliers, and that share of inliers with a disparity."""
    inliers = round(share * SEARCHED)
    measurement = np.zeros((inliers + 5, 3))
    measurement[round(stereo * inliers) :, 2] = np.nan
    rows, count = np.arange(SEARCHED), inliers + 5
    views = LandmarkViews(np.arange(count), measurement, np.zeros((count, 3, 3)), np.zeros((count, 3, 2)))
    return GuidedMatches(views, np.ones(count), rows), np.arange(count) < inliers


@pytest.fixture
def follower(learned: Frontend) -> LandmarkFollower:
    return LandmarkFollower(CarryingOnly(np.zeros(0, np.int64), np.zeros((0, 2))))


def test_a_sudden_fall_of_the_disparities_is_told(follower: LandmarkFollower):
    """Below 0.6 of what is usual."""
    for _ in range(3):
        assert not follower.has_fallen(*found(0.9))
    assert follower.has_fallen(*found(0.5))
    assert not follower.has_fallen(*found(0.6))


def test_a_gradual_fall_of_the_disparities_is_usual(follower: LandmarkFollower):
    """By one part in thirty a frame."""
    assert not any(follower.has_fallen(*found(share)) for share in 0.9 * 0.967 ** np.arange(60))


def test_what_stays_fallen_becomes_usual(follower: LandmarkFollower):
    follower.has_fallen(*found(0.9))
    assert follower.has_fallen(*found(0.4))
    assert not [follower.has_fallen(*found(0.4)) for _ in range(10)][-1]


def test_what_is_usual_is_remembered_over_a_lost_frame(follower: LandmarkFollower):
    follower.has_fallen(*found(0.9))
    follower.forget()
    assert follower.has_fallen(*found(0.4))


def test_landmarks_that_are_suddenly_hidden_are_no_fall(follower: LandmarkFollower):
    """Half the image may be covered: what is left says as much as before."""
    follower.has_fallen(*found(0.9, share=0.9))
    assert not follower.has_fallen(*found(0.9, share=0.1))


# Where landmarks are carried to


def test_landmarks_of_the_last_frame_are_carried_along_with_their_image(demo: Demo, learned: Frontend):
    """In any order; others are nowhere, as all are once the frame is forgotten, and only the last frame counts."""
    left = demo[1][10].left
    shift = np.array([3, -2])
    places = learned.observe(left, left).features.keypoints[:300].astype(np.float64)
    places = places[((places > 25) & (places < np.array(left.shape[::-1]) - 25)).all(axis=1)]
    rng = np.random.default_rng(0)
    landmark_id = rng.permutation(5000)[: len(places)]
    searched = rng.permutation(len(places))
    unknown = np.arange(5000, 5020)
    guided = CarryingOnly(
        np.concatenate([landmark_id[searched], unknown]), np.concatenate([places[searched], places[:20]])
    )
    follower = LandmarkFollower(guided)
    moved = np.roll(left, shift[::-1], axis=(0, 1))

    def carried() -> np.ndarray:
        follower.follow(Frame(moved, moved, learned), [], np.eye(4), np.eye(6))
        return guided.start

    assert np.isnan(carried()).all()
    follower.remember(np.zeros_like(left), landmark_id, places + 50.0)
    follower.remember(left, landmark_id, places)
    start = carried()
    assert np.isfinite(start[:-20]).mean() > 0.95
    error = np.linalg.norm(start[:-20] - places[searched] - shift, axis=1)
    assert np.nanmax(error) < 0.5  # starts, from images of half the size
    assert np.isnan(start[-20:]).all()
    follower.forget()
    assert np.isnan(carried()).all()


def test_a_measured_turn_of_the_camera_is_followed(demo: Demo, learned: Frontend):
    """Optical flow alone takes patches for shifted ones."""
    left, camera = cv2.resize(demo[1][0].left, (320, 240)), CarryingOnly.camera
    rows, columns = np.mgrid[60:180:20, 60:260:20]
    places = np.column_stack([columns.ravel(), rows.ravel()]).astype(float)
    turn = rotation_exp(np.array([0.03, -0.05, 0.5]))
    homography = camera.matrix @ turn.T @ np.linalg.inv(camera.matrix)
    turned = cv2.warpPerspective(left, homography, (320, 240))
    expected = cv2.perspectiveTransform(places[:, None], homography)[:, 0]
    guided = CarryingOnly(np.arange(len(places)), expected + 4.0)
    follower = LandmarkFollower(guided)
    follower.remember(left, np.arange(len(places)), places)
    shares = []
    for measured in (None, turn):
        follower.follow(Frame(turned, turned, learned), [], np.eye(4), np.eye(6), measured)
        shares.append(np.mean(np.linalg.norm(guided.start - expected, axis=1) < 0.5))
    assert shares[0] < 0.3
    assert shares[1] > 0.9


def test_a_frame_without_landmarks_carries_none(learned: Frontend):
    guided = CarryingOnly(np.arange(5), np.full((5, 2), 40.0))
    follower = LandmarkFollower(guided)
    blank = np.zeros((96, 96), np.uint8)
    follower.remember(blank, np.zeros(0, np.int64), np.zeros((0, 2)))
    follower.follow(Frame(blank, blank, learned), [], np.eye(4), np.eye(6))
    assert np.isnan(guided.start).all()


# Frames


def arrays_of(view: StereoView) -> dict[str, Any]:
    features = {name: getattr(view.features, name) for name in ("keypoints", "descriptors", "scores", "sigma")}
    own = {name: getattr(view, name) for name in ("left", "right", "disparity", "disparity_sigma", "slope", "behind")}
    return features | own | {f"small {number}": image for number, image in enumerate(view.small)}


def test_the_view_of_a_frame_is_made_once_and_only_if_it_is_asked_for(demo: Demo, learned: Frontend):
    frame, frontend = demo[1][5], CountingFrontend(learned)
    lazy = Frame(frame.left, frame.right, frontend)
    assert frontend.observed == 0
    assert lazy.view is lazy.view
    assert frontend.observed == 1


# The tracker


@pytest.mark.long
def test_features_are_made_of_keyframes_only_once_the_camera_has_started(demo: Demo, learned: Frontend):
    camera, frames, _ = demo
    frontend = CountingFrontend(learned)
    tracker = StereoTracker(camera, frontend, config=OFTEN, threads=1)
    started = track(tracker, frames[: 2 * EVERY : EVERY])
    assert frontend.observed == len(started) == 2
    estimates = track(tracker, frames[2 * EVERY :: EVERY][: FRAMES - 2])
    keyframes = sum(estimate.tracks is not None for estimate in estimates)
    assert frontend.observed == len(started) + keyframes
    assert 2 <= keyframes < 0.5 * len(estimates)
