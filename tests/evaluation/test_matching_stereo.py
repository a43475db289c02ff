"""Stereo steps and tracks: known geometry, and the rendered sequence with its exact truth."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import rotation_exp, se3_exp
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.matching import load_extractor, score_pairs
from sigmaslam_benchmarks.matching.image_pairs import Homography, ImagePair, Motion, SameRows
from sigmaslam_benchmarks.matching.klt_tracks import TRACKED_KEYPOINTS, follow_corners, score_klt
from sigmaslam_benchmarks.matching.scores import match_rows_refined, score_pair
from sigmaslam_benchmarks.matching.sequence_pairs import sequence_pairs, sequence_steps
from sigmaslam_benchmarks.matching.stereo import StereoStep, estimate_step, is_good, score_steps
from sigmaslam_synthetic.rendering.textures import dead_leaves

SHIFT = 7.3


@pytest.fixture(scope="module")
def texture() -> np.ndarray:
    return cv2.GaussianBlur(dead_leaves((240, 320), np.random.default_rng(3)), (0, 0), 1.0)


@pytest.fixture(scope="module")
def moved(texture: np.ndarray) -> np.ndarray:
    """The texture 7.3 px to the left, as a plane is seen by the right eye."""
    return cv2.warpAffine(texture, np.array([[1.0, 0.0, -SHIFT], [0.0, 1.0, 0.0]]), (320, 240))


def test_refined_rows_are_those_of_the_shift(texture: np.ndarray, moved: np.ndarray):
    orb = load_extractor("orb")
    left, right = orb(texture), orb(moved)
    index, places = match_rows_refined(texture, moved, left, right)
    assert len(index) > 150
    error = places - (left[0][index] - (SHIFT, 0.0))
    assert np.median(np.linalg.norm(error, axis=1)) < 0.1
    found = score_pair(ImagePair("", texture, moved, SameRows()), left, right)
    # Detected to a pixel of its octave, refined to a tenth.
    assert found["rows_refined_1"] > 0.95
    assert found["rows_refined_matches"] == (np.abs(places[:, 1] - left[0][index, 1]) < 1.0).sum()


def test_rows_more_than_two_apart_are_not_matched(texture: np.ndarray):
    lower = np.roll(texture, 4, axis=0)
    orb = load_extractor("orb")
    found = score_pair(ImagePair("", texture, lower, SameRows()), orb(texture), orb(lower))
    assert found["row_matches"] < 60
    assert found["rows_refined_matches"] < 60


def _pose(position: tuple[float, float, float], angle: float) -> np.ndarray:
    """T_1_0 of a camera 1 at a position in camera 0, turned by degrees."""
    T_0_1 = np.eye(4)
    T_0_1[:3, :3], T_0_1[:3, 3] = rotation_exp(np.radians(angle) * np.array([0.0, 0.6, 0.8])), position
    return np.linalg.inv(T_0_1)


def test_a_pose_is_good_within_five_centimetres_and_a_degree():
    truth = _pose((0.3, 0.1, 0.5), 20.0)
    assert is_good(truth, truth)
    assert is_good(_pose((0.34, 0.1, 0.5), 20.9), truth)
    assert not is_good(_pose((0.36, 0.1, 0.5), 20.0), truth)
    assert not is_good(_pose((0.3, 0.1, 0.5), 21.1), truth)


def test_pnp_finds_the_motion_of_exact_points_among_wrong_ones():
    """Two images of noise 20 px apart for the refinement; places are those of points of that disparity."""
    rng = np.random.default_rng(1)
    camera = RectifiedStereo(500.0, 500.0, 320.0, 240.0, 0.2, 640, 480)
    T_1_0 = se3_exp(np.array([0.2, -0.1, 0.4, 0.05, -0.1, 0.02]))
    first = rng.uniform((60, 30), (580, 450), (200, 2))
    points = camera.triangulate(np.column_stack([first, np.full(200, 20.0)]))
    second = camera.project(points @ T_1_0[:3, :3].T + T_1_0[:3, 3])[:, :2]
    second[:60] = rng.uniform((0, 0), (640, 480), (60, 2))
    descriptors = rng.standard_normal((200, 32)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    noise = cv2.GaussianBlur(rng.integers(0, 255, (480, 640), np.uint8), (0, 0), 1.5)
    step = StereoStep("", noise, np.roll(noise, -20, axis=1), noise, camera, T_1_0)
    left = first.astype(np.float32), descriptors
    right = left[0] - np.float32((20.0, 0.0)), descriptors
    found = estimate_step(step, left, right, (second.astype(np.float32), descriptors))
    assert found is not None
    np.testing.assert_allclose(found[0], T_1_0, atol=5e-3)
    assert is_good(found[0], T_1_0)
    assert 100 < found[1] <= 145


def test_steps_without_features_are_not_good(texture: np.ndarray):
    camera = RectifiedStereo(500.0, 500.0, 160.0, 120.0, 0.2, 320, 240)
    step = StereoStep("", texture, texture, texture, camera, np.eye(4))

    def blind(_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((0, 2), np.float32), np.zeros((0, 16), np.float32)

    for judged in (False, True):
        assert score_steps(blind, [step], judged) == {"steps_good": 0.0, "steps": 1.0, "pnp_inliers": 0.0}


@pytest.mark.long
@pytest.mark.parametrize("judged", [False, True], ids=["mutual", "judged"])
@pytest.mark.parametrize("name", ["sift", "orb"])
def test_steps_of_the_rendered_sequence_are_found(demo_sequence: Path, name: str, judged: bool):
    steps = sequence_steps(open_sequence(demo_sequence), demo_sequence / "poses.txt")[:6]
    calls = []
    extract = load_extractor(name)

    def counting(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(image)
        return extract(image)

    found = score_steps(counting, steps, judged)
    assert found["steps_good"] == found["steps"] == 6.0
    assert found["pnp_inliers"] > 50
    # Seven left and six right images, each once.
    assert len(calls) == 13


def test_corners_follow_a_shift(texture: np.ndarray, moved: np.ndarray):
    points0, points1 = follow_corners(texture, moved)
    assert 100 < len(points0) <= TRACKED_KEYPOINTS
    assert np.median(np.linalg.norm(points1 - points0 + (SHIFT, 0.0), axis=1)) < 0.1


def test_klt_is_scored_on_motions_alone_by_their_part(demo_sequence: Path, texture: np.ndarray):
    pairs = sequence_pairs(open_sequence(demo_sequence), demo_sequence / "poses.txt", 20, {1: "gap1", 3: "gap3"})
    pairs.append(ImagePair("", texture, texture, Homography(np.eye(3))))
    found = score_klt(pairs)
    assert list(found) == ["gap1_klt_1", "gap1_klt_matches", "gap3_klt_1", "gap3_klt_matches"]
    assert found["gap1_klt_1"] > 0.8
    assert found["gap1_klt_matches"] > 100
    # More keypoints are allowed in this comparison, and are used.
    tracks = [pair for pair in pairs if isinstance(pair.truth, Motion)]
    few, many = (score_pairs(load_extractor("orb", n), tracks, n)["gap1_epipolar_matches"] for n in (200, 2048))
    assert many > 2 * few
