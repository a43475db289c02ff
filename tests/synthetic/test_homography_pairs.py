import cv2
import numpy as np
import pytest

from sigmaslam_synthetic import homography_pairs
from sigmaslam_synthetic.homography_pairs import HomographyPair, HomographyPairs
from sigmaslam_synthetic.rendering import bank
from sigmaslam_synthetic.rendering.textures import paint


@pytest.fixture(autouse=True)
def small_textures(monkeypatch):
    """A twelfth of the leaves' area: what is tested does not depend on the size of the texture."""
    monkeypatch.setattr(homography_pairs, "_TEXTURE_SIZE", 128)


def assert_equal(a: HomographyPair, b: HomographyPair) -> None:
    np.testing.assert_array_equal(a.image0, b.image0)
    np.testing.assert_array_equal(a.image1, b.image1)
    np.testing.assert_array_equal(a.H_1_0, b.H_1_0)


def test_a_pair_does_not_depend_on_what_was_asked_before():
    forward, backward = HomographyPairs(3, size=96), HomographyPairs(3, size=96)
    indices = [0, 1, 2, 17, 4096, 1]
    found = [forward.pair(i) for i in indices]
    for i, pair in zip(reversed(indices), reversed(found), strict=True):
        assert_equal(backward.pair(i), pair)


def test_other_seeds_and_indices_give_other_pairs():
    first, other = HomographyPairs(3, size=96), HomographyPairs(4, size=96)
    for pair in (other.pair(0), first.pair(1), first.pair(16)):
        assert not np.allclose(first.pair(0).H_1_0, pair.H_1_0)
        assert np.abs(first.pair(0).image0 - pair.image0).mean() > 1e-3


def test_no_two_pairs_share_their_random_numbers(monkeypatch):
    """Each stream is named by three small numbers, so that no two names are the same seed."""
    named, default_rng = [], np.random.default_rng
    monkeypatch.setattr(bank, "paint", lambda kind, size, seed: np.zeros((size, size), np.uint8))
    monkeypatch.setattr(np.random, "default_rng", lambda name: named.append(name) or default_rng(name))
    for seed in range(3):
        stream = HomographyPairs(seed, size=16)
        for index in range(40):
            stream.pair(index)
    own = [name for name in named if name[1] == 1]
    assert len(own) == 120
    states = {tuple(np.random.SeedSequence(name).generate_state(4)) for name in set(named)}
    assert len(states) == len(set(named))
    assert len(set(own)) == len(own)
    assert {len(name) for name in named} == {3}


def test_the_kinds_of_textures_can_be_chosen(monkeypatch):
    asked = set()
    monkeypatch.setattr(bank, "paint", lambda kind, size, seed: asked.add(kind) or np.zeros((size, size), np.uint8))
    stream = HomographyPairs(0, size=16, kinds=("noise", "glyphs"))
    for index in range(16):
        stream.pair(index)
    assert asked == {"noise", "glyphs"}


def test_images_are_what_a_camera_gives():
    stream = HomographyPairs(0, size=96)
    for index in range(8):
        pair = stream.pair(index)
        for image in (pair.image0, pair.image1):
            assert image.shape == (96, 96)
            assert image.dtype == np.float32
            assert image.min() >= 0
            assert image.max() <= 1
            np.testing.assert_allclose(image * 255, np.round(image * 255), atol=1e-4)


def test_homography_carries_image_0_onto_image_1(monkeypatch):
    """Without sensor and occlusion the two views agree, but for resampling; a pixel's shift would show."""
    monkeypatch.setattr(homography_pairs, "_sense", lambda image, rng: image)
    monkeypatch.setattr(homography_pairs, "_occlude", lambda image, foreign, rng: (image, np.zeros(image.shape, bool)))
    # A smooth texture, so that resampling twice costs little.
    monkeypatch.setattr(bank, "paint", lambda *arguments: cv2.GaussianBlur(paint(*arguments), (0, 0), 3.0))
    stream, compared = HomographyPairs(1, size=128), 0
    for index in range(12):
        pair = stream.pair(index)
        errors = []
        for shift in (0.0, 1.0):
            H = np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]) @ pair.H_1_0
            warped = cv2.warpPerspective(pair.image0, H, (128, 128), borderValue=-1.0)
            seen = cv2.erode((warped >= 0).astype(np.uint8), np.ones((7, 7))) > 0
            errors.append(np.abs(warped - pair.image1)[seen].mean() if seen.sum() > 500 else np.nan)
        if np.isfinite(errors).all():
            compared += 1
            assert errors[0] < 0.012, index
            assert errors[0] < 0.5 * errors[1], index
    assert compared >= 9


@pytest.mark.long
def test_what_the_camera_sees_agrees_where_there_is_texture():
    """With sensor, light and occluders on, textured patches correlate under the homography and not beside it."""
    stream, right, beside = HomographyPairs(2, size=160), [], []
    for index in range(16):
        pair = stream.pair(index)
        for shift, found in ((0.0, right), (9.0, beside)):
            H = np.array([[1, 0, shift], [0, 1, shift], [0, 0, 1]]) @ pair.H_1_0
            warped = cv2.warpPerspective(pair.image0, H, (160, 160), borderValue=-1.0)
            for top in range(8, 128, 24):
                for left in range(8, 128, 24):
                    a, b = (i[top : top + 24, left : left + 24].ravel() for i in (warped, pair.image1))
                    if a.min() >= 0 and a.std() > 0.06 and b.std() > 0.06:
                        found.append(np.corrcoef(a, b)[0, 1])
    assert len(right) > 60
    assert np.median(right) > 0.8
    assert abs(np.median(beside)) < 0.3


def test_some_second_views_are_occluded_and_no_first_one(monkeypatch):
    monkeypatch.setattr(homography_pairs, "_sense", lambda image, rng: image)
    monkeypatch.setattr(bank, "paint", lambda kind, size, seed: np.full((size, size), 40 + seed % 160, np.uint8))
    stream = HomographyPairs(0, size=64)
    views = [(pair.image0.std(), pair.image1.std()) for pair in map(stream.pair, range(80))]
    first, second = np.array(views).T
    np.testing.assert_array_less(first, 1e-6)
    assert 0.1 < (second > 1e-3).mean() < 0.5


def test_homography_is_normalised_and_keeps_orientation():
    stream = HomographyPairs(2, size=96)
    for index in range(5):
        H = stream.pair(index).H_1_0
        assert H[2, 2] == 1
        assert np.linalg.det(H) > 0


def test_transfer_equals_opencv_and_knows_what_is_hidden():
    stream, hidden = HomographyPairs(5, size=96), 0
    rng = np.random.default_rng(0)
    for index in range(12):
        pair = stream.pair(index)
        points = rng.uniform(0, 95, (200, 2))
        places, visible = pair.transfer(points)
        expected = cv2.perspectiveTransform(points[:, None], pair.H_1_0)[:, 0]
        inside = ((expected >= 0) & (expected <= 95)).all(axis=1)
        np.testing.assert_allclose(places[inside], expected[inside], rtol=1e-9)
        u, v = np.round(expected[inside]).astype(int).T
        np.testing.assert_array_equal(visible[inside], ~pair.hidden1[v, u])
        assert not visible[~inside].any()
        hidden += int((~visible[inside]).sum())
    assert hidden > 20
