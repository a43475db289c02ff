import cv2
import numpy as np
import pytest

from sigmaslam.synthetic import pairs
from sigmaslam.synthetic.pairs import HomographyPair, HomographyPairs
from sigmaslam.synthetic.textures import dead_leaves, noise_texture


@pytest.fixture(autouse=True)
def small_textures(monkeypatch):
    """Every fourth of the leaves' area: what is tested does not depend on the size of the texture."""
    monkeypatch.setattr(pairs, "_TEXTURE_SIZE", 224)


def assert_equal(a: HomographyPair, b: HomographyPair) -> None:
    np.testing.assert_array_equal(a.image0, b.image0)
    np.testing.assert_array_equal(a.image1, b.image1)
    np.testing.assert_array_equal(a.H_1_0, b.H_1_0)


def test_a_pair_does_not_depend_on_what_was_asked_before():
    forward, backward = HomographyPairs(3, size=96), HomographyPairs(3, size=96)
    indices = [0, 1, 2, 17, 512, 1]
    found = [forward.pair(i) for i in indices]
    for i, pair in zip(reversed(indices), reversed(found), strict=True):
        assert_equal(backward.pair(i), pair)


def test_a_pair_survives_the_eviction_of_its_texture():
    stream = HomographyPairs(3, size=96)
    first = stream.pair(0)
    block = pairs._TEXTURES_A_BLOCK * pairs._USES_OF_A_TEXTURE
    stream._textures.update((10_000 + i, np.zeros((224, 224), np.uint8)) for i in range(pairs._TEXTURES_A_BLOCK))
    stream.pair(block)
    assert 0 not in stream._textures
    assert_equal(stream.pair(0), first)


def test_other_seeds_and_indices_give_other_pairs():
    first, other = HomographyPairs(3, size=96), HomographyPairs(4, size=96)
    for pair in (other.pair(0), first.pair(1), first.pair(pairs._TEXTURES_A_BLOCK)):
        assert not np.allclose(first.pair(0).H_1_0, pair.H_1_0)
        assert np.abs(first.pair(0).image0 - pair.image0).mean() > 1e-3


def test_images_are_what_a_camera_gives():
    pair = HomographyPairs(0, size=96).pair(5)
    for image in (pair.image0, pair.image1):
        assert image.shape == (96, 96)
        assert image.dtype == np.float32
        assert image.min() >= 0
        assert image.max() <= 1
        np.testing.assert_allclose(image * 255, np.round(image * 255), atol=1e-4)


def test_homography_carries_image_0_onto_image_1(monkeypatch):
    """Without sensor and occlusion the two views agree, but for resampling; a pixel's shift would show."""
    monkeypatch.setattr(pairs, "_sense", lambda image, rng: image)
    monkeypatch.setattr(pairs, "_occlude", lambda image, rng: image)
    # A smooth texture, so that resampling twice costs little.
    monkeypatch.setattr(pairs, "dead_leaves", lambda shape, rng: cv2.GaussianBlur(dead_leaves(shape, rng), (0, 0), 2.0))
    stream, compared = HomographyPairs(1, size=128), 0
    for index in range(8):
        pair = stream.pair(index)
        errors = []
        for shift in (0.0, 1.0):
            H = np.array([[1, 0, shift], [0, 1, 0], [0, 0, 1]]) @ pair.H_1_0
            warped = cv2.warpPerspective(pair.image0, H, (128, 128), borderValue=-1.0)
            seen = cv2.erode((warped >= 0).astype(np.uint8), np.ones((7, 7))) > 0
            errors.append(np.abs(warped - pair.image1)[seen].mean() if seen.sum() > 500 else np.nan)
        if np.isfinite(errors).all():
            compared += 1
            assert errors[0] < 0.01, index
            assert errors[0] < 0.5 * errors[1], index
    assert compared >= 6


def test_homography_is_normalised_and_keeps_orientation():
    stream = HomographyPairs(2, size=96)
    for index in range(5):
        H = stream.pair(index).H_1_0
        assert H[2, 2] == 1
        assert np.linalg.det(H) > 0


@pytest.mark.parametrize("shape", [(64, 96), (97, 33)])
def test_dead_leaves_are_reproducible_grey_images_with_texture(shape):
    first, second = (dead_leaves(shape, np.random.default_rng(7)) for _ in range(2))
    assert first.shape == shape
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, second)
    assert first.std() > 5
    assert (dead_leaves(shape, np.random.default_rng(8)) != first).mean() > 0.5


def test_noise_texture_has_zero_mean_and_unit_deviation():
    noise = noise_texture((80, 60), np.random.default_rng(0))
    assert noise.dtype == np.float32
    assert noise.mean() == pytest.approx(0, abs=1e-4)
    assert noise.std() == pytest.approx(1, abs=1e-4)
