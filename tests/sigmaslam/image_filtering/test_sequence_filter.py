"""The filter over time: a known answer where nothing moves, and no trace of what moved away."""

import cv2
import numpy as np
import pytest

from sigmaslam.image_filtering import NoiseModel, SequenceFilter, filter_both_ways
from sigmaslam.image_filtering.sequence_filter import _excess

SIGMA = 20.0


@pytest.fixture(scope="module")
def scene() -> np.ndarray:
    texture = cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 1.0, (160, 240)), (0, 0), 3.0)
    return 120.0 + 30.0 * texture / texture.std()


def noisy(scene: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return scene + rng.normal(0.0, SIGMA, scene.shape)


def error(estimate: np.ndarray, truth: np.ndarray, margin: int = 12) -> float:
    inner = slice(margin, -margin)
    return float(np.sqrt(np.mean((estimate - truth)[inner, inner] ** 2)))


def test_the_first_frame_is_its_own_state(scene: np.ndarray):
    follow = SequenceFilter(NoiseModel(SIGMA))
    image = noisy(scene, np.random.default_rng(0))
    follow.step(image)
    mean, variance = follow.state
    np.testing.assert_allclose(mean, image, rtol=1e-5)
    np.testing.assert_allclose(variance, SIGMA**2, rtol=1e-4)


@pytest.mark.parametrize("grey", [0.0, 120.0, 255.0])
def test_noise_is_that_of_the_first_image_that_shows_something(scene: np.ndarray, grey: float):
    """Not of a lens cap, or of a fade-in's white."""
    rng, follow = np.random.default_rng(0), SequenceFilter()
    for _ in range(2):
        follow.step(np.clip(np.rint(grey + rng.normal(0.0, 0.5, scene.shape)), 0, 255).astype(np.uint8))
    for _ in range(2):
        shown = follow.step(np.clip(np.rint(noisy(scene, rng)), 0, 255).astype(np.uint8))
        assert follow.noise is not None
        assert follow.noise.sigma == pytest.approx(SIGMA, rel=0.15)
    assert error(shown, scene) < 0.5 * SIGMA


def test_a_scene_at_rest_grows_surer_and_the_variance_says_how_sure(scene: np.ndarray):
    rng, follow, errors = np.random.default_rng(0), SequenceFilter(NoiseModel(SIGMA)), []
    for _ in range(8):
        errors.append(error(follow.step(noisy(scene, rng)), scene))
    mean, variance = follow.state
    assert error(mean, scene) < 0.65 * SIGMA
    assert errors[-1] < 0.8 * errors[0]
    nees = np.mean((mean - scene) ** 2 / variance)
    assert 0.5 < nees < 1.5


def test_a_moving_scene_is_followed(scene: np.ndarray):
    rng, follow, errors = np.random.default_rng(0), SequenceFilter(NoiseModel(SIGMA)), []
    for k in range(7):
        shifted = cv2.warpAffine(scene, np.float32([[1, 0, 2.5 * k], [0, 1, 0]]), (240, 160), flags=cv2.INTER_CUBIC)
        errors.append(error(follow.step(noisy(shifted, rng))[:, 40:], shifted[:, 40:]))
    assert errors[-1] < 0.85 * errors[0]


def test_what_vanishes_leaves_no_ghost(scene: np.ndarray):
    rng, follow = np.random.default_rng(0), SequenceFilter(NoiseModel(SIGMA))
    covered = scene.copy()
    covered[60:100, 90:150] = 230.0
    for _ in range(6):
        follow.step(noisy(covered, rng))
    after = follow.step(noisy(scene, rng))
    inside = (slice(64, 96), slice(94, 146))
    alone = SequenceFilter(NoiseModel(SIGMA)).step(noisy(scene, rng))
    assert abs(float((after - scene)[inside].mean())) < 3.0
    assert np.sqrt(np.mean((after - scene)[inside] ** 2)) < 1.3 * np.sqrt(np.mean((alone - scene)[inside] ** 2))


def test_white_innovations_have_little_excess():
    innovation = np.random.default_rng(0).normal(0.0, 10.0, (200, 200)).astype(np.float32)
    expected = np.full((200, 200), 100.0, np.float32)
    share = _excess(innovation, expected, 0.5 * expected) > 0
    assert share.mean() < 0.2  # two windows, each with the upper tail of 1.5 sigma
    assert (_excess(innovation + 40.0, expected, 0.5 * expected) > 40.0**2 - 100.0).mean() > 0.99


def test_the_noise_is_estimated_from_the_first_frame(scene: np.ndarray):
    follow = SequenceFilter()
    follow.step(noisy(scene, np.random.default_rng(0)))
    assert follow.noise is not None
    assert follow.noise.variance(np.array(120.0)) == pytest.approx(SIGMA**2, rel=0.25)


def test_another_size_and_a_state_before_the_first_frame_are_refused(scene: np.ndarray):
    follow = SequenceFilter(NoiseModel(SIGMA))
    with pytest.raises(ValueError, match="call step"):
        _ = follow.state
    follow.step(scene)
    with pytest.raises(ValueError, match="240, 159"):
        follow.step(scene[:-1])


def test_frames_before_and_after_leave_no_ghost_and_tell_more(scene: np.ndarray):
    """Of 20 frames, more than are filtered at once, the first ten and the last two are covered."""
    rng, covered = np.random.default_rng(0), scene.copy()
    covered[60:100, 90:150] = 230.0
    truths = [scene if 10 <= k < 18 else covered for k in range(20)]
    images = [noisy(truth, rng) for truth in truths]
    before = SequenceFilter(NoiseModel(SIGMA))
    alone = [before.step(image) for image in images]
    both = list(filter_both_ways(images, SequenceFilter(NoiseModel(SIGMA))))
    assert len(both) == 20
    inside = (slice(64, 96), slice(94, 146))
    for k in (9, 10, 17, 18):
        single = SequenceFilter(NoiseModel(SIGMA)).step(images[k])
        assert abs(float((both[k] - truths[k])[inside].mean())) < 3.0
        assert np.sqrt(np.mean((both[k] - truths[k])[inside] ** 2)) < 1.3 * np.sqrt(
            np.mean((single - truths[k])[inside] ** 2)
        )
    assert error(both[5], covered) < 0.95 * error(alone[5], covered)
