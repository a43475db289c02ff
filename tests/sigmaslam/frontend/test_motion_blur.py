"""Motion blur of one image, and of one of two."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.frontend.motion_blur import extreme_sharpness, is_blurred, streak_covariance

SIZE = 240
GRID = np.stack(np.meshgrid(*[np.arange(24.0, SIZE - 24, 24)] * 2), axis=-1).reshape(-1, 2)


def polygons(seed: int = 0, flatness: float = 1.0) -> np.ndarray:
    """A sharp image of ellipses of all greys, so many times as high as wide."""
    generator = np.random.default_rng(seed)
    image = np.full((4 * SIZE, 4 * SIZE), 128, np.uint8)
    for u, v, radius, turn in generator.uniform(0, 1, (400, 4)):
        axes = (int(20 + 80 * radius), int(flatness * (20 + 80 * radius)))
        tilt = 180.0 * turn if flatness == 1.0 else 0.0
        grey = int(generator.integers(0, 256))
        cv2.ellipse(image, (int(4 * SIZE * u), int(4 * SIZE * v)), axes, tilt, 0, 360, grey, -1)
    image = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA)
    return np.clip(image + generator.normal(0.0, 1.0, image.shape), 0, 255).astype(np.uint8)


def evenness(image: np.ndarray) -> float:
    """Of the sharpest direction what the least sharp one has."""
    least, most = extreme_sharpness(image)
    return least / most


def blurred(image: np.ndarray, length: int, degrees: float) -> np.ndarray:
    """Along a line of so many pixels in that direction."""
    side = length + 2
    offsets = np.linspace(-0.5, 0.5, 20 * length)[:, None] * (length - 1)
    places = side // 2 + offsets * (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
    kernel = np.histogram2d(places[:, 1], places[:, 0], bins=[np.arange(side + 1) - 0.5] * 2)[0]
    return cv2.filter2D(image, -1, kernel / kernel.sum())


@pytest.mark.parametrize("degrees", [0.0, 37.0, 90.0, 140.0])
def test_a_streaked_image_is_blurred_in_whatever_direction(degrees: float):
    assert is_blurred(blurred(polygons(), 17, degrees))


@pytest.mark.parametrize("flatness", [1.0, 0.4, 2.5])
def test_a_sharp_image_is_not_whatever_way_its_edges_run(flatness: float):
    assert not is_blurred(polygons(flatness=flatness))


def test_blur_alike_in_all_directions_and_light_do_not_count():
    image = polygons()
    assert not is_blurred(cv2.GaussianBlur(image, (0, 0), 3.0))
    streaked = blurred(image, 17, 0.0)
    assert evenness((0.5 * streaked + 20.0).astype(np.uint8)) == pytest.approx(evenness(streaked), rel=0.1)


def test_the_longer_the_streak_the_less_even():
    image = polygons()
    values = [evenness(blurred(image, length, 20.0)) for length in (3, 7, 13, 19)]
    assert values == sorted(values, reverse=True)


def test_nothing_is_said_of_an_even_or_a_tiny_image():
    assert not is_blurred(np.full((SIZE, SIZE), 7, np.uint8))
    assert not is_blurred(np.arange(100, dtype=np.uint8).reshape(10, 10))


def test_stripes_are_no_streaks():
    """A wall of them with grain, and a tenth of the image with other things: uneven, but not as a streak is."""
    grain = cv2.GaussianBlur(np.random.default_rng(0).normal(0.0, 6.0, (SIZE, SIZE)), (0, 0), 0.8)
    wall = (120.0 + 40.0 * np.sin(2.0 * np.pi * np.arange(SIZE) / 10.0) + grain).clip(0, 255).astype(np.uint8)
    wall[-SIZE // 10 :] = polygons()[-SIZE // 10 :]
    assert evenness(wall) < ACCEPTANCE.even_sharpness
    assert not is_blurred(wall)


@pytest.mark.parametrize("degrees", [0.0, 60.0, 90.0])
@pytest.mark.parametrize("swapped", [False, True])
def test_matches_are_uncertain_along_the_streak_of_either_image(degrees: float, swapped: bool):
    length, images = 17, [polygons(), blurred(polygons(), 17, degrees)]
    found = streak_covariance(*(images[::-1] if swapped else images), GRID, GRID)
    assert found is not None
    values, vectors = np.linalg.eigh(found)
    direction = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    assert abs(vectors[:, 1] @ direction) > np.cos(np.radians(20.0))
    assert abs(values[0]) < 1e-9 * values[1]
    # How far edges are apart, which nobody knows, makes it as much as half too small or too large.
    assert 0.5 < np.sqrt(values[1]) / (length / np.sqrt(12.0)) < 2.0


def test_images_that_are_blurred_alike_have_no_streak_between_them():
    image = polygons()
    one = blurred(image, 17, 30.0)
    assert streak_covariance(image, image, GRID, GRID) is None
    assert streak_covariance(one, one, GRID, GRID) is None
    assert streak_covariance(one, blurred(image, 13, 30.0), GRID, GRID) is None
    dark = (0.4 * image + 10.0).astype(np.uint8)
    assert streak_covariance(image, dark, GRID, GRID) is None


def test_few_matches_and_even_patches_say_nothing():
    image = polygons()
    assert streak_covariance(image, blurred(image, 17, 0.0), GRID[:7], GRID[:7]) is None
    assert streak_covariance(image, np.full_like(image, 7), GRID, GRID) is None


def test_the_bounds_lie_between_sharp_and_streaked():
    image = polygons()
    assert evenness(blurred(image, 17, 0.0)) < ACCEPTANCE.even_sharpness < evenness(image)
    assert extreme_sharpness(blurred(image, 17, 0.0))[0] < ACCEPTANCE.streak_sharpness < extreme_sharpness(image)[0]
