"""Keypoints and descriptors exchanged: partners and depths that are known, real pairs, and the page."""

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam_benchmarks.matching import exchange, wide_pairs
from sigmaslam_benchmarks.matching.wide_pairs import WidePair
from tests.support.textured_pairs import textured_pair


def test_partners_are_one_to_one():
    # Rows 0 and 1 both have column 0 alone, row 2 has 0 and 1: two of the three find a partner.
    near = np.array([[1, 0, 0], [1, 0, 0], [1, 1, 0]], bool)
    assert exchange.count_partners(near) == 2
    assert exchange.count_partners(np.zeros((3, 2), bool)) == 0


@pytest.mark.long
def test_a_slanted_plane_has_its_depth_in_both_photographs_and_a_screen_hides_it():
    height, width, focal, baseline = 240, 320, 300.0, 0.5
    u, v = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    disparity = 24.0 + 0.02 * u + 0.01 * v
    left, right = textured_pair(disparity, 1.0)
    K, eye = np.array([[focal, 0, 150.0], [0, focal, 120.0], [0, 0, 1]]), np.eye(4)
    eye[0, 3] = baseline
    views = [wide_pairs.View(left, K, np.eye(4)), wide_pairs.View(right, K, eye)]
    cloud = wide_pairs.stereo_cloud(*views)
    depths = [wide_pairs.depth_map([cloud], view) for view in views]
    points = np.array([[80.0, 50.0], [160.3, 120.2], [250.0, 200.0]])
    expected = 24.0 + 0.02 * points[:, 0] + 0.01 * points[:, 1]
    index = np.round(points).astype(int).T[::-1]
    np.testing.assert_allclose(depths[0][tuple(index)], focal * baseline / expected, rtol=0.01)
    pair = wide_pairs._related("plane", *views, *depths)
    places, seen = pair.transfer(points)
    assert seen.all()
    np.testing.assert_allclose(places, points - np.column_stack([expected, np.zeros(3)]), atol=0.2)
    screen = np.full_like(depths[1], 0.5 * depths[1].min())
    hidden = wide_pairs._related("plane", *views, depths[0], screen)
    assert not hidden.transfer(points)[1].any()
    assert not pair.transfer(np.array([[5.0, 100.0]]))[1].any()  # leaves the image


def test_an_image_and_itself_have_all_partners(monkeypatch: pytest.MonkeyPatch):
    image = np.random.default_rng(0).integers(0, 255, (128, 160), np.uint8)
    image = np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0))
    pair = WidePair("same", image, image, lambda points: (points, points[:, 0] < 80.0), None)
    rng = np.random.default_rng(1)
    keypoints = rng.permutation(np.stack(np.meshgrid(np.arange(10, 150, 8), np.arange(10, 118, 8)), -1).reshape(-1, 2))
    descriptors = rng.standard_normal((len(keypoints), 64)).astype(np.float32)
    features = keypoints.astype(np.float32), descriptors / np.linalg.norm(descriptors, axis=1, keepdims=True)
    score = exchange.score_exchange(pair, features, features)
    left = int((keypoints[:, 0] < 80).sum())
    assert score.known == score.repeated_1 == score.repeated_3 == score.mutual == left
    assert np.isnan(score.near_lines)


@pytest.mark.slow
def test_places_on_the_fountain_agree_with_matches_that_know_no_depth(real_data: Path):
    """SIFT's best matches, by their ratio, lie where depth and cameras have them."""
    pair = wide_pairs.fountain(real_data)[0]
    sift = cv2.SIFT.create(2000)
    (points0, described0), (points1, described1) = (
        sift.detectAndCompute(image, None) for image in (pair.image0, pair.image1)
    )
    matches = cv2.BFMatcher().knnMatch(described0, described1, 2)
    best = [first for first, second in matches if first.distance < 0.6 * second.distance]
    from0 = np.array([points0[each.queryIdx].pt for each in best])
    to1 = np.array([points1[each.trainIdx].pt for each in best])
    places, seen = pair.transfer(from0)
    assert seen.sum() > 50
    error = np.linalg.norm(places - to1, axis=1)[seen]
    assert np.median(error) < 1.0
    assert (error < 3.0).mean() > 0.9


@pytest.mark.long
def test_the_command_writes_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(2)
    image = np.asarray(cv2.GaussianBlur(rng.integers(0, 255, (160, 192), np.uint8), (0, 0), 2.0))
    pair = WidePair("same", image, image, lambda points: (points, np.ones(len(points), bool)), None)
    monkeypatch.setitem(exchange.SETS, "fountain", lambda data: [pair])
    page = tmp_path / "exchange.md"
    arguments = ["benchmark", "features", "--exchange", "--sets", "fountain", "--data", str(tmp_path)]
    result = CliRunner().invoke(app, [*arguments, "--out", str(page)], catch_exceptions=False)
    assert result.exit_code == 0
    with page.with_suffix(".fountain.csv").open() as table:
        rows = list(csv.reader(table))[1:]
    assert [row[2:4] for row in rows] == [["ours", "own"], ["sift", "own"], ["ours", "ours"], ["sift", "ours"]]
    for row in rows:
        known, *_, mutual = row[4:8]
        assert int(known) >= int(mutual) > 20
    refused = CliRunner().invoke(app, [*arguments, "--peer", "a.onnx", "--out", str(page)])
    assert "a checkout of EdgePoint2" in refused.output or "a checkout of EdgePoint2" in str(refused.exception)
