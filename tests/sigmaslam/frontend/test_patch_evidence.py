"""What patches say of a match: known images, and what must not matter."""

from dataclasses import fields

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.patch_evidence import Evidence, examine_patches
from sigmaslam_synthetic.rendering.textures import dead_leaves

SIDE = 240
IDENTITY = np.eye(2)
TURNED = np.array([[0.866, -0.5], [0.5, 0.866]])


def smooth_texture(seed: int = 0) -> np.ndarray:
    """Blobs a few pixels wide, (240, 240) float64 around 128."""
    noise = np.random.default_rng(seed).standard_normal((SIDE, SIDE))
    blurred = cv2.GaussianBlur(noise, (0, 0), 3.0, borderType=cv2.BORDER_REFLECT_101)
    return 128.0 + 35.0 * blurred / blurred.std()


def pure(evidence: Evidence) -> np.ndarray:
    """Correlation (M,) without the variance of one grey level squared that is added to that of either patch."""
    variance0, variance1 = evidence.contrast0**2, evidence.contrast1**2
    return evidence.correlation * np.sqrt(variance0 * variance1 / ((variance0 - 1.0) * (variance1 - 1.0)))


def to_grey(image: np.ndarray) -> np.ndarray:
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def places(count: int = 200, margin: float = 60.0) -> np.ndarray:
    return np.random.default_rng(9).uniform(margin, SIDE - 1 - margin, (count, 2))


def warped(image: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The image under A about its middle, (240, 240) as well, and true matches that lie in both."""
    middle = np.full(2, 0.5 * (SIDE - 1))
    offset = middle - A @ middle
    shown = cv2.warpAffine(
        image, np.c_[A, offset], (SIDE, SIDE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )
    points0 = places(600, 20.0)
    points1 = points0 @ A.T + offset
    inside = ((points1 > 20.0) & (points1 < SIDE - 21.0)).all(axis=1)
    return shown, points0[inside], points1[inside]


def edge(degrees: float, blur: float = 1.5) -> np.ndarray:
    """A straight, softened step through the middle, dark to bright along the direction of that angle."""
    v, u = np.mgrid[:SIDE, :SIDE] - 0.5 * (SIDE - 1)
    across = u * np.cos(np.radians(degrees)) + v * np.sin(np.radians(degrees))
    return 50.0 + 150.0 / (1.0 + np.exp(-across / blur))


def along(degrees: float) -> np.ndarray:
    """Points on that edge."""
    direction = np.array([-np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    return 0.5 * (SIDE - 1) + np.linspace(-40.0, 40.0, 21)[:, None] * direction


def maps(A: np.ndarray, count: int) -> np.ndarray:
    return np.tile(A, (count, 1, 1))


def assert_same(a: Evidence, b: Evidence, atol: float = 0.0) -> None:
    for field in fields(Evidence):
        np.testing.assert_allclose(
            getattr(a, field.name), getattr(b, field.name), rtol=0, atol=atol, err_msg=field.name
        )


# Correlation


def test_the_same_patches_correlate_fully():
    image = dead_leaves((SIDE, SIDE), np.random.default_rng(0))
    evidence = examine_patches(image, image, places(), places())
    np.testing.assert_allclose(pure(evidence), 1.0, atol=1e-3)
    assert evidence.correlation.max() <= 1.0


def test_independent_noise_does_not_correlate():
    rng = np.random.default_rng(1)
    image0, image1 = (to_grey(128.0 + 30.0 * rng.standard_normal((SIDE, SIDE))) for _ in range(2))
    points = np.stack(np.meshgrid(np.arange(10.0, 230.0, 11.0), np.arange(10.0, 230.0, 11.0)), -1).reshape(-1, 2)
    correlation = examine_patches(image0, image1, points, points).correlation
    assert abs(correlation.mean()) < 5.0 * correlation.std() / np.sqrt(len(points))
    assert correlation.std() < 0.3


def test_a_negative_correlates_fully_the_other_way():
    image = to_grey(smooth_texture())
    evidence = examine_patches(image, 255 - image, places(), places())
    np.testing.assert_allclose(pure(evidence), -1.0, atol=0.01)


@pytest.mark.parametrize("image_changed", [0, 1])
def test_gain_and_offset_of_one_image_do_not_change_the_correlation(image_changed: int):
    texture = smooth_texture()
    images = [texture, 0.7 * texture + 0.3 * smooth_texture(1)]
    plain = examine_patches(*map(to_grey, images), places(), places())
    images[image_changed] = 0.5 * images[image_changed] + 60.0
    changed = examine_patches(*map(to_grey, images), places(), places())
    np.testing.assert_allclose(pure(changed), pure(plain), atol=0.02)
    contrasts = [(each.contrast0, each.contrast1)[image_changed] for each in (plain, changed)]
    np.testing.assert_allclose(contrasts[1], 0.5 * contrasts[0], rtol=0.05)
    assert plain.correlation.min() < 0.7 < 0.95 < plain.correlation.max()


def test_flat_patches_neither_correlate_nor_are_sharp():
    grey = np.full((SIDE, SIDE), 90, np.uint8)
    evidence = examine_patches(grey, grey, places(), places())
    np.testing.assert_array_equal(evidence.correlation, 0.0)
    np.testing.assert_array_equal(evidence.sharpness, 0.0)
    np.testing.assert_allclose(evidence.contrast0, 1.0)


def test_a_wrong_place_correlates_less_than_the_right_one():
    image = to_grey(smooth_texture())
    right = examine_patches(image, image, places(), places()).correlation
    shifted = examine_patches(image, image, places(), places() + (4.0, -3.0)).correlation
    assert (shifted < right - 0.05).all()


# Axes


@pytest.mark.parametrize("degrees", [0.0, 25.0, 60.0, 90.0, 130.0])
def test_axes_are_across_and_along_a_straight_edge(degrees: float):
    image = to_grey(edge(degrees))
    evidence = examine_patches(image, image, along(degrees), along(degrees))
    across = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    np.testing.assert_allclose(np.abs(evidence.axes[:, :, 0] @ across), 1.0, atol=1e-3)
    np.testing.assert_allclose(evidence.axes[:, :, 1] @ across, 0.0, atol=0.03)
    assert (evidence.sharpness[:, 1] < 0.01 * evidence.sharpness[:, 0]).all()


def test_axes_are_rotations_and_the_first_is_the_sharper():
    image = to_grey(smooth_texture())
    evidence = examine_patches(image, image, places(), places())
    np.testing.assert_allclose(
        evidence.axes @ evidence.axes.transpose(0, 2, 1), maps(IDENTITY, len(evidence.axes)), atol=1e-6
    )
    assert (evidence.sharpness[:, 0] >= evidence.sharpness[:, 1]).all()
    assert (evidence.sharpness[:, 1] >= 0.0).all()


def test_sharpness_of_a_wave_is_its_mean_squared_slope_over_its_variance():
    """Of sin(k u) that is k^2, as differences a pixel apart see it."""
    k = 2.0 * np.pi / 10.0
    u = np.arange(SIDE)
    image = to_grey(128.0 + 80.0 * np.tile(np.sin(k * u), (SIDE, 1)))
    evidence = examine_patches(image, image, places(), places())
    np.testing.assert_allclose(np.median(evidence.sharpness[:, 0]), np.sin(k) ** 2, rtol=0.15)
    assert evidence.sharpness[:, 1].max() < 1e-3


# Maps


def test_a_zoom_is_undone_and_sampled_at_the_pixels_of_the_coarser_image():
    texture = smooth_texture()
    image1, points0, points1 = warped(texture, 2.0 * IDENTITY)
    known = examine_patches(to_grey(texture), to_grey(image1), points0, points1, maps(2.0 * IDENTITY, len(points0)))
    assert pure(known).min() > 0.99
    np.testing.assert_array_equal(known.spacing, 2.0)
    np.testing.assert_allclose(known.zoom, 2.0)
    assert np.median(examine_patches(to_grey(texture), to_grey(image1), points0, points1).correlation) < 0.95


def test_a_smaller_image_1_is_sampled_at_its_own_pixels():
    texture = smooth_texture()
    image1, points0, points1 = warped(cv2.GaussianBlur(texture, (0, 0), 1.0), 0.5 * IDENTITY)
    evidence = examine_patches(to_grey(texture), to_grey(image1), points0, points1, maps(0.5 * IDENTITY, len(points0)))
    assert pure(evidence).min() > 0.98
    np.testing.assert_array_equal(evidence.spacing, 1.0)
    np.testing.assert_allclose(evidence.zoom, 0.5)


def test_sharpness_is_counted_in_pixels_of_image_1():
    """Twice as large a picture has slopes half as steep."""
    texture = smooth_texture()
    image1, points0, points1 = warped(texture, 2.0 * IDENTITY)
    large = examine_patches(to_grey(texture), to_grey(image1), points0, points1, maps(2.0 * IDENTITY, len(points0)))
    small = examine_patches(to_grey(texture), to_grey(texture), points0, points0)
    np.testing.assert_allclose(large.sharpness.sum(axis=1), small.sharpness.sum(axis=1) / 4.0, rtol=0.1)


@pytest.mark.parametrize("A", [TURNED, np.array([[1.1, 0.4], [0.0, 0.9]])], ids=["turned", "sheared"])
def test_a_map_is_undone(A: np.ndarray):
    texture = smooth_texture()
    image1, points0, points1 = warped(texture, A)
    known = examine_patches(to_grey(texture), to_grey(image1), points0, points1, maps(A, len(points0)))
    assert pure(known).min() > 0.99
    np.testing.assert_allclose(known.zoom, np.sqrt(np.linalg.det(A)))
    unknown = examine_patches(to_grey(texture), to_grey(image1), points0, points1)
    assert np.median(unknown.correlation) < np.median(known.correlation) - 0.03


@pytest.mark.parametrize(
    "bad",
    [
        np.array([[-1.0, 0.0], [0.0, 1.0]]),
        np.full((2, 2), np.inf),
        np.full((2, 2), np.nan),
        np.zeros((2, 2)),
        5.1 * IDENTITY,
        IDENTITY / 5.1,
    ],
    ids=["mirrored", "infinite", "nan", "zero", "too large", "too small"],
)
def test_a_map_that_no_surface_shows_stands_for_the_identity(bad: np.ndarray):
    image0, image1 = to_grey(smooth_texture()), to_grey(smooth_texture(1))
    A = maps(TURNED, 200)
    A[::3] = bad
    mixed = examine_patches(image0, image1, places(), places(), A)
    A[::3] = IDENTITY
    assert_same(mixed, examine_patches(image0, image1, places(), places(), A), 1e-6)


def test_no_map_equals_the_identity():
    image0, image1 = to_grey(smooth_texture()), to_grey(smooth_texture(1))
    given = examine_patches(image0, image1, places(), places(), maps(IDENTITY, 200))
    assert_same(given, examine_patches(image0, image1, places(), places()), 1e-6)


# Sets


def test_one_match_is_examined_as_among_many_with_other_maps():
    image0, image1 = to_grey(smooth_texture()), to_grey(smooth_texture(1))
    A = np.random.default_rng(3).uniform(0.4, 3.0, 200)[:, None, None] * TURNED
    together = examine_patches(image0, image1, places(), places(), A)
    for row in range(0, 200, 40):
        one = slice(row, row + 1)
        alone = examine_patches(image0, image1, places()[one], places()[one], A[one])
        assert_same(
            alone, Evidence(**{field.name: getattr(together, field.name)[one] for field in fields(Evidence)}), 1e-5
        )


def test_places_at_and_beyond_the_border_are_finite():
    image = to_grey(smooth_texture())
    outside = np.array([[0.0, 0.0], [SIDE - 1.0, 50.0], [-300.0, 50.0], [50.0, SIDE + 300.0]])
    evidence = examine_patches(image, image, outside, outside, maps(TURNED, 4))
    assert all(np.isfinite(getattr(evidence, field.name)).all() for field in fields(Evidence))


@pytest.mark.parametrize("mapped", [False, True])
def test_no_matches_are_no_error(mapped: bool):
    image, none = to_grey(smooth_texture()), np.zeros((0, 2))
    evidence = examine_patches(image, image, none, none, np.zeros((0, 2, 2)) if mapped else None)
    assert evidence.correlation.shape == (0,)
    assert evidence.axes.shape == (0, 2, 2)


def test_more_matches_than_opencv_remaps_at_once_are_taken():
    """It takes images of less than 32,767 rows."""
    image = to_grey(smooth_texture())
    points = np.tile(places(), (170, 1))
    correlation = examine_patches(image, image, points, points).correlation
    np.testing.assert_array_equal(correlation, np.tile(correlation[:200], 170))
