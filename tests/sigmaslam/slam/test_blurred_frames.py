"""A tracker whose images are blurred by motion: where it starts, and what its matches are worth."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from sigmaslam.readers import StereoFrame
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo, statuses
from tests.support.faults import assert_no_pose


def blurred(frame: StereoFrame) -> StereoFrame:
    """Over 25 pixels across."""
    return replace(frame, left=cv2.blur(frame.left, (25, 1)), right=cv2.blur(frame.right, (25, 1)))


@pytest.mark.long
def test_a_blurred_first_view_gives_way_to_a_sharp_one(demo: Demo):
    camera, frames, _ = demo
    tracker = StereoTracker(camera, "klt", threads=1)
    seen = [*map(blurred, frames[:3]), *frames[3:5]]
    estimates = [tracker.step(each.left, each.right, each.timestamp) for each in seen]
    assert statuses(estimates) == ["starting"] * 4 + ["doubtful"]
    for estimate in estimates[:3]:
        assert_no_pose(estimate)
    np.testing.assert_array_equal(estimates[3].T_world_camera, np.eye(4))


@pytest.mark.long
@pytest.mark.parametrize("number", [2, 4])
def test_poses_are_doubtful_for_half_a_second_after_a_shaken_start(demo: Demo, number: int):
    """Whether the image before the first keyframe is blurred or one soon after it; poses stay as they are."""
    camera, frames, _ = demo
    shaken, still = StereoTracker(camera, "klt", threads=1), StereoTracker(camera, "klt", threads=1)
    start = frames[3].timestamp if number == 2 else frames[2].timestamp
    for k, frame in enumerate(frames[2:20], 2):
        shown = blurred(frame) if k == number else frame
        one = shaken.step(shown.left, shown.right, shown.timestamp)
        if k == number:
            continue
        other = still.step(frame.left, frame.right, frame.timestamp)
        if frame.timestamp <= start or k < number:
            assert not one.doubts
        elif frames[k - 1].timestamp < start + 0.5:
            assert (one.status, one.doubts) == ("doubtful", (Doubt.START,))
        else:
            assert (one.status, other.status) == ("tracking", "tracking")
        if number == 2:  # what a blurred frame in mid-run says is another thing
            np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
            assert np.trace(one.covariance) >= (2.0 if one.doubts else 1.0) * np.trace(other.covariance)


@pytest.mark.long
def test_where_all_is_blurred_tracking_starts_after_the_time_that_a_loss_takes(demo: Demo):
    camera, frames, _ = demo
    tracker = StereoTracker(camera, "klt", threads=1)
    for frame in map(blurred, frames):
        estimate = tracker.step(frame.left, frame.right, frame.timestamp)
        waited = frame.timestamp - frames[0].timestamp
        assert estimate.has_pose == (waited >= tracker.config.lost_seconds)
        if estimate.has_pose:
            return
    pytest.fail("never started")


@pytest.mark.long
def test_matches_with_a_blurred_image_are_uncertain_along_the_blur_alone(demo: Demo):
    camera, frames, _ = demo
    tracker, spread = StereoTracker(camera, threads=1), []
    for number, frame in enumerate(frames[:6]):
        shown = blurred(frame) if number == 5 else frame
        tracker.step(shown.left, shown.right, shown.timestamp)
        assert tracker.last_frame is not None
        matches = tracker.last_frame.matches
        assert matches.streaked == (number == 5)
        if len(matches.probability):
            spread.append(np.median(matches.views.covariance, axis=0))
    sharp, streaked = spread[-2:]
    # All matches of a keyframe share a streak of some pixels, and count as one.
    assert streaked[0, 0] > 100.0 * sharp[0, 0]
    assert streaked[1, 1] < 0.05 * streaked[0, 0]
