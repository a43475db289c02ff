"""Patches followed without features: known shifts and warps, from starts, from their neighbours' and from neither."""

from dataclasses import dataclass

import numpy as np
import pytest

from sigmaslam.frontend.followed_patches import (
    PatchTargets,
    compare_with_neighbours,
    correct_by_neighbours,
    find_patches,
    shrink,
)
from sigmaslam.frontend.types import PatchMaps
from tests.support.quantiles import chi_square_quantile
from tests.support.warped_images import HEIGHT, WIDTH, corners, digitised, maps_of, textured, warped

MOTIONS = {
    "shift": np.array([[1.0, 0.0, 7.3], [0.0, 1.0, -4.6], [0.0, 0.0, 1.0]]),
    "larger and sheared": np.array([[1.15, -0.2, 40.0], [0.25, 0.95, -30.0], [0.0, 0.0, 1.0]]),
    "smaller and turned": np.array([[0.7, -0.1, 70.0], [0.15, 0.65, 30.0], [0.0, 0.0, 1.0]]),
    "tilted": np.array([[1.15, -0.2, 40.0], [0.25, 0.95, -30.0], [2e-4, -1e-4, 1.0]]),
}
TEN_PIXELS = np.array([8.0, -6.0])
ELLIPSE = chi_square_quantile(0.99, 2)


@dataclass(frozen=True, slots=True)
class Scene:
    """Two views of a plane.

    Attributes:
        image0, image1: (H, W) uint8.
        points, truth: (N, 2) corners of image 0 and where they are in image 1.
        maps: of the patches.
    """

    image0: np.ndarray
    image1: np.ndarray
    points: np.ndarray
    truth: np.ndarray
    maps: PatchMaps

    def find(self, predicted: np.ndarray, start: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
        """(N,) errors in pixels, and which are found within the ellipse of predictions of that sigma."""
        covariance = np.tile(sigma**2 * np.eye(2), (len(self.points), 1, 1))
        corrected = correct_by_neighbours(predicted, start)
        targets = PatchTargets(self.points, self.maps, predicted, covariance, start, corrected)
        places, found = find_patches(self.image0, self.image1, shrink(self.image0), shrink(self.image1), targets)
        inside = ((places - predicted) ** 2).sum(axis=1) < ELLIPSE * sigma**2
        assert inside[found].all()
        return np.linalg.norm(places - self.truth, axis=1), found

    def near(self, most: float = 1.5) -> np.ndarray:
        """(N, 2) places up to so many pixels beside the true ones along each axis."""
        return self.truth + np.random.default_rng(3).uniform(-most, most, self.truth.shape)


def seen(H: np.ndarray) -> Scene:
    texture = textured()
    image0, image1 = digitised(texture, 1), digitised(warped(texture, H), 2)
    points, truth = corners(image0, H)
    return Scene(image0, image1, points, truth, maps_of(H, points))


@pytest.fixture(scope="module", params=MOTIONS.values(), ids=MOTIONS)
def scene(request: pytest.FixtureRequest) -> Scene:
    return seen(request.param)


@pytest.fixture(scope="module")
def shifted() -> Scene:
    return seen(MOTIONS["shift"])


def nowhere(count: int) -> np.ndarray:
    return np.full((count, 2), np.nan)


def assert_exact(error: np.ndarray, found: np.ndarray, wrong: float = 0.0) -> None:
    """All but one in a hundred are found, and those, but for that share, exactly."""
    assert found.mean() > 0.99
    assert np.median(error[found]) < 0.03
    assert np.quantile(error[found], 1.0 - wrong) < 0.3


# Where patches are found


def test_patches_are_found_to_hundredths_of_a_pixel_from_where_they_were_followed_to(scene: Scene):
    assert_exact(*scene.find(scene.truth + 2.0, scene.near(), sigma=4.0))


def test_where_one_in_five_was_followed_the_others_are_found_from_their_neighbours(scene: Scene):
    """Of predictions that are all 10 pixels off, and 25: further than alignment reaches from coarse to fine."""
    followed = np.arange(len(scene.truth)) % 5 == 0
    start = np.where(followed[:, None], scene.near(), np.nan)
    assert_exact(*scene.find(scene.truth + TEN_PIXELS, start, sigma=6.0))
    assert_exact(*scene.find(scene.truth + 2.5 * TEN_PIXELS, start, sigma=12.0))


def test_without_starts_they_are_found_from_ten_pixels_away_from_coarse_to_fine(scene: Scene):
    """A few are taken for what looks alike."""
    error, found = scene.find(scene.truth + TEN_PIXELS, nowhere(len(scene.truth)), sigma=6.0)
    assert_exact(error, found, wrong=0.03)


def test_wrong_starts_are_found_out_and_searched_for_again(scene: Scene):
    """Three in ten were followed astray by up to 12 pixels along each axis."""
    astray = np.random.default_rng(4).random(len(scene.truth)) < 0.3
    start = np.where(astray[:, None], scene.near(12.0), scene.near())
    assert_exact(*scene.find(scene.truth + TEN_PIXELS, start, sigma=6.0), wrong=0.02)


def test_patches_outside_their_ellipses_are_not_found(shifted: Scene):
    """Predictions of half of them are 10 pixels off, but claim 1: the ellipse reaches 3."""
    outside = np.arange(len(shifted.truth)) % 2 == 0
    predicted = shifted.truth + np.where(outside[:, None], TEN_PIXELS, 0.5)
    error, found = shifted.find(predicted, shifted.near(), sigma=1.0)
    assert found[outside].mean() < 0.03
    assert_exact(error[~outside], found[~outside])


def test_nothing_is_found_in_a_blank_image(shifted: Scene):
    blank = Scene(shifted.image0, np.full_like(shifted.image1, 90), shifted.points, shifted.truth, shifted.maps)
    _, found = blank.find(shifted.truth, shifted.near(), sigma=4.0)
    assert not found.any()


def test_a_part_of_the_patches_is_found_as_all_of_them_are(shifted: Scene):
    """Each by itself, once their neighbours have corrected them."""
    truth, start = shifted.truth, shifted.near()
    covariance = np.tile(16.0 * np.eye(2), (len(truth), 1, 1))
    targets = PatchTargets(shifted.points, shifted.maps, truth, covariance, start, truth + 1.0)
    images = shifted.image0, shifted.image1, shrink(shifted.image0), shrink(shifted.image1)
    places, found = find_patches(*images, targets)
    rows = np.arange(0, len(truth), 3)
    some_places, some_found = find_patches(*images, targets.select(rows))
    np.testing.assert_array_equal(some_places, places[rows])
    np.testing.assert_array_equal(some_found, found[rows])


# Corrections


def scattered(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform((0, 0), (WIDTH, HEIGHT), (count, 2))


def test_seven_starts_are_too_few_to_correct_predictions_and_eight_are_enough():
    predicted, start = scattered(40), nowhere(40)
    start[:7] = predicted[:7] + TEN_PIXELS
    np.testing.assert_array_equal(correct_by_neighbours(predicted, start), predicted)
    start[7] = predicted[7] + TEN_PIXELS
    np.testing.assert_allclose(correct_by_neighbours(predicted, start), predicted + TEN_PIXELS)


def test_predictions_are_corrected_by_their_own_surroundings_and_not_by_one_that_went_astray():
    predicted = scattered(400)
    left = predicted[:, 0] < 0.5 * WIDTH
    truth = predicted + np.where(left[:, None], TEN_PIXELS, -TEN_PIXELS)
    start = np.where((np.arange(400) % 2 == 0)[:, None], truth, np.nan)
    start[10] += 50.0
    inner = np.abs(predicted[:, 0] - 0.5 * WIDTH) > 100.0
    np.testing.assert_allclose(correct_by_neighbours(predicted, start)[inner], truth[inner])


def test_no_predictions_have_no_corrections():
    assert correct_by_neighbours(nowhere(0), nowhere(0)).shape == (0, 2)


# Comparison with neighbours


def test_a_common_shift_is_no_departure():
    predicted = scattered(200)
    departure, spread = compare_with_neighbours(predicted + TEN_PIXELS, predicted)
    np.testing.assert_allclose(departure, 0.0, atol=1e-9)
    np.testing.assert_allclose(spread, 0.0, atol=1e-9)


def test_one_outlier_departs_by_its_distance_and_spoils_no_other():
    predicted = scattered(200)
    places = predicted + TEN_PIXELS
    places[17] += (3.0, 4.0)
    departure, spread = compare_with_neighbours(places, predicted)
    np.testing.assert_allclose(departure[17], [3.0, 4.0])
    np.testing.assert_allclose(np.delete(departure, 17, axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(spread, 0.0, atol=1e-9)


def test_the_spread_is_that_of_the_neighbours():
    """Of normal departures of 2 pixels along each axis: the median distance from their middle is 1.18 sigma."""
    predicted = scattered(2000)
    places = predicted + 2.0 * np.random.default_rng(1).standard_normal(predicted.shape)
    departure, spread = compare_with_neighbours(places, predicted)
    assert np.median(spread) == pytest.approx(2.0 * np.sqrt(chi_square_quantile(0.5, 2)), rel=0.1)
    assert np.median(np.linalg.norm(departure, axis=1)) > 2.0


@pytest.mark.parametrize("count", [0, 1])
def test_who_has_no_neighbours_does_not_depart_from_them(count: int):
    departure, spread = compare_with_neighbours(scattered(count) + TEN_PIXELS, scattered(count))
    assert departure.shape == (count, 2)
    assert spread.shape == (count,)
    assert not departure.any()
    assert not spread.any()
