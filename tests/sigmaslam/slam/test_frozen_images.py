"""A driver that delivers an image again."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.readers import open_sequence
from sigmaslam.readers.selection import Selection
from sigmaslam.slam.frozen_images import LastPairs, is_noise, shows_motion
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam_benchmarks.live.driver_faults import DrivenFrame, freeze_anew, start_of
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
    pair.is_repeated(*pair.of_one_moment(buffer, buffer))
    buffer ^= 1
    assert not pair.is_repeated(*pair.of_one_moment(buffer, buffer))


def test_an_eighth_of_an_old_image_is_enough_and_white_rows_say_nothing():
    old, new, newer = np.random.default_rng(1).integers(1, 256, (3, 160, 30), np.uint8)
    old[:60] = new[:60] = newer[:60] = 255
    pair = LastPairs()
    assert not pair.is_repeated(old, old)
    assert not pair.is_repeated(new, new)
    newer[133:] = new[133:]
    assert pair.is_repeated(old ^ 1, newer)


def test_a_panel_below_all_images_is_no_old_image():
    new = np.random.default_rng(1).integers(1, 256, (9, 160, 30), np.uint8)
    new[:, 120:] = new[0, 120:]
    pairs = LastPairs()
    assert not any(pairs.is_repeated(image, image ^ 1) for image in new)
    assert pairs.is_repeated(new[-1], new[0])


def test_interlaced_images_are_of_the_moment_of_their_even_rows_from_then_on(demo: Demo):
    pairs, shown, (now, later) = LastPairs(), demo[1][0], ((each.left, each.right) for each in demo[1][:2])
    kept = pairs.of_one_moment(shown.left, shown.right)
    assert np.array_equal(kept, now)
    assert not np.shares_memory(kept[0], shown.left)
    odd = np.arange(len(shown.left))[:, None] % 2 == 1
    fields = [np.where(odd, np.roll(other, 6, axis=1), one) for one, other in zip(now, later, strict=True)]
    pairs.of_one_moment(fields[0], now[1])
    assert np.array_equal(pairs.of_one_moment(*now), now), "one eye alone says nothing"
    expected = np.array([pairs.of_one_moment(*images) for images in (fields, now)])
    assert np.array_equal(expected[0, :, :-1], expected[1, :, :-1])
    assert np.array_equal(expected[1, :, ::2], np.array(now)[:, ::2])
    between = expected[1, :, 1:-1:2] - 0.5 * (expected[1, :, :-2:2] + 1.0 * expected[1, :, 2::2])
    assert np.abs(between).max() <= 0.5


def test_noise_gains_of_rows_and_tiny_images_are_not_interlaced(demo: Demo):
    rng, scene = np.random.default_rng(0), demo[1][0].left
    uneven = np.where(np.arange(len(scene))[:, None] % 2 == 1, scene, 0.98 * scene).astype(np.uint8)
    noisy = np.clip(scene + rng.normal(0.0, 25.0, scene.shape), 0, 255).astype(np.uint8)
    noise = rng.integers(0, 256, scene.shape, np.uint8)
    for image in (uneven, noisy, noise, 0 * noise, noise[:1], noise[:2, :5], noise[:5, :1]):
        assert np.array_equal(LastPairs().of_one_moment(image, image), (image, image))
    # In so few rows noise has fields by chance.
    for one, other in rng.integers(0, 256, (20, 2, 48, 64), np.uint8):
        assert np.array_equal(LastPairs().of_one_moment(one, other), (one, other))


def test_a_scene_that_moves_behind_what_stays_is_seen_and_noise_and_light_are_none(demo: Demo):
    rng, scene, later = np.random.default_rng(0), demo[1][0].left, demo[1][6].left
    fixed = cv2.GaussianBlur(rng.normal(0.0, 100.0, scene.shape), (0, 0), 0.8)

    def seen(image: np.ndarray, noise: float, gain: float = 1.0) -> np.ndarray:
        return np.clip(gain * image + fixed + rng.normal(0.0, noise, image.shape), 0, 255).astype(np.uint8)

    assert shows_motion(seen(scene, 2.0), seen(later, 2.0))
    assert not shows_motion(seen(scene, 2.0), seen(scene, 2.0))
    assert not shows_motion(seen(scene, 25.0), seen(scene, 25.0, 0.8))
    assert not shows_motion(scene[:20, :20], later[:20, :20])


@pytest.mark.long
def test_dots_of_a_projector_make_poses_doubtful_and_a_camera_that_stands_does_not(demo: Demo):
    camera, frames, _ = demo
    rng = np.random.default_rng(5)
    dots = np.zeros((240, 360))
    dots[rng.integers(0, 240, 1280), rng.integers(0, 360, 1280)] = 480.0
    dots = cv2.GaussianBlur(dots, (0, 0), 0.8)
    with_dots, standing = StereoTracker(camera), StereoTracker(camera)
    for frame in frames[:8]:
        pair = [
            np.clip(0.6 * image + dots[:, x : x + 320], 0, 255) for image, x in ((frame.left, 0), (frame.right, 12))
        ]
        lit = with_dots.step(pair[0].astype(np.uint8), pair[1].astype(np.uint8), frame.timestamp)
        pair = [np.clip(x + rng.normal(0, 2, x.shape), 0, 255) for x in (frames[0].left, frames[0].right)]
        still = standing.step(pair[0].astype(np.uint8), pair[1].astype(np.uint8), frame.timestamp)
        assert still.status in ("starting", "tracking")
    assert lit.status == "doubtful"
    assert "fixed in the image" in lit.doubts


def test_noise_is_no_scene(demo: Demo):
    rng, scene = np.random.default_rng(0), demo[1][0].left
    for level, sigma in ((0.5, 1.0), (3.0, 1.5), (100.0, 20.0)):
        assert is_noise(np.clip(rng.normal(level, sigma, (120, 160)), 0, 255).astype(np.uint8))
    assert not is_noise(scene)
    assert not is_noise(np.clip(scene + rng.normal(0.0, 25.0, scene.shape), 0, 255).astype(np.uint8))
    assert not is_noise(np.full((120, 160), 9, np.uint8))


@pytest.mark.slow
def test_a_gap_in_a_drive_leaves_no_second_motion_that_the_images_do_not_show(real_data: Path):
    """Eight false matches of the first frame after it became one that parted on: 30 of 30 frames were ambiguous."""
    sequence = open_sequence(real_data / "kitti_raw_0926_0039_a").select(Selection(count=60))
    tracker, frames = StereoTracker(sequence.camera), list(sequence.frames())
    shown = [frames[19] if 20 <= k < 30 else frame for k, frame in enumerate(frames)]
    found = [tracker.step(one.left, one.right, frame.timestamp) for one, frame in zip(shown, frames, strict=True)]
    after = [each.status for each in found[30:]]
    assert after.count("ambiguous") <= 3
    assert after.count("tracking") >= 25


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


@pytest.mark.long
@pytest.mark.data
def test_a_stream_that_goes_on_without_its_shaken_camera_is_doubtful(real_data: Path):
    """At 10 Hz the noise of a hand's motion allows such a stop; poses were 50 mm off at 100 sigmas."""
    sequence = open_sequence(real_data / "euroc_mh01_f000_099").select(Selection(every=2))
    frames = [DrivenFrame(each.index, each.timestamp, each.left, each.right) for each in sequence.frames()]
    tracker, first = StereoTracker(sequence.camera, threads=1), start_of(frames)
    delivered = freeze_anew(7, frames, np.random.default_rng(0))[: first + 7]
    statuses = [tracker.step(each.left, each.right, each.timestamp).status for each in delivered]
    assert statuses[1:first] == ["tracking"] * (first - 1)
    assert {*statuses[first:]} <= {"doubtful", "skipped"}
