"""Scores of matching against known answers."""

import numpy as np
import pytest

from sigmaslam.evaluation.matching.pairs import Disparity, Homography, ImagePair, Motion, SameRows, Truth
from sigmaslam.evaluation.matching.scores import (
    area_under_curve,
    mutual_nearest,
    pose_error_deg,
    score_pair,
    summarize,
)
from sigmaslam.rotation import rotation_exp

IMAGE = np.zeros((480, 640), np.uint8)
K = np.array([[570.0, 0.0, 320.0], [0.0, 560.0, 240.0], [0.0, 0.0, 1.0]])


def _grid() -> np.ndarray:
    """Keypoints 20 px apart."""
    return np.stack(np.meshgrid(np.arange(40, 600, 20), np.arange(40, 440, 20)), axis=-1).reshape(-1, 2) + 0.3


def _descriptors(count: int) -> np.ndarray:
    descriptors = np.random.default_rng(0).normal(size=(count, 64)).astype(np.float32)
    return descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)


def _score(truth: Truth, keypoints0: np.ndarray, keypoints1: np.ndarray) -> dict[str, float]:
    """Scores where keypoint i matches keypoint i."""
    descriptors = _descriptors(len(keypoints0))
    return score_pair(ImagePair("", IMAGE, IMAGE, truth), (keypoints0, descriptors), (keypoints1, descriptors))


def test_the_same_keypoints_under_the_identity_are_perfect():
    found = _score(Homography(np.eye(3)), _grid(), _grid())
    assert found.pop("correct_3") == len(_grid())
    assert found.pop("corner_error") < 1e-6
    assert found == {"mma_1": 1.0, "mma_3": 1.0, "repeatability_1": 1.0}


def test_two_pixels_off_is_right_at_three_and_wrong_at_one():
    found = _score(Homography(np.eye(3)), _grid(), _grid() + (2.0, 0.0))
    assert found["mma_1"] == 0.0
    assert found["mma_3"] == 1.0
    assert found["repeatability_1"] == 0.0
    assert found["corner_error"] == pytest.approx(2.0, abs=1e-4)


def test_keypoints_that_leave_the_image_do_not_count_against_repeatability():
    shift = np.array([[1.0, 0.0, 300.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    moved = _grid() + (300.0, 0.0)
    inside = moved[:, 0] < 632
    descriptors = _descriptors(len(moved))
    pair = ImagePair("", IMAGE, IMAGE, Homography(shift))
    found = score_pair(pair, (_grid(), descriptors), (moved[inside], descriptors[inside]))
    assert found["repeatability_1"] == 1.0
    assert found["mma_1"] == pytest.approx(1.0, abs=0.3)


def test_points_without_disparity_are_left_out():
    disparity = np.full(IMAGE.shape, 10.0)
    disparity[:, 320:] = np.nan
    right = _grid() - (10.0, 0.0)
    right[_grid()[:, 0] > 320] += 100.0
    found = _score(Disparity(disparity, np.eye(3), np.eye(3)), _grid(), right)
    assert found["mma_1"] == 1.0
    assert found["correct_3"] == (_grid()[:, 0] < 319).sum()


def test_rows_are_all_that_counts_without_disparity():
    right = _grid() - (30.0, 0.0)
    right[::4, 1] += 1.5
    found = _score(SameRows(), _grid(), right)
    assert found["rows_1"] == pytest.approx(0.75)
    assert found["row_matches"] == 0.75 * len(_grid())


def test_hamming_distance_of_bits_gives_the_same_neighbours_as_counting():
    generator = np.random.default_rng(1)
    bits0, bits1 = generator.integers(0, 256, (2, 40, 32), np.uint8)
    bits1[:20] = bits0[20:] ^ 1
    distance = np.bitwise_count(bits0[:, None] ^ bits1[None]).sum(axis=2, dtype=int)
    index0, index1 = mutual_nearest(bits0, bits1)
    assert set(zip(range(20, 40), range(20), strict=True)) <= set(zip(index0, index1, strict=True))
    assert (distance[index0, index1] == distance[index0].min(axis=1)).all()
    assert (distance[index0, index1] == distance[:, index1].min(axis=0)).all()


def test_no_keypoints_score_zero():
    none, no_descriptors = np.zeros((0, 2), np.float32), np.zeros((0, 64), np.float32)
    for truth in (Homography(np.eye(3)), Motion(K, _motion()), SameRows()):
        pair = ImagePair("", IMAGE, IMAGE, truth)
        for features in ((none, no_descriptors), (_grid(), _descriptors(len(_grid())))):
            found = summarize([score_pair(pair, features, (none, no_descriptors))])
            assert set(found.values()) == {0.0}


def test_area_under_the_curve_of_known_errors():
    assert area_under_curve([0.0, 0.0], 3) == 1.0
    assert area_under_curve([1.5], 3) == 0.5
    assert area_under_curve([0.0, 3.0, np.inf], 3) == pytest.approx(1 / 3)
    assert area_under_curve([np.inf], 10) == 0.0


def _motion(angle: float = 0.1) -> np.ndarray:
    T_1_0 = np.eye(4)
    T_1_0[:3, :3], T_1_0[:3, 3] = rotation_exp(angle * np.array([0.6, 0.8, 0.0])), (0.5, 0.1, 0.2)
    return T_1_0


def _views(T_1_0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of 300 points in both images, a fifth of them wrong in the second."""
    generator = np.random.default_rng(2)
    points = generator.uniform((-3, -2, 4), (3, 2, 12), (300, 3))
    pixels = [p / p[:, 2:] @ K[:2].T for p in (points, points @ T_1_0[:3, :3].T + T_1_0[:3, 3])]
    pixels[1][:60] = generator.uniform(0, 480, (60, 2))
    return pixels[0], pixels[1]


def test_the_pose_of_exact_points_has_no_error_and_a_wrong_truth_shows_its_angle():
    pixels = _views(_motion())
    assert pose_error_deg(*pixels, Motion(K, _motion())) < 0.2
    turned = _motion(0.1 + np.radians(3.0))
    assert pose_error_deg(*pixels, Motion(K, turned)) == pytest.approx(3.0, abs=0.2)
    opposite = _motion()
    opposite[:3, 3] *= -1
    assert pose_error_deg(*pixels, Motion(K, opposite)) == pytest.approx(180.0, abs=0.2)
    assert pose_error_deg(pixels[0][:4], pixels[1][:4], Motion(K, _motion())) == np.inf


def test_epipolar_distance_is_the_distance_from_the_line():
    motion = Motion(K, _motion())
    pixels0, pixels1 = (pixels[60:] for pixels in _views(_motion()))
    np.testing.assert_allclose(motion.epipolar_distance(pixels0, pixels1), 0.0, atol=1e-9)
    along_u = motion.epipolar_distance(pixels0, pixels1 + (1.0, 0.0))
    along_v = motion.epipolar_distance(pixels0, pixels1 + (0.0, 1.0))
    # The normal of the line has unit length.
    np.testing.assert_allclose(along_u**2 + along_v**2, 1.0, rtol=1e-9)
