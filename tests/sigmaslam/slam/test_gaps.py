"""A tracker that has seen nothing for a while."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from sigmaslam.readers import open_sequence
from sigmaslam.slam.relocalisation import Relocaliser
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import track

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


@pytest.mark.long
@pytest.mark.parametrize("pause", [60.0, 3600.0])
def test_another_scene_after_a_pause_is_tracked(real_data: Path, pause: float):
    """Nothing of the window is seen again: the way in between is unknown, and nothing in the new scene is doubtful."""
    sequence = open_sequence(real_data / "kitti_raw_0926_0039_a")
    frames = list(sequence.frames())
    frames = frames[:12] + [replace(each, timestamp=each.timestamp + pause) for each in frames[150:168]]
    estimates = track(StereoTracker(sequence.camera, threads=1), frames)
    assert [each.status for each in estimates[-10:]] == ["tracking"] * 10
    assert all(np.isfinite(each.covariance).all() for each in estimates[-10:])
    assert np.sqrt(np.trace(estimates[-1].covariance[:3, :3])) > 100.0


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
