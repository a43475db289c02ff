"""A driver that delivers an image again."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam.slam.frozen_images import LastPairs, is_noise
from sigmaslam.slam.tracker import StereoTracker
from tests.support.estimates import Demo


def test_one_repeated_image_is_enough_and_a_grey_one_says_nothing():
    noise = np.random.default_rng(0).integers(0, 256, (4, 8, 9), np.uint8)
    pair, grey = LastPairs(), np.full((8, 9), 7, np.uint8)
    assert not pair.is_repeated(noise[0], noise[1])
    assert pair.is_repeated(noise[0], noise[2])
    assert not pair.is_repeated(noise[3], noise[0])
    assert pair.is_repeated(noise[1], noise[0])
    assert not pair.is_repeated(grey, grey)
    assert not pair.is_repeated(grey, grey)


def test_the_same_array_filled_again_is_another_image():
    buffer = np.random.default_rng(0).integers(0, 256, (8, 9), np.uint8)
    pair = LastPairs()
    pair.is_repeated(buffer, buffer)
    buffer ^= 1
    assert not pair.is_repeated(buffer, buffer)


def test_an_eighth_of_an_old_image_is_enough_and_white_rows_say_nothing():
    old, new, newer = np.random.default_rng(1).integers(1, 256, (3, 160, 30), np.uint8)
    old[:60] = new[:60] = newer[:60] = 255
    pair = LastPairs()
    assert not pair.is_repeated(old, old)
    assert not pair.is_repeated(new, new)
    newer[133:] = new[133:]
    assert pair.is_repeated(old ^ 1, newer)


def test_noise_is_no_scene(demo: Demo):
    rng, scene = np.random.default_rng(0), demo[1][0].left
    for level, sigma in ((0.5, 1.0), (3.0, 1.5), (100.0, 20.0)):
        assert is_noise(np.clip(rng.normal(level, sigma, (120, 160)), 0, 255).astype(np.uint8))
    assert not is_noise(scene)
    assert not is_noise(np.clip(scene + rng.normal(0.0, 25.0, scene.shape), 0, 255).astype(np.uint8))
    assert not is_noise(np.full((120, 160), 9, np.uint8))


@pytest.mark.long
def test_frozen_frames_are_skipped_and_tracking_goes_on_where_the_camera_is(demo: Demo):
    camera, frames, _ = demo
    tracker, moving = StereoTracker(camera), StereoTracker(camera)
    for k, frame in enumerate(frames[:20]):
        shown = frames[11] if 12 <= k < 16 else frame
        estimate = tracker.step(shown.left, shown.right, frame.timestamp)
        right = moving.step(frame.left, frame.right, frame.timestamp)
        away = np.linalg.inv(estimate.T_world_camera)[:3] @ right.T_world_camera[:, 3]
        sigma = np.sqrt(np.linalg.eigvalsh(estimate.covariance[:3, :3])[-1])
        assert k == 0 or np.linalg.norm(away) < 4.0 * sigma + 1e-9
        assert estimate.status == ("starting" if k == 0 else "skipped" if 12 <= k < 16 else "tracking")
