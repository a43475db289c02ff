"""A tracker that starts in the world of an earlier run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.geometry.se3 import se3_exp
from sigmaslam.slam.start_pose import StartPose
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo


def test_the_first_estimate_is_the_start_also_where_images_are_turned_to_be_rectified(demo: Demo):
    """The pose and the covariance come back as they went in, through the rectified camera."""
    camera, frames, _ = demo
    turned = replace(camera, T_left_right=camera.T_left_right @ se3_exp(np.r_[0, 0, 0, 0.01, 0.02, -0.01]))
    rng = np.random.default_rng(3)
    pose = se3_exp(np.r_[5.0, -2.0, 1.0, 0.4, -0.8, 0.2])
    root = 1e-2 * rng.normal(size=(6, 6))
    tracker = StereoTracker(turned, "klt", start=StartPose(pose, root @ root.T))
    frame = frames[0]
    estimate = tracker.step(frame.left, frame.right, frame.timestamp)
    assert estimate.tracks is not None
    np.testing.assert_allclose(estimate.T_world_camera, pose, atol=1e-9)
    np.testing.assert_allclose(estimate.covariance, root @ root.T, atol=1e-7)


@pytest.mark.long
def test_a_run_in_a_moved_world_is_the_run_moved(demo: Demo):
    """With a start that is certain, all poses are those of a run in its own world, turned and shifted."""
    camera, frames, _ = demo
    pose = se3_exp(np.r_[5.0, -2.0, 1.0, 0.4, -0.8, 0.2])
    here, there = (StereoTracker(camera, "klt", start=StartPose(each, np.zeros((6, 6)))) for each in (np.eye(4), pose))
    for frame in frames[:8]:
        first, second = (each.step(frame.left, frame.right, frame.timestamp) for each in (here, there))
        np.testing.assert_allclose(second.T_world_camera, pose @ first.T_world_camera, atol=1e-4)
        np.testing.assert_allclose(second.covariance, first.covariance, atol=1e-8, rtol=1e-2)
    assert first.status == "tracking"
