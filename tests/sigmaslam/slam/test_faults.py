"""Faults injected into the rendered sequence: the right status, and never a confident wrong pose."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from sigmaslam import StereoTracker
from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.readers import StereoFrame
from tests.support.estimates import Demo, position_sigma, squared_error, statuses, track
from tests.support.faults import Pair, assert_honest, assert_no_pose, broken, changed
from tests.support.quantiles import WITHIN_3_SIGMA


def noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    return rng.integers(0, 256, shape, dtype=np.uint8)


def clouds(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Noise with blobs of a few pixels, which keypoints like."""
    smooth = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), 2)
    return np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def covered(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """What a sensor gives behind a cap."""
    return np.clip(np.rint(rng.normal(4, 2, shape)), 0, 255).astype(np.uint8)


# ---- nothing to see


@pytest.mark.slow
def test_a_second_of_black_is_lost_and_ends(demo: Demo):
    camera, frames, truth = demo
    black = np.zeros_like(frames[0].left)
    estimates = track(StereoTracker(camera), broken(frames, range(10, 30), lambda frame: (black, black)))
    assert statuses(estimates[10:30]) == ["lost"] * 20
    assert (np.diff([position_sigma(estimate) for estimate in estimates[9:30]]) > 0).all()
    assert all(squared_error(estimates[k], truth[k]) < WITHIN_3_SIGMA for k in range(10, 30))
    assert statuses(estimates[30:]) == ["tracking"] * 10
    assert_honest(estimates, truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    "texture",
    [noise, clouds, covered],
)
def test_noise_only_images_are_lost(demo: Demo, texture: Callable[..., np.ndarray]):
    """Independent in both eyes and all frames; the uncertainty grows, and tracking goes on after it."""
    camera, frames, truth = demo
    rng = np.random.default_rng(3)
    shape = frames[0].left.shape
    estimates = track(
        StereoTracker(camera), broken(frames, range(10, 25), lambda frame: (texture(shape, rng), texture(shape, rng)))
    )
    assert statuses(estimates[10:25]) == ["lost"] * 15
    assert position_sigma(estimates[24]) > 10 * position_sigma(estimates[9])
    assert all(squared_error(estimates[k], truth[k]) < WITHIN_3_SIGMA for k in range(10, 25))
    assert estimates[-1].status == "tracking"
    assert_honest(estimates, truth)


@pytest.mark.long
@pytest.mark.parametrize("texture", [noise, clouds, covered])
def test_noise_from_the_start_is_no_start(demo: Demo, texture: Callable[..., np.ndarray]):
    camera, frames, truth = demo
    rng = np.random.default_rng(4)
    shape = frames[0].left.shape
    estimates = track(
        StereoTracker(camera), broken(frames[:10], range(5), lambda frame: (texture(shape, rng), texture(shape, rng)))
    )
    assert statuses(estimates) == ["starting"] * 6 + ["tracking"] * 4
    assert_honest(estimates, se3_inverse(truth[5]) @ truth)
    for estimate in estimates[:5]:
        assert_no_pose(estimate)
    # The frame that defines the world is where it is, by definition.
    np.testing.assert_array_equal(estimates[5].T_world_camera, np.eye(4))
    np.testing.assert_array_equal(estimates[5].covariance, np.zeros((6, 6)))


# ---- frames and their times


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_third_of_the_frames_may_drop_out(demo: Demo, seed: int):
    camera, frames, truth = demo
    kept = np.flatnonzero(np.random.default_rng(seed).random(len(frames)) > 0.3)
    estimates = track(StereoTracker(camera), [frames[k] for k in kept])
    assert statuses(estimates[1:]) == ["tracking"] * (len(kept) - 1)
    assert_honest(estimates, se3_inverse(truth[kept[0]]) @ truth[kept])


@pytest.mark.long
def test_time_going_backwards_is_refused_and_the_next_good_frame_tracked(demo: Demo):
    camera, frames, truth = demo
    tracker = StereoTracker(camera)
    estimates = [tracker.step(frame.left, frame.right, frame.timestamp) for frame in frames[:5]]
    for timestamp in (frames[4].timestamp, frames[2].timestamp, -1.0):
        with pytest.raises(InputError, match="sort the frames by time"):
            tracker.step(frames[5].left, frames[5].right, timestamp)
    estimates += [tracker.step(frame.left, frame.right, frame.timestamp) for frame in frames[5:9]]
    assert statuses(estimates[1:]) == ["tracking"] * 8
    assert_honest(estimates, truth)
    untroubled = track(StereoTracker(camera), frames[:9])
    np.testing.assert_array_equal(estimates[-1].T_world_camera, untroubled[-1].T_world_camera)


# ---- eyes


@pytest.mark.slow
def test_swapped_eyes_from_the_start_are_no_start(demo: Demo):
    camera, frames, truth = demo
    estimates = track(StereoTracker(camera), broken(frames[:20], range(10), lambda frame: (frame.right, frame.left)))
    assert statuses(estimates) == ["starting"] * 11 + ["tracking"] * 9
    assert_honest(estimates, se3_inverse(truth[10]) @ truth)


@pytest.mark.slow
def test_eyes_swapped_in_mid_run_are_lost_until_they_are_put_right(demo: Demo):
    camera, frames, truth = demo
    estimates = track(StereoTracker(camera), broken(frames, range(12, 28), lambda frame: (frame.right, frame.left)))
    assert statuses(estimates[12:28]) == ["lost"] * 16
    assert statuses(estimates[28:]) == ["tracking"] * 12
    assert_honest(estimates, truth)


@pytest.mark.slow
@pytest.mark.parametrize("cap", ["constant", "dark"])
def test_with_the_right_eye_covered_the_left_one_goes_on(demo: Demo, cap: str):
    camera, frames, truth = demo
    rng = np.random.default_rng(5)

    def fault(frame: StereoFrame) -> Pair:
        shape = frame.left.shape
        return frame.left, np.full(shape, 128, np.uint8) if cap == "constant" else covered(shape, rng)

    estimates = track(StereoTracker(camera), broken(frames, range(12, 22), fault))
    assert statuses(estimates[1:]) == ["tracking"] * 39
    assert_honest(estimates, truth)


@pytest.mark.slow
@pytest.mark.parametrize("eyes", ["left", "both"])
def test_with_the_left_eye_or_both_covered_the_tracker_is_lost(demo: Demo, eyes: str):
    camera, frames, truth = demo
    rng = np.random.default_rng(6)

    def fault(frame: StereoFrame) -> Pair:
        dark = covered(frame.left.shape, rng)
        return dark, frame.right if eyes == "left" else covered(frame.left.shape, rng)

    estimates = track(StereoTracker(camera), broken(frames, range(12, 22), fault))
    assert statuses(estimates[12:22]) == ["lost"] * 10
    assert all(squared_error(estimates[k], truth[k]) < WITHIN_3_SIGMA for k in range(12, 22))
    assert statuses(estimates[22:]) == ["tracking"] * 18
    assert_honest(estimates, truth)


# ---- light and blur


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.4, 1.8])
def test_a_step_of_the_exposure_is_survived(demo: Demo, gain: float):
    camera, frames, truth = demo

    def exposed(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(gain * image.astype(float)), 0, 255).astype(np.uint8)

    estimates = track(StereoTracker(camera), changed(frames, range(12, 40), exposed))
    assert estimates[-1].status == "tracking"
    assert_honest(estimates, truth)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(11, 1), (1, 11), (21, 1)])
def test_motion_blur_along_a_line_is_survived(demo: Demo, width: int, height: int):
    """A symmetric kernel in both eyes: centres stay where they are."""
    camera, frames, truth = demo

    def blurred(image: np.ndarray) -> np.ndarray:
        return cv2.blur(image, (width, height))

    estimates = track(StereoTracker(camera), changed(frames, range(12, 18), blurred))
    assert estimates[-1].status == "tracking"
    assert_honest(estimates, truth)


@pytest.mark.slow
def test_an_exposure_over_five_frames_is_survived(demo: Demo):
    """Average of five consecutive frames; the pose is the mean of the five.

    Harder than what a camera does: exposures overlap, so that neighbours share four of five instants, at rest.
    """
    camera, frames, truth = demo

    def average(frame: StereoFrame) -> Pair:
        k = frames.index(frame)
        near = frames[k - 2 : k + 3]
        left, right = (np.mean([getattr(each, eye) for each in near], axis=0) for eye in ("left", "right"))
        return np.rint(left).astype(np.uint8), np.rint(right).astype(np.uint8)

    which = range(12, 22)
    expected = truth.copy()
    for k in which:
        mean = np.mean([se3_log(se3_inverse(truth[k]) @ truth[j]) for j in range(k - 2, k + 3)], axis=0)
        expected[k] = truth[k] @ se3_exp(mean)
    estimates = track(StereoTracker(camera), broken(frames, which, average))
    assert estimates[-1].status == "tracking"
    assert_honest(estimates, expected)


# ---- no motion


@pytest.mark.slow
def test_thirty_seconds_without_motion_are_without_drift(demo: Demo):
    """Fresh sensor noise of two grey values in each of 150 frames at 5 Hz.

    The drift is the mean of the last second against the start; single frames also have noise of their own.
    """
    camera, frames, _ = demo
    rng = np.random.default_rng(1)

    def noisy(image: np.ndarray) -> np.ndarray:
        return np.clip(np.rint(image + rng.normal(0, 2, image.shape)), 0, 255).astype(np.uint8)

    still = [StereoFrame(k, 0.2 * k, noisy(frames[0].left), noisy(frames[0].right)) for k in range(151)]
    estimates = track(StereoTracker(camera), still)
    assert statuses(estimates[1:]) == ["tracking"] * 150
    assert_honest(estimates, np.tile(np.eye(4), (151, 1, 1)))
    errors = np.array([se3_log(estimate.T_world_camera) for estimate in estimates])
    drift = errors[-5:].mean(axis=0)
    assert np.linalg.norm(drift[:3]) < 2e-4
    assert np.rad2deg(np.linalg.norm(drift[3:])) < 0.02
    # The keyframe's own noise is common to all frames and does not average out.
    claimed = np.array([position_sigma(estimate) for estimate in estimates[1:]])
    assert claimed.min() > np.sqrt((errors[1:, :3] ** 2).sum(axis=1).mean())
    assert claimed[-50:].max() < 1.5 * claimed[:50].max()
