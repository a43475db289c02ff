"""A tracker that has seen nothing for a while."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from sigmaslam.slam.relocalisation import Relocaliser
from sigmaslam.slam.tracker import StereoTracker

if TYPE_CHECKING:
    from tests.support.estimates import Demo


@pytest.mark.parametrize(("hidden", "is_asked"), [("frozen", True), ("dark", True), ("none", False)])
def test_the_last_keyframe_is_asked_after_images_that_showed_nothing(
    demo: Demo, monkeypatch: pytest.MonkeyPatch, hidden: str, is_asked: bool
):
    camera, frames, _ = demo
    rng, asked = np.random.default_rng(0), []
    tracker = StereoTracker(camera, threads=1)
    monkeypatch.setattr(Relocaliser, "relocalise", lambda self, view, after_gap: asked.append(after_gap))
    for frame in frames[:4]:
        tracker.step(frame.left, frame.right, frame.timestamp)
    for frame in frames[4:7]:
        if hidden == "frozen":
            tracker.step(frames[3].left, frames[3].right, frame.timestamp)
        if hidden == "dark":
            tracker.step(*rng.integers(0, 4, (2, *frame.left.shape), np.uint8), frame.timestamp)
    asked.clear()
    # As after a long way: nothing is where it is expected.
    frame = frames[4 if hidden == "none" else 7]
    tracker.step(np.flipud(frame.left).copy(), np.flipud(frame.right).copy(), frame.timestamp)
    assert asked == [is_asked]


def test_landmarks_seen_across_a_gap_are_asked_once(demo: Demo):
    camera, frames, _ = demo
    tracker = StereoTracker(camera, threads=1)
    for frame in frames[:8]:
        tracker.step(frame.left, frame.right, frame.timestamp)
    known = tracker.last_frame.landmark
    across = tracker.step(frames[19].left, frames[19].right, frames[19].timestamp)
    assert across.status == "tracking"
    assert np.isin(tracker.last_frame.landmark, known).sum() > 100
    tracker.step(frames[20].left, frames[20].right, frames[20].timestamp)
    assert not np.isin(tracker.last_frame.landmark, known).any()
