"""Keypoints searched for along the rows: compiled as in NumPy, and where the truth is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.row_search import search_reference, search_rows
from sigmaslam.readers import open_sequence


@pytest.fixture(scope="module")
def pair(demo_sequence: Path) -> tuple[np.ndarray, np.ndarray]:
    frame = next(open_sequence(demo_sequence).frames())
    return frame.left, frame.right


def test_the_compiled_search_equals_its_twin(pair):
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    height, width = pair[0].shape
    places = np.random.default_rng(0).integers(-3, [width + 3, height + 3], (300, 2)).astype(np.int32)
    found = kernels.search_rows(*pair, places, -3, 60, 0.9)
    expected = search_reference(*pair, places, -3, 60, 0.9)
    np.testing.assert_array_equal(found, expected)
    assert (found > -1000).sum() > 40


def test_a_shifted_image_is_found_at_its_shift(pair):
    left = pair[0]
    shifted = np.roll(left, -12, axis=1)
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 5.0).reshape(-1, 2)
    inner = corners[(corners[:, 0] > 40) & (corners[:, 0] < left.shape[1] - 40)]
    index, places = search_rows(left, shifted, inner)
    assert len(index) > 0.8 * len(inner[(inner[:, 1] > 12) & (inner[:, 1] < left.shape[0] - 12)])
    disparity = inner[index, 0] - places[:, 0]
    assert (np.abs(disparity - 12.0) <= 2.0).mean() > 0.97
    np.testing.assert_array_equal(places[:, 1], inner[index, 1])


def test_nothing_is_found_where_there_is_no_texture_or_none_alike(pair):
    left = pair[0]
    noise = np.random.default_rng(1).integers(0, 256, left.shape).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 5.0).reshape(-1, 2)
    for other in (np.full_like(left, 90), noise):
        index, _ = search_rows(left, other, corners)
        assert len(index) < 0.1 * len(corners)
    assert len(search_rows(*pair, np.zeros((0, 2), np.float32))[0]) == 0
