"""Scores of matching against known answers."""

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam_benchmarks.matching.image_pairs import Disparity, Homography, ImagePair, Motion, SameRows, Truth
from sigmaslam_benchmarks.matching.scores import (
    area_under_curve,
    corner_error,
    mutual_nearest,
    pose_error_deg,
    score_pair,
    score_points,
    summarize,
)

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
    assert found.pop("polished_corner_error") < 1e-6
    assert found == {"mma_1": 1.0, "mma_3": 1.0, "repeatability_1": 1.0}


def test_two_pixels_off_is_right_at_three_and_wrong_at_one():
    found = _score(Homography(np.eye(3)), _grid(), _grid() + (2.0, 0.0))
    assert found["mma_1"] == 0.0
    assert found["mma_3"] == 1.0
    assert found["repeatability_1"] == 0.0
    assert found["corner_error"] == pytest.approx(2.0, abs=1e-4)
    assert found["polished_corner_error"] == pytest.approx(2.0, abs=1e-4)


TRUTHS = {
    "homography": Homography(np.eye(3)),
    "disparity": Disparity(np.full(IMAGE.shape, 10.0), np.eye(3), np.eye(3)),
    "rows": SameRows(),
    "motion": Motion(K, np.block([[np.eye(3), np.array([[0.5], [0.1], [0.2]])], [np.zeros((1, 3)), np.ones((1, 1))]])),
}


@pytest.mark.parametrize("truth", TRUTHS.values(), ids=TRUTHS)
def test_points_score_as_the_features_that_match_so(truth: Truth):
    """All but what is asked of keypoints alone, or of other matches."""
    points1 = _grid() - (10.0, 0.0) + np.random.default_rng(5).normal(0.0, 1.0, _grid().shape)
    of_features = _score(truth, _grid(), points1)
    of_points = score_points(ImagePair("", IMAGE, IMAGE, truth), _grid(), points1)
    assert of_points == {name: of_features[name] for name in of_points}
    assert set(of_features) - set(of_points) <= {"repeatability_1", "rows_refined_1", "rows_refined_matches"}


def _plane(seed: int, noise: float = 0.5, outliers: float = 0.3) -> tuple[np.ndarray, np.ndarray, Homography]:
    """The grid under a homography, with noise in pixels and a share of wrong places."""
    rng = np.random.default_rng(seed)
    truth = Homography(np.array([[0.9, -0.2, 80.0], [0.15, 1.0, -20.0], [2e-4, -1e-4, 1.0]]))
    points1 = truth.transfer(_grid()) + rng.normal(0.0, noise, _grid().shape)
    wrong = rng.random(len(points1)) < outliers
    points1[wrong] = rng.uniform((0, 0), (640, 480), (int(wrong.sum()), 2))
    return _grid(), points1, truth


def test_of_exact_points_the_polished_homography_errs_less_than_that_of_magsac():
    pairs = [_plane(seed, noise=0.03, outliers=0.6) for seed in range(10)]
    scores = [score_points(ImagePair("", IMAGE, IMAGE, truth), *points) for *points, truth in pairs]
    plain, polished = (np.array([found[key] for found in scores]) for key in ("corner_error", "polished_corner_error"))
    assert np.median(polished) < 0.8 * np.median(plain)
    assert polished.max() < 0.05


@pytest.mark.parametrize(("method", "threshold"), [(cv2.USAC_MAGSAC, 1.0), (cv2.USAC_ACCURATE, 1.5), (cv2.RANSAC, 1.5)])
def test_corner_errors_are_those_of_the_method_and_the_same_every_time(method: int, threshold: float):
    points0, points1, truth = _plane(0)
    found = corner_error(points0, points1, truth, IMAGE.shape, method, threshold)
    assert found < 3.0
    assert corner_error(points0, points1, truth, IMAGE.shape, method, threshold) == found
    # The method's estimate by hand.
    H, _ = cv2.findHomography(points0, points1, method, threshold, maxIters=10_000, confidence=0.9999)
    corners = np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]])
    expected = np.linalg.norm(Homography(H).transfer(corners) - truth.transfer(corners), axis=1).mean()
    assert found == pytest.approx(expected)
    assert corner_error(points0[:3], points1[:3], truth, IMAGE.shape, method, threshold) == np.inf


def test_errors_become_areas_under_their_own_names():
    pairs = [{"mma_1": share, "corner_error": 1.5, "polished_corner_error": 0.5} for share in (0.2, 0.4)]
    found = summarize(pairs)
    assert found == pytest.approx(
        {
            "mma_1": 0.3,
            "auc_1": 0.0,
            "auc_3": 0.5,
            "auc_5": 0.7,
            "polished_auc_1": 0.5,
            "polished_auc_3": 1.0 - 0.5 / 3.0,
            "polished_auc_5": 0.9,
        }
    )


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
