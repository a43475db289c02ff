"""In mid-run of the demo the right eye sees all landmarks elsewhere: it was bumped, or it is a frame late."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.readers import StereoFrame
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam_benchmarks.live.driver_faults import shift_image, turn_image
from tests.support.estimates import Demo, track

AT = 12
# Rows and columns by which the right eye sees the scene elsewhere than a frame before, in the median.
MOTION = 1.4, 1.9


def bumped_frames(demo: Demo, frames: list[StereoFrame]) -> list[int]:
    """In which the rig is said to have changed."""
    estimates = track(StereoTracker(demo[0], "klt", threads=1), frames)
    return [k for k, each in enumerate(estimates) if Doubt.RIG in each.doubts]


def test_an_eye_that_becomes_late_is_no_bump(demo: Demo):
    frames = demo[1][: AT + 3]
    late = [replace(frame, right=before.right) for before, frame in zip(frames[AT - 1 :], frames[AT:], strict=False)]
    assert bumped_frames(demo, frames[:AT] + late) == []


@pytest.mark.parametrize(
    ("rows", "columns", "degrees"),
    [(3.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 0.3), (*MOTION, 0.0), (-MOTION[0], -MOTION[1], 0.0)],
    ids=["rows", "columns", "turned", "as the scene moved", "against that"],
)
def test_a_bump_is_named_in_its_second_frame(demo: Demo, rows: float, columns: float, degrees: float):
    frames = demo[1][: AT + 3]
    bumped = [replace(each, right=turn_image(shift_image(each.right, rows, columns), degrees)) for each in frames[AT:]]
    assert bumped_frames(demo, frames[:AT] + bumped) == [AT + 1]


def test_what_was_seen_before_a_bump_is_as_if_seen_since(demo: Demo):
    """Loops and relocalisation compare disparities of old keyframes with those of views after it, by one offset."""
    tracker, frames = StereoTracker(demo[0], "klt", threads=1), demo[1]
    track(tracker, frames[:AT])
    before = {each.id: each.view.disparity.copy() for each in tracker._keyframes.active}
    track(tracker, [replace(each, right=shift_image(each.right, 0.0, 2.0)) for each in frames[AT : AT + 2]])
    after = {each.id: each.view.disparity for each in tracker._keyframes.remembered}
    assert before.keys() <= after.keys()
    for id, disparity in before.items():
        moved = after[id] - disparity
        assert np.nanmedian(moved) == pytest.approx(-2.0, abs=0.1)
        assert np.nanmax(moved) - np.nanmin(moved) < 1e-9
