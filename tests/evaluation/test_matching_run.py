"""Scores of whole sets, and their table."""

from collections.abc import Iterator
from importlib.resources import as_file, files
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.frontend.image_pair import match_twice
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Features
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.matching import compare, comparison, format_scores, load_extractor, score_pairs
from sigmaslam_benchmarks.matching.image_pairs import Homography, ImagePair, SameRows
from sigmaslam_benchmarks.matching.peer_extractors import read_signature
from sigmaslam_benchmarks.matching.score_sets import score_refined
from sigmaslam_benchmarks.matching.scores import score_points, summarize
from sigmaslam_benchmarks.matching.sequence_pairs import sequence_pairs, sequence_steps
from sigmaslam_benchmarks.matching.sets import ALL, REFINED, SELECTION, STEPS, TRACKS
from sigmaslam_synthetic.rendering.textures import dead_leaves


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return dead_leaves((200, 330), np.random.default_rng(3))


@pytest.fixture(scope="module")
def weights() -> Iterator[Path]:
    with as_file(files("sigmaslam_weights")) as folder:
        graph = folder / "features.onnx"
        if not graph.is_file() or "count" not in read_signature(graph).inputs:
            pytest.skip(
                "models/sigmaslam_weights/features.onnx is missing or of the previous network: it has no input `count`"
            )
        yield folder


def test_each_image_is_extracted_once_and_parts_are_averaged_apart(image: np.ndarray):
    calls = []
    orb = load_extractor("orb")

    def counting(given: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(given)
        return orb(given)

    same, moved = Homography(np.eye(3)), np.roll(image, 2, axis=1)
    pairs = [
        ImagePair("0", image, image, same),
        ImagePair("1", image, moved, same),
        ImagePair("2", image, moved, SameRows(), "stereo"),
    ]
    found = score_pairs(counting, pairs)
    assert len(calls) == 2
    # Half of the pairs is perfect, the other is two pixels off.
    assert found["mma_1"] == pytest.approx(0.5, abs=0.05)
    assert found["mma_3"] > 0.95
    assert found["stereo_rows_1"] > 0.9
    assert "stereo_mma_1" not in found


@pytest.mark.parametrize("name", ["sift", "orb"])
def test_classical_extractors_find_an_image_again(name: str, image: np.ndarray):
    assert_finds_again(name, image)


@pytest.mark.parametrize("name", ["features.onnx", "features.safetensors"])
def test_ours_finds_an_image_again(name: str, weights: Path, image: np.ndarray):
    assert_finds_again(str(weights / name), image)


def assert_finds_again(name: str, image: np.ndarray) -> None:
    extractor = load_extractor(name)
    keypoints, descriptors = extractor(image)
    assert 100 < len(keypoints) == len(descriptors) <= 1024
    assert (keypoints < (330, 200)).all()
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-5)
    assert score_pairs(extractor, [ImagePair("", image, image, Homography(np.eye(3)))])["mma_1"] > 0.99


def test_the_graph_and_the_weights_give_the_same_features(weights: Path, image: np.ndarray):
    (points0, descriptors0), (points1, descriptors1) = (
        load_extractor(str(weights / name))(image) for name in ("features.onnx", "features.safetensors")
    )
    np.testing.assert_allclose(points0[:200], points1[:200], atol=1e-2)
    np.testing.assert_allclose(descriptors0[:200], descriptors1[:200], atol=1e-3)


def test_more_keypoints_than_the_others_have_are_refused(image: np.ndarray):
    def greedy(_: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((1025, 2), np.float32), np.zeros((1025, 8), np.float32)

    with pytest.raises(ValueError, match="1025 keypoints"):
        score_pairs(greedy, [ImagePair("", image, image, Homography(np.eye(3)))])


def _warped(image: np.ndarray, degrees: float) -> ImagePair:
    centre = (image.shape[1] / 2.0, image.shape[0] / 2.0)
    H = np.vstack([cv2.getRotationMatrix2D(centre, degrees, 1.1), [0.0, 0.0, 1.0]])
    size = (image.shape[1], image.shape[0])
    return ImagePair("", image, cv2.warpPerspective(image, H, size, flags=cv2.INTER_CUBIC), Homography(H))


@pytest.mark.parametrize("name", ["sift", "orb"])
def test_refined_matches_score_higher_than_mutual_neighbours(name: str, image: np.ndarray):
    pairs = [_warped(image, degrees) for degrees in (10.0, 25.0)]
    extractor = load_extractor(name)
    plain, refined = score_pairs(extractor, pairs), score_refined(extractor, pairs)
    assert set(plain) - set(refined) == {"repeatability_1"}
    for column in ("mma_1", "mma_3", "polished_auc_1"):
        assert refined[column] > plain[column], column
    assert refined["mma_1"] > 0.9
    # Most of what is dropped is wrong.
    assert refined["correct_3"] > 0.95 * plain["correct_3"]


def test_refined_matches_are_those_of_the_command_for_features_without_scores_and_sigmas(image: np.ndarray):
    pair = _warped(image, 15.0)
    features = []
    for keypoints, descriptors in map(load_extractor("sift"), (pair.image0, pair.image1)):
        ones = np.ones(len(keypoints), np.float32)
        features.append(Features(keypoints, descriptors, ones, ones))
    found = match_twice(ConfidenceEstimator(), pair.image0, pair.image1, *features)
    places = (points.astype(np.float64) for points in (found.keypoints0, found.keypoints1))
    expected = summarize([score_points(pair, *places)])
    assert score_refined(load_extractor("sift"), [pair]) == pytest.approx(expected)


def test_refined_matches_of_an_image_without_keypoints_score_zero(image: np.ndarray):
    black = np.zeros_like(image)
    pairs = [ImagePair("", image, black, Homography(np.eye(3)))]
    found = score_refined(load_extractor("orb"), pairs)
    assert set(found.values()) == {0.0}


def test_an_unknown_extractor_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="surf"):
        load_extractor("surf")
    with pytest.raises(InputError, match=r"none\.onnx"):
        load_extractor(str(tmp_path / "none.onnx"))


def test_the_table_has_a_row_for_each_extractor():
    page = format_scores(
        {"a": {"boat": {"mma_1": 0.25, "matches": 99.6, "auc_1": 1}}, "b": {"boat": {"mma_1": 1, "matches": 7}}}
    )
    assert "| extractor | mma_1 | matches |" in page
    assert "| a | 25.0 | 100 |" in page
    assert "| b | 100.0 | 7 |" in page


def test_a_score_that_others_do_not_have_is_left_open():
    page = format_scores({"a": {"kitti_tracks": {"mma_1": 0.25}}, "klt": {"kitti_tracks": {"klt_matches": 99.6}}})
    assert "| a | 25.0 | - |" in page
    assert "| klt | - | 100 |" in page


@pytest.mark.long
def test_all_extractors_are_scored_and_progress_is_told(real_data: Path, weights: Path):
    graph = str(weights / "features.onnx")
    names, notes = ["sift", "orb", graph], []
    found = compare(names, ["middlebury"], real_data, notes.append)
    assert sorted(found) == sorted([*names, *(f"{name} + sigmaslam match" for name in names)])
    assert found[graph]["middlebury"]["mma_3"] > 0.5
    assert any(note.startswith(f"middlebury: {graph}, 2 pairs") for note in notes)


@pytest.mark.long
def test_klt_has_a_row_among_the_tracks_alone(monkeypatch: pytest.MonkeyPatch, demo_sequence: Path):
    pairs = sequence_pairs(open_sequence(demo_sequence), demo_sequence / "poses.txt", 40, {1: "gap1"})
    steps = sequence_steps(open_sequence(demo_sequence), demo_sequence / "poses.txt")[:1]
    monkeypatch.setattr(comparison, "check_sets", lambda sets, data: None)
    monkeypatch.setattr(comparison, "load_tracks", lambda data: pairs)
    monkeypatch.setattr(comparison, "load_steps", lambda data: steps)
    found = compare(["orb"], ["euroc_steps", "kitti_tracks"], Path())
    assert set(found["klt"]["kitti_tracks"]) == {"gap1_klt_1", "gap1_klt_matches"}
    assert list(found["klt"]) == ["kitti_tracks"]
    assert found["orb"]["euroc_steps"]["steps"] == 1.0
    assert found["orb"]["kitti_tracks"]["gap1_epipolar_matches"] > 100


def test_sets_of_views_have_a_second_row_with_refined_matches(monkeypatch: pytest.MonkeyPatch, image: np.ndarray):
    pairs = [_warped(image, 10.0)]
    monkeypatch.setattr(comparison, "check_sets", lambda sets, data: None)
    monkeypatch.setattr(comparison, "load_set", lambda name, data: pairs)
    notes: list[str] = []
    found = compare(["sift", "orb"], ["boat", "euroc"], Path(), notes.append)
    # No second row of a set that is none of REFINED.
    assert {name: list(scores) for name, scores in found.items()} == {
        "sift": ["boat", "euroc"],
        "orb": ["boat", "euroc"],
        "sift + sigmaslam match": ["boat"],
        "orb + sigmaslam match": ["boat"],
    }
    assert found["orb + sigmaslam match"]["boat"] == score_refined(load_extractor("orb"), pairs)
    assert found["orb"]["boat"] == score_pairs(load_extractor("orb"), pairs)
    assert len(notes) == 4
    page = format_scores(found)
    assert page.count("| orb + sigmaslam match |") == 1


def test_the_sets_with_refined_matches_have_views_from_afar():
    assert set(REFINED) < set(ALL)
    assert set(SELECTION) <= set(REFINED)
    assert STEPS in REFINED
    assert TRACKS not in REFINED


def test_a_set_that_cannot_be_scored_is_refused_before_anything_is(real_data: Path, tmp_path: Path):
    middlebury_alone = tmp_path
    (middlebury_alone / "disparity_middlebury").symlink_to(real_data / "disparity_middlebury")
    notes: list[str] = []
    with pytest.raises(InputError, match=r"'bark'.*euroc_steps"):
        compare(["orb"], ["middlebury", "bark"], real_data, notes.append)
    # The second is known but not there: known before the first is scored, too.
    with pytest.raises(InputError, match="does not hold homography_boat"):
        compare(["orb"], ["middlebury", "boat"], middlebury_alone, notes.append)
    assert not notes
