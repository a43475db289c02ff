"""A clock that was set is told from missing frames by what the image shows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.localisation import Localiser
from sigmaslam.slam.set_clock import Found, by_times, go_back
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo, track

pytestmark = pytest.mark.long

DENSITIES = np.array([0.3, 0.2])


Tracked = tuple[StereoTracker, Callable[[], Found], np.ndarray]


@pytest.fixture
def tracked(demo: Demo) -> Tracked:
    """A tracker after frames of the demo, what finds the next one, and where that is."""
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    turned = tracker.rectifier.T_rectified_left
    frame = Frame(*tracker.rectifier.rectify(frames[12].left, frames[12].right), tracker._frontend)
    localise = partial(tracker._localise, frame, frames[12].timestamp, Stopwatch(), Doubts())
    return tracker, localise, turned @ se3_inverse(truth[0]) @ truth[12] @ se3_inverse(turned)


@pytest.mark.parametrize("speed", [10.0, 0.0], ids=["clock set", "frames missing"])
def test_of_two_times_the_one_that_the_image_shows_is_taken(tracked: Tracked, speed: float):
    tracker, localise, true = tracked
    motion = tracker._motion
    here = motion.step
    motion.set_twist(np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), np.full(6, 1e-3))
    motion.predict(0.5, np.full(2, 1e-4))
    if not speed:  # then the earlier moment is the wrong one
        motion.twist = np.array([-10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker._clock.late = 0.5
    matches, fit, _ = by_times(tracker._localiser, localise)
    assert fit is not None
    assert matches.rival is None
    assert np.linalg.norm(se3_log(fit.pose @ se3_inverse(true))) < 0.02
    np.testing.assert_allclose(motion.step, here, atol=0.02)


def test_where_neither_time_gives_a_pose_the_prediction_spans_both_and_no_more(tracked: Tracked):
    tracker, *_ = tracked
    motion = tracker._motion
    motion.set_twist(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.full(6, 1e-3))
    motion.predict(0.5, np.full(2, 1e-4))
    late, tracker._clock.late = motion.step, 0.5
    assert by_times(tracker._localiser, lambda: (GuidedMatches.empty(), None, None))[1] is None
    sigma = np.sqrt(motion.step_covariance[0, 0])
    away = [late[0, 3] - along - motion.step[0, 3] for along in (0.0, 0.5, 2.0)]
    assert np.abs(away[:2]) / sigma == pytest.approx(np.sqrt(3.0), rel=0.05)  # a uniform density of half a second
    assert abs(away[2]) > 8.0 * sigma  # two seconds ago the camera was elsewhere


def test_a_rival_is_said_and_the_covariance_spans_both(demo: Demo, monkeypatch: pytest.MonkeyPatch):
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    other = np.eye(4)
    other[0, 3] = 1.0

    def with_rival(localiser: Localiser, localise: Callable[[], Found]) -> Found:
        matches, fit, change = localise()
        assert fit is not None
        return replace(matches, rival=other @ fit.pose), fit, change

    monkeypatch.setattr("sigmaslam.slam.tracker.by_times", with_rival)
    estimate = tracker.step(frames[12].left, frames[12].right, frames[12].timestamp)
    assert (estimate.status, list(estimate.doubts)) == ("ambiguous", [Doubt.MOTIONS])
    assert np.linalg.eigvalsh(estimate.covariance)[-1] > 0.9


def test_going_back_is_the_prediction_of_an_earlier_moment():
    """But for what the spread of the velocity bends it by."""
    motion, earlier = moving(), moving()
    motion.predict(0.5, DENSITIES)
    earlier.predict(0.2, DENSITIES)
    covariance = motion.step_covariance.copy()
    motion.widen(4.0)
    state, step = motion.state, motion.step.copy()
    go_back(motion, 0.3)
    np.testing.assert_allclose(motion.step, earlier.step, atol=5e-3)
    np.testing.assert_allclose(motion.step_covariance, covariance)
    motion.restore(state, 4.0)
    np.testing.assert_array_equal(motion.step, step)
    np.testing.assert_array_equal(motion.predicted_covariance, covariance)


def moving() -> MotionFilter:
    """A filter that has seen some frames: pose and twist are correlated."""
    motion = MotionFilter()
    motion.set_twist(np.array([0.2, -0.1, 1.0, 0.05, 0.1, -0.02]), np.repeat([0.3, 0.1], 3))
    for _ in range(3):
        motion.predict(0.1, DENSITIES)
    return motion
