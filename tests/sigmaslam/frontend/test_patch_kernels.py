"""Patches sampled, aligned and compared: compiled kernels against their NumPy twin, both against what is known."""

from __future__ import annotations

import logging

import cv2
import numpy as np
import pytest

from sigmaslam.compiled import tell_slow
from sigmaslam.frontend import patch_kernels
from sigmaslam.frontend.affine_alignment import align_patches
from sigmaslam.frontend.followed_patches import compare_with_neighbours, correct_by_neighbours
from sigmaslam.frontend.image_sharpness import patch_energies
from sigmaslam.frontend.motion_blur import extreme_sharpness
from sigmaslam.frontend.patch_kernels import align, examine_reference, sample
from sigmaslam.frontend.plane_alignment import disparity_slopes

WIDTH, HEIGHT = 160, 120
ONE = np.zeros(0, np.int32)  # of images 0
Matches = tuple[np.ndarray, ...]


@pytest.fixture(scope="module")
def kernels():
    """The compiled module."""
    return pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")


@pytest.fixture(scope="module")
def images() -> tuple[np.ndarray, np.ndarray]:
    """Texture at all scales, and the same a fraction of a pixel on."""
    rng = np.random.default_rng(0)
    noise = sum(
        cv2.resize(rng.normal(size=(HEIGHT // k + 2, WIDTH // k + 2)) * k, (WIDTH + 8, HEIGHT + 8), interpolation=2)
        for k in (2, 4, 8, 16)
    )
    grey = cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX)
    shifted = cv2.warpAffine(grey, np.array([[1.0, 0.0, -0.4], [0.0, 1.0, 0.3]]), (WIDTH + 8, HEIGHT + 8))
    cut = slice(4, 4 + HEIGHT), slice(4, 4 + WIDTH)
    return tuple(np.rint(each[cut]).astype(np.uint8) for each in (grey, shifted))


def matches(count: int = 200, zoom: float = 1.2, seed: int = 1) -> Matches:
    """Places in both images, some at the border, with maps that turn, scale and tilt."""
    rng = np.random.default_rng(seed)
    points0 = rng.uniform(0, [WIDTH - 1, HEIGHT - 1], (count, 2))
    points1 = np.clip(points0 + rng.normal(0, 0.5, (count, 2)), 0, [WIDTH - 1, HEIGHT - 1])
    A = np.eye(2) + 0.05 * rng.normal(size=(count, 2, 2))
    A *= (zoom ** rng.uniform(-1, 1, count))[:, None, None]
    half_octaves = np.round(np.log2(np.linalg.det(A))).astype(np.int32)
    return points0, points1, np.linalg.inv(A), 0.003 * rng.normal(size=(count, 2)), half_octaves


def mapped(count: int = 200, zoom: float = 1.2, radius: int = 5, taper: float = 1.0) -> tuple:
    """The same matches as `align_patches` takes them, with its reach, radius, iterations and taper."""
    points0, points1, back, tilt, _ = matches(count, zoom)
    return points0, points1, np.linalg.inv(back), tilt, (3.0, radius, 3, taper)


@pytest.mark.parametrize("half_octaves", [0, 1, 3])
def test_samples_on_pixels_are_those_of_a_gaussian_blur(images, half_octaves: int):
    sigma = 0.7 * 2 ** (0.5 * half_octaves)
    reach = 2 * int(np.ceil(4.0 * sigma)) + 1
    expected = cv2.GaussianBlur(images[0].astype(np.float32), (reach, reach), sigma, borderType=cv2.BORDER_REPLICATE)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    found = sample(images[0], np.stack([u, v], axis=-1), half_octaves)
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_waves_are_what_a_gaussian_leaves_of_them_wherever_they_are_sampled():
    """Of five pixels to the wave, and of eight across."""
    omega = 2.0 * np.pi / np.array([5.0, 8.0])
    v, u = np.mgrid[:60, :80].astype(np.float64)
    image = np.rint(128.0 + 100.0 * np.sin(omega[0] * u) * np.sin(omega[1] * v)).astype(np.uint8)
    places = np.random.default_rng(0).uniform(8, [70, 50], (50, 20, 2))
    waves = np.sin(omega * places).prod(axis=-1) * np.exp(-0.5 * (0.7 * omega) ** 2).prod()
    assert np.abs(sample(image, places) - 128.0 - 100.0 * waves).max() < 0.6


@pytest.mark.parametrize(("radius", "taper", "zoom"), [(5, 1.0, 1.0), (5, 1.0, 1.5), (7, 0.6, 4.5)])
def test_compiled_alignment_equals_its_twin(kernels, images, monkeypatch, radius: int, taper: float, zoom: float):
    points0, points1, maps, tilt, size = mapped(zoom=zoom, radius=radius, taper=taper)
    points0[0] = points1[1] = (WIDTH, 5.0)  # beyond the border
    maps[2], maps[3], maps[4] = np.diag([1.0, -1.0]), 6.0 * np.eye(2), np.nan
    found = align_patches(*images, points0, points1, maps, tilt, *size)
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    expected = align_patches(*images, points0, points1, maps, tilt, *size)
    np.testing.assert_allclose(found.correlation, expected.correlation, atol=1e-4)
    clear = np.abs(expected.correlation - 0.5) > 1e-3
    np.testing.assert_array_equal(found.moved[clear], expected.moved[clear])
    assert not found.moved[:5].any()
    assert not found.correlation[:5].any()
    np.testing.assert_array_equal(found.places[~found.moved], points1[~found.moved])
    good = found.moved & expected.moved
    assert 80 < good.sum() < len(good)
    assert np.abs(found.places - expected.places)[good].max() < 2e-3
    assert np.median(np.abs(found.places - expected.places)[good]) < 1e-5


@pytest.mark.parametrize("zoom", [1.0, 4.5])
def test_compiled_evidence_equals_its_twin(kernels, images, zoom: float):
    points0, points1, back, _, half_octaves = matches(zoom=zoom)
    found = kernels.examine([images[0]], ONE, images[1], points0, points1, back, half_octaves, 11, 3.0, 1.0)
    expected = examine_reference(*images, points0, points1, back, half_octaves, 5, 0.6, 1.0)
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-5)


def test_every_run_gives_the_same_bits(kernels, images):
    points0, points1, maps, tilt, size = mapped()
    first, again = (align_patches(*images, points0, points1, maps, tilt, *size) for _ in range(2))
    assert [each.tobytes() for each in first] == [each.tobytes() for each in again]


def test_patches_find_the_shift_of_the_image(images):
    points = np.random.default_rng(2).uniform(12, [WIDTH - 12, HEIGHT - 12], (100, 2))
    found = align_patches(*images, points, points, np.tile(np.eye(2), (100, 1, 1)), None, 3.0, 5, 3, 1.0)
    assert np.abs(np.median(found.places - points, axis=0) - [-0.4, 0.3]).max() < 0.02
    assert np.median(found.correlation) > 0.95


def test_without_a_compiler_the_twin_serves_and_says_so_once(images, monkeypatch, caplog):
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    tell_slow.cache_clear()
    with caplog.at_level(logging.WARNING):
        points0, points1, maps, tilt, size = mapped(20)
        found = [align_patches(*images, points0, points1, maps, tilt, *size) for _ in range(2)]
    np.testing.assert_array_equal(found[0].correlation, align(*images, *matches(20), 5, 3, 1.0)[:, 2])
    assert [record.message for record in caplog.records if "C++ compiler" in record.message] != []
    assert len(caplog.records) == 1


@pytest.mark.parametrize("side", [4, 17])
def test_patches_of_other_sizes_are_refused(kernels, images, side: int):
    points0, *others, _ = mapped(5)
    with pytest.raises(ValueError, match="samples a side"):
        kernels.align([images[0]], ONE, images[1], points0, *others, 3.0, side, 3, 5.0)
    with pytest.raises(ValueError, match="a row for each match"):
        kernels.align([images[0]], ONE, images[1], points0[:4], *others, 3.0, 11, 3, 5.0)


@pytest.mark.parametrize("compiled", [True, False])
def test_matches_of_several_images_are_those_of_each(images, monkeypatch, compiled: bool):
    if not compiled:
        monkeypatch.setattr(patch_kernels, "_kernels", None)
    several, (*given, size) = (images[0], 255 - images[0], images[1]), mapped(60)
    points0, points1, back, _, half_octaves = matches(60)
    source = np.random.default_rng(3).integers(0, 3, 60).astype(np.int32)
    aligned = align_patches(several, images[1], *given, *size, source)
    examined = patch_kernels.examine(several, images[1], points0, points1, back, half_octaves, 5, 0.6, 1.0, source)
    for number, image in enumerate(several):
        rows = source == number
        alone = align_patches(image, images[1], *(each[rows] for each in given), *size)
        for one, other in zip(aligned, alone, strict=True):
            np.testing.assert_array_equal(one[rows], other)
        some = (each[rows] for each in (points0, points1, back, half_octaves))
        np.testing.assert_array_equal(examined[rows], patch_kernels.examine(image, images[1], *some, 5, 0.6, 1.0))


def test_images_that_are_not_there_are_refused(kernels, images):
    *given, _ = mapped(5)
    for source in (np.full(5, 2, np.int32), np.full(5, -1, np.int32)):
        with pytest.raises(ValueError, match="no image of that number"):
            kernels.align(list(images), source, images[1], *given, 3.0, 11, 3, 5.0)
    with pytest.raises(ValueError, match="no image is given"):
        kernels.align([], ONE, images[1], *given, 3.0, 11, 3, 5.0)


@pytest.mark.parametrize("count", [2, 3, 8, 9, 13, 200])
def test_compiled_medians_of_neighbours_equal_their_twin_to_the_bit(kernels, monkeypatch, count: int):
    """Of even and odd numbers of neighbours, with and without slopes, and of queries that are none of the points."""
    places, predicted, _, slope, _ = matches(count)
    unknown = np.where(np.arange(count)[:, None] % 3 == 0, np.nan, places)

    def found() -> list[np.ndarray]:
        plain, sloped = (compare_with_neighbours(places, predicted, each) for each in (None, 100.0 * slope))
        return [*plain, *sloped, correct_by_neighbours(predicted, unknown)]

    compiled = found()
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    for one, twin in zip(compiled, found(), strict=True):
        np.testing.assert_array_equal(one, twin)


@pytest.mark.parametrize("shape", ["a line", "two heaps far apart", "one far away"])
def test_compiled_neighbours_in_a_box_that_is_mostly_empty_equal_their_twin(kernels, monkeypatch, shape: str):
    rng = np.random.default_rng(3)
    places = rng.uniform(0, 100, (300, 2)).astype(np.float32).astype(np.float64)
    if shape == "a line":
        places[:, 1] = 7.0
    elif shape == "two heaps far apart":
        places[::2] += 1e4
    else:
        places[17] = 1e6
    predicted = places + rng.normal(size=places.shape)
    found = compare_with_neighbours(places, predicted)
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    for one, twin in zip(found, compare_with_neighbours(places, predicted), strict=True):
        np.testing.assert_array_equal(one, twin)


def test_points_of_neighbours_are_checked(kernels):
    """Places that are no numbers are refused, and queries that are none lead nowhere."""
    points, none = np.arange(10.0).reshape(5, 2), np.zeros((0, 2))
    for value in (np.nan, np.inf):
        with pytest.raises(ValueError, match="finite"):
            kernels.neighbour_medians(np.full((5, 2), value), points, points, 0, 1, points, none)
    nowhere = np.full((1, 2), np.nan)
    assert np.isfinite(kernels.neighbour_medians(points, nowhere, points, 0, 2, points, none)).all()
    with pytest.raises(ValueError, match="fewer points"):
        kernels.neighbour_medians(points, points, points, 0, 6, points, none)
    with pytest.raises(ValueError, match="a row for each point"):
        kernels.neighbour_medians(points, points, points[1:], 0, 1, points, none)


TWINS = {
    "energies": lambda images: patch_energies(images[0], matches(30)[0] * 1.2 - 10.0),
    "sharpness": lambda images: np.array(extreme_sharpness(images[0])),
    "slopes": lambda _: disparity_slopes(matches()[0], 20.0 + 0.1 * matches()[0][:, 0] + matches()[3][:, 0]),
    "slopes of some": lambda _: disparity_slopes(matches()[0], 20.0 + matches()[1][:, 1], np.arange(3, 90, 2)),
    "neighbours": lambda _: np.column_stack(compare_with_neighbours(*matches()[:2])),
}


@pytest.mark.parametrize("name", TWINS)
def test_what_is_compiled_equals_its_twin(kernels, images, monkeypatch, name: str):
    found = TWINS[name](images)
    monkeypatch.setattr(patch_kernels, "_kernels", None)
    np.testing.assert_allclose(found, TWINS[name](images), rtol=1e-4, atol=1e-9)
    assert np.abs(found).max() > 1e-3
