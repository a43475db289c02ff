"""Keypoints searched for along the rows: compiled as in NumPy, and where the truth is known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.frontend import build_frontend
from sigmaslam.frontend.row_search import search_reference, search_rows
from sigmaslam.readers import open_sequence
from sigmaslam.slam.frame import Frame

MIN_TO_JUDGE = 20


@pytest.fixture(scope="module")
def pair(demo_sequence: Path) -> tuple[np.ndarray, np.ndarray]:
    frame = next(open_sequence(demo_sequence).frames())
    return frame.left, frame.right


def test_the_compiled_search_equals_its_twin(pair):
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    height, width = pair[0].shape
    places = np.random.default_rng(0).integers(-3, [width + 3, height + 3], (300, 2)).astype(np.int32)
    for images in (pair, pair[::-1]):
        found = kernels.search_rows(*images, places, -60, 60, 0.9)
        expected = search_reference(*images, places, -60, 60, 0.9)
        np.testing.assert_array_equal(found, expected)
        assert (found > -1000).sum() > 40


@pytest.mark.parametrize("shift", [-75, -40, -12, -1, 0, 12, 40, 75])
@pytest.mark.parametrize("scale", [1, 3], ids=["whole", "halved"])
def test_a_shifted_image_is_found_at_its_shift_in_front_of_infinity_and_behind(pair, shift: int, scale: int):
    """Up to a quarter of the width, 80 pixels, to either side; images of 640 pixels and more at half the size."""
    left, shift = cv2.resize(pair[0], None, fx=scale, fy=scale), scale * shift
    height, width = left.shape
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 5.0).reshape(-1, 2)
    inside = (corners[:, 1] > 12 * scale) & (corners[:, 1] < height - 12 * scale)
    inside &= np.abs(corners[:, 0] - 0.5 * width) < 0.5 * width - abs(shift) - 12 * scale
    inner = corners[inside]
    index, places = search_rows(left, np.roll(left, -shift, axis=1), inner)
    assert len(index) > 0.95 * len(inner) > 50
    disparity = inner[index, 0] - places[:, 0]
    assert (np.abs(disparity - shift) <= 2.0).mean() > 0.97
    np.testing.assert_array_equal(places[:, 1], inner[index, 1])


@pytest.mark.parametrize("dark", [0, 1], ids=["left", "right"])
def test_an_eye_in_the_dark_is_searched_as_in_the_light(pair, dark: int):
    corners = cv2.goodFeaturesToTrack(pair[0], 300, 0.01, 5.0).reshape(-1, 2)
    index, places = search_rows(*pair, corners)
    images = [image // 3 if eye == dark else image for eye, image in enumerate(pair)]
    index_dark, places_dark = search_rows(*images, corners)
    assert len(index_dark) > 0.9 * len(index) > 100
    _, one, other = np.intersect1d(index, index_dark, return_indices=True)
    assert (np.abs(places[one] - places_dark[other]).max(axis=1) <= 1.0).mean() > 0.97


def test_nothing_is_found_where_there_is_no_texture_or_none_alike(pair):
    left = pair[0]
    noise = np.random.default_rng(1).integers(0, 256, left.shape).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(left, 300, 0.01, 5.0).reshape(-1, 2)
    for other in (np.full_like(left, 90), noise):
        index, _ = search_rows(left, other, corners)
        assert len(index) < 0.1 * len(corners)
    assert len(search_rows(*pair, np.zeros((0, 2), np.float32))[0]) == 0


@pytest.mark.parametrize("frontend", ["learned", "sift", "orb"])
@pytest.mark.parametrize("nearer", [0, 3, -30], ids=["as they are", "about infinity", "far behind infinity"])
def test_swapped_eyes_are_told_from_right_ones(pair, frontend: str, nearer: int):
    """Disparities of the demo are 4 to 14 pixels: swapped they are -4 to -14, and by those pixels more or less."""
    left, right = pair
    observe = build_frontend(frontend, 1000, threads=1).observe
    width = left.shape[1] - abs(nearer)
    swapped = np.roll(right, nearer, axis=1)[:, max(nearer, 0) :][:, :width], left[:, max(nearer, 0) :][:, :width]
    view = observe(*(np.ascontiguousarray(image) for image in swapped))
    assert view.is_swapped(MIN_TO_JUDGE)
    assert len(view.behind) > 0.3 * len(view.features.keypoints)


def test_right_eyes_are_not_taken_for_swapped_ones(pair):
    """Nor where the disparities are 5 pixels too small, the least of them -0.6."""
    left, right = pair
    frontend = build_frontend("learned", 1000, threads=1)
    for shift in (0, 5):
        width = left.shape[1] - shift
        view = frontend.observe(np.ascontiguousarray(left[:, shift:]), np.ascontiguousarray(right[:, :width]))
        assert not view.is_swapped(MIN_TO_JUDGE)
        assert view.has_stereo(400, MIN_TO_JUDGE)
        assert len(view.behind) < 0.02 * len(view.features.keypoints)


def test_infinity_is_where_a_known_offset_has_it(pair):
    """Disparities of 4 to 14 pixels, 8 too small: what is far looks like swapped eyes, unless the offset is known."""
    left, right = pair
    images = np.ascontiguousarray(left[:, 8:]), np.ascontiguousarray(right[:, :-8])
    frontend = build_frontend("learned", 1000, threads=1)
    for infinity, is_swapped in [(0.0, True), (-8.0, False)]:
        view = Frame(*images, frontend, infinity=infinity).view
        assert view.is_swapped(MIN_TO_JUDGE) is is_swapped
        assert view.has_stereo(100, MIN_TO_JUDGE) is not is_swapped
    assert Frame(right, left, frontend, infinity=-3.0).view.is_swapped(MIN_TO_JUDGE)
