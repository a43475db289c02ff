"""Matches are not believed where others agree as well: scenes that repeat themselves, images upside down."""

import logging
from pathlib import Path

import cv2
import numpy as np
import pytest

import sigmaslam
from sigmaslam.frontend.rival_matches import count_rivals, share_with_rivals
from sigmaslam.frontend.types import Features
from sigmaslam_synthetic.rendering.textures import dead_leaves

DEMO = Path(__file__).resolve().parents[3] / "synthetic/sigmaslam_synthetic/demo/image_0"


def features(keypoints: np.ndarray, descriptors: np.ndarray) -> Features:
    count = len(keypoints)
    unit = descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    ones = np.ones(count, np.float32)
    return Features(keypoints.astype(np.float32), unit.astype(np.float32), ones, ones)


def noisy(image: np.ndarray, seed: int) -> np.ndarray:
    """Blurred a little, so that corners are where a lens puts them."""
    noise = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(cv2.GaussianBlur(image.astype(float), (0, 0), 0.7) + noise, 0, 255).astype(np.uint8)


def test_rivals_are_alike_and_elsewhere():
    """Of one keypoint: its match, a like one 5 px from that, two like ones afar, and an unlike one."""
    a, b = np.eye(2)
    first = features(np.zeros((1, 2)), a[None])
    second = features(
        np.array([[10.0, 0.0], [15.0, 0.0], [40.0, 0.0], [0.0, 40.0], [60.0, 60.0]]), np.array([a, a, a, a, a + b])
    )
    assert count_rivals(first, second, np.array([0]), np.array([0])) == [2]


def test_probabilities_are_shared_only_where_most_matches_have_rivals():
    probability, rivals = np.array([0.9, 0.8, 0.9], np.float32), np.array([1, 3, 0])
    np.testing.assert_array_equal(share_with_rivals(probability, rivals, 0.3), probability)
    # What has no rival goes with the others, whose median is one.
    np.testing.assert_allclose(share_with_rivals(probability, rivals, 0.7), [0.45, 0.2, 0.45])


@pytest.mark.long
@pytest.mark.parametrize("frontend", ["learned", "sift", "orb"])
def test_a_checkerboard_moved_by_two_squares_claims_nothing(frontend: str, caplog: pytest.LogCaptureFixture):
    v, u = np.mgrid[:240, :320]
    boards = [np.where(((u + shift) // 20 + v // 20) % 2, 210, 40) for shift in (0, 40)]
    pair = [noisy(board, seed) for seed, board in enumerate(boards)]
    with caplog.at_level(logging.WARNING):
        everything = sigmaslam.match_images(*pair, frontend=frontend, max_keypoints=400, min_probability=0.0)
    assert len(everything.probability) > 20
    assert (everything.probability < 0.5).all()
    assert (np.diff(everything.probability) <= 0.0).all()
    assert "repeats itself" in caplog.text


@pytest.mark.long
def test_who_asks_for_certain_matches_alone_hears_of_nothing_upside_down(caplog: pytest.LogCaptureFixture):
    pair = [cv2.imread(str(DEMO / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE) for frame in (0, 20)]
    with caplog.at_level(logging.WARNING):
        found = sigmaslam.match_images(*pair, min_probability=1.0)
    assert (found.probability >= 1.0).all()
    assert "upside down" not in caplog.text


@pytest.mark.long
def test_an_image_upside_down_claims_nothing_and_says_so(caplog: pytest.LogCaptureFixture):
    """Rings look the same upside down: of 62 probable matches 59 are wrong without the doubt."""
    image, rng = noisy(dead_leaves((360, 480), np.random.default_rng(3)), 0), np.random.default_rng(1)
    for u, v, radius, grey in rng.uniform((40, 40, 5, 0), (440, 320, 16, 255), (40, 4)).astype(int).tolist():
        cv2.circle(image, (u, v), radius, grey, 3, cv2.LINE_AA)
        cv2.circle(image, (u, v), radius // 2, 255 - grey, -1, cv2.LINE_AA)
    with caplog.at_level(logging.WARNING):
        found = sigmaslam.match_images(image, image[::-1, ::-1].copy())
    wrong = np.linalg.norm(found.keypoints1 - ((479.0, 359.0) - found.keypoints0), axis=1) > 3.0
    assert wrong.sum() < 5
    assert "by 180 degrees" in caplog.text


@pytest.mark.long
def test_a_scene_without_repetition_keeps_its_probabilities(caplog: pytest.LogCaptureFixture):
    image = noisy(dead_leaves((240, 320), np.random.default_rng(3)), 0)
    with caplog.at_level(logging.WARNING):
        found = sigmaslam.match_images(image, noisy(np.roll(image, 12, axis=1), 1), max_keypoints=400)
    assert found.probability.sum() > 100
    assert not caplog.records


@pytest.mark.long
@pytest.mark.parametrize(("other", "is_said"), [(3, True), (4, False)])
def test_an_image_upside_down_of_which_nothing_matches_is_said(
    caplog: pytest.LogCaptureFixture, other: int, is_said: bool
):
    """Of another scene nothing is."""
    image, seen = (noisy(dead_leaves((240, 320), np.random.default_rng(seed)), seed) for seed in (3, other))
    with caplog.at_level(logging.WARNING):
        found = sigmaslam.match_images(image, seen[::-1, ::-1].copy(), max_keypoints=400)
    assert found.probability.sum() < 8
    assert ("turn it by 180 degrees" in caplog.text) == is_said
