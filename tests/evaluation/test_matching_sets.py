"""The sets: geometry kept by resizing and warping, real files, errors."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.matching import FINAL, SELECTION, load_extractor, load_set, score_pairs
from sigmaslam_benchmarks.matching.image_pairs import Disparity, Homography, Motion, resize
from sigmaslam_benchmarks.matching.photographs import find_occluded, middlebury, warped_pair
from sigmaslam_benchmarks.matching.sequence_pairs import sequence_pairs
from sigmaslam_synthetic.rendering.textures import dead_leaves


def _spot(height: int, width: int, place: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    squared = (u - place[0]) ** 2 + (v - place[1]) ** 2
    return np.round(255 * np.exp(-squared / (2 * 8.0**2))).astype(np.uint8)


def _centre(image: np.ndarray) -> np.ndarray:
    u, v = np.meshgrid(np.arange(image.shape[1]), np.arange(image.shape[0]))
    return np.array([(u * image).sum(), (v * image).sum()]) / image.sum()


@pytest.mark.parametrize(("height", "width"), [(960, 1281), (1500, 700)])
def test_a_homography_follows_its_resized_images(height: int, width: int):
    # The second image has another size, and the spot is where the homography takes it.
    H = np.array([[0.8, 0.1, 40.0], [-0.1, 0.7, 90.0], [0.0, 0.0, 1.0]])
    place = np.array([400.0, 500.0])
    other = Homography(H).transfer(place[None])[0]
    (image0, S0), (image1, S1) = resize(_spot(height, width, place)), resize(_spot(900, 900, other))
    assert max(image0.shape) == max(image1.shape) == 640
    found = Homography(S1 @ H @ np.linalg.inv(S0)).transfer(_centre(image0)[None])[0]
    np.testing.assert_allclose(found, _centre(image1), atol=0.02)


def test_small_images_are_not_enlarged():
    image = np.zeros((256, 300), np.uint8)
    resized, S = resize(image)
    assert resized is image
    np.testing.assert_array_equal(S, np.eye(3))


def test_disparity_is_read_between_pixels_and_scaled_and_not_across_an_edge():
    u = np.arange(1280.0)
    disparity = np.tile(20.0 + 0.05 * u, (960, 1))
    disparity[:, 1000:] += 30.0
    _, S = resize(np.zeros((960, 1280), np.uint8))
    points = np.array([[100.25, 50.5], [400.0, 300.7], [499.6, 200.0], [-3.0, 5.0]])
    places = Disparity(disparity, S, S).transfer(points)
    stored = 2.0 * points[:2, 0] + 0.5
    np.testing.assert_allclose(places[:2, 0], points[:2, 0] - 0.5 * (20.0 + 0.05 * stored))
    np.testing.assert_allclose(places[:2, 1], points[:2, 1])
    assert np.isnan(places[2:, 0]).all()


def test_what_lies_behind_something_nearer_is_occluded():
    disparity = np.full((1, 40), 2.0)
    disparity[0, 20:30] = 8.0
    # The nearer part lands on 12 to 21; of the farther pixels 14 to 23 land there, those left of 20 are seen.
    hidden = np.flatnonzero(find_occluded(disparity)[0])
    assert hidden.tolist() == [0, 1, *range(14, 20)]


def test_a_warped_pair_shows_the_same_places_and_is_the_same_every_time():
    photograph = dead_leaves((256, 256), np.random.default_rng(0))
    pair = warped_pair(photograph, np.random.default_rng(5), "leaves")
    again = warped_pair(photograph, np.random.default_rng(5), "leaves")
    np.testing.assert_array_equal(pair.image1, again.image1)
    assert isinstance(pair.truth, Homography)
    moved = cv2.warpPerspective(pair.image0, pair.truth.H_1_0, (256, 256))
    seen = cv2.warpPerspective(np.ones((256, 256), np.uint8), pair.truth.H_1_0, (256, 256)) > 0
    assert np.corrcoef(moved[seen], pair.image1[seen])[0, 1] > 0.8
    assert np.corrcoef(pair.image0.ravel(), pair.image1.ravel())[0, 1] < 0.6


def test_pairs_of_the_rendered_sequence_agree_with_its_exact_truth(demo_sequence: Path):
    pairs = sequence_pairs(open_sequence(demo_sequence), demo_sequence / "poses.txt", 20, {1: "gap1", 3: "gap3"})
    assert [pair.part for pair in pairs] == ["", "", "gap1", "gap1", "gap3", "gap3"]
    found = score_pairs(load_extractor("sift"), pairs)
    assert found["rows_1"] > 0.8
    assert found["gap1_epipolar_1"] > 0.85
    assert found["gap3_epipolar_1"] > 0.8


def test_a_missing_folder_or_set_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"homography_boat.*SIGMASLAM_DATA"):
        load_set("boat", tmp_path)
    with pytest.raises(InputError, match=r"'bark'.*churchill"):
        load_set("bark", tmp_path)


def test_a_disparity_file_that_is_none_is_named(tmp_path: Path):
    (tmp_path / "Motorcycle").mkdir()
    (tmp_path / "Motorcycle" / "disp0GT.pfm").write_bytes(b"PF\n2 2\n-1\n")
    with pytest.raises(InputError, match=r"disp0GT\.pfm"):
        middlebury(tmp_path)


@pytest.mark.parametrize(
    ("name", "count", "metric", "least"),
    [
        ("middlebury", 2, "mma_3", 0.6),
        ("boat", 5, "mma_3", 0.5),
        pytest.param("churchill", 5, "mma_3", 0.5, marks=pytest.mark.slow),
        ("fountain", 6, "pose_auc_5", 0.8),
    ],
)
def test_orb_finds_the_truth_of_real_sets(real_data: Path, name: str, count: int, metric: str, least: float):
    pairs = load_set(name, real_data)
    assert len(pairs) == count
    assert all(max(pair.image0.shape) == 640 for pair in pairs)
    assert score_pairs(load_extractor("orb"), pairs)[metric] > least


@pytest.mark.slow
@pytest.mark.parametrize(("name", "part", "motions", "least"), [("kitti", "gap1", 62, 0.7), ("euroc", "next", 59, 0.3)])
def test_orb_finds_the_truth_of_real_sequences(real_data: Path, name: str, part: str, motions: int, least: float):
    pairs = load_set(name, real_data)
    assert sum(isinstance(pair.truth, Motion) for pair in pairs) == motions
    found = score_pairs(load_extractor("orb"), [pair for pair in pairs if pair.part in ("", part)])
    assert found["rows_1"] > 0.6
    assert found[f"{part}_epipolar_1"] > least


def test_the_names_of_the_sets_are_told_apart():
    assert not set(SELECTION) & set(FINAL)
