"""A clock that was set is told from missing frames by what the image shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.set_clock import follow_either, localise_either
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo, track

pytestmark = pytest.mark.long


@pytest.fixture
def tracked(demo: Demo) -> tuple[StereoTracker, Frame, np.ndarray]:
    """A tracker after frames of the demo, the next one, and where that is."""
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    turned = tracker.rectifier.T_rectified_left
    frame = Frame(*tracker.rectifier.rectify(frames[12].left, frames[12].right), tracker._frontend)
    return tracker, frame, turned @ se3_inverse(truth[0]) @ truth[12] @ se3_inverse(turned)


@pytest.mark.parametrize("speed", [10.0, 0.0], ids=["clock set", "frames missing"])
def test_of_two_times_the_one_that_the_image_shows_is_taken(tracked: tuple[StereoTracker, Frame, np.ndarray], speed):
    tracker, frame, true = tracked
    motion = tracker._motion
    here = motion.step
    motion.set_twist(np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), np.full(6, 1e-3))
    motion.predict(0.5, np.full(2, 1e-4))
    if not speed:  # then the earlier moment is the wrong one
        motion.twist = np.array([-10.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    tracker._clock.late, prediction = 0.5, Prediction.of(tracker._window, motion)
    matches, fit = follow_either(tracker._localiser, frame, tracker._keyframes.active, prediction, Stopwatch())
    assert fit is not None
    assert matches.rival is None
    assert np.linalg.norm(se3_log(fit.pose @ se3_inverse(true))) < 0.02
    np.testing.assert_allclose(motion.step, here, atol=0.02)


def test_where_neither_time_gives_a_pose_the_prediction_spans_both(tracked: tuple[StereoTracker, Frame, np.ndarray]):
    tracker, _, _ = tracked
    black = Frame(*np.zeros((2, 240, 320), np.uint8), tracker._frontend).view
    motion = tracker._motion
    motion.set_twist(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]), np.full(6, 1e-3))
    motion.predict(0.5, np.full(2, 1e-4))
    step, tracker._clock.late = motion.step, 0.5
    views = [each.view for each in tracker._keyframes.active]
    assert localise_either(tracker._localiser, black, views, True, Stopwatch())[1] is None
    np.testing.assert_allclose(motion.step, step, atol=1e-12)
    assert motion.step_covariance[0, 0] == pytest.approx(0.25, rel=0.1)


def test_a_rival_is_said_and_the_covariance_spans_both(demo: Demo, monkeypatch: pytest.MonkeyPatch):
    camera, frames, _ = demo
    tracker = StereoTracker(camera)
    track(tracker, frames[:12])
    other = np.eye(4)
    other[0, 3] = 1.0

    def rival(localiser, frame, keyframes, prediction, clock):
        matches, fit = localiser.follow(frame, keyframes, prediction, clock)
        return replace(matches, rival=other @ fit.pose), fit

    monkeypatch.setattr("sigmaslam.slam.tracker.follow_either", rival)
    estimate = tracker.step(frames[12].left, frames[12].right, frames[12].timestamp)
    assert (estimate.status, list(estimate.doubts)) == ("ambiguous", [Doubt.MOTIONS])
    assert np.linalg.eigvalsh(estimate.covariance)[-1] > 0.9
