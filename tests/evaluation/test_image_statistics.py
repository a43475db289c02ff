"""Known answers of the image statistics."""

import numpy as np
import pytest

from sigmaslam_benchmarks.tracking import image_statistics as statistics
from sigmaslam_benchmarks.tracking.renders import compare, gaps


def power_law(side: int, slope: float, seed: int = 0) -> np.ndarray:
    """Gaussian noise whose power falls with frequency to the `slope`."""
    spectrum = np.fft.fft2(np.random.default_rng(seed).standard_normal((side, side)))
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side))
    frequency[0, 0] = 1.0
    return np.fft.ifft2(spectrum * frequency ** (slope / 2)).real


def checkerboard(side: int, square: int, step: float = 60.0) -> np.ndarray:
    """Squares of grey levels 100 and 100 + step."""
    v, u = np.mgrid[:side, :side] // square
    return 100.0 + step * ((u + v) % 2)


@pytest.mark.parametrize("slope", [-1.0, -2.0, -3.0])
def test_slope_of_power_law_noise_is_recovered(slope: float):
    found = statistics.spectral_slope(*statistics.power_spectrum(power_law(672, slope)))
    assert found == pytest.approx(slope, abs=0.12)


def test_white_noise_has_its_variance_as_density_at_all_frequencies():
    image = 5.0 * np.random.default_rng(0).standard_normal((448, 672))
    frequencies, density = statistics.power_spectrum(image)
    assert density[5:] == pytest.approx(25.0, rel=0.3)
    assert density[5:].mean() == pytest.approx(25.0, rel=0.02)
    assert frequencies[-1] == 0.5


def test_spectrum_of_an_image_smaller_than_a_tile_is_refused():
    with pytest.raises(ValueError, match="smaller than a tile"):
        statistics.power_spectrum(np.zeros((100, 300)))


@pytest.mark.parametrize("step", [0.5, 4.0])
def test_all_gradients_of_a_ramp_are_in_one_bin(step: float):
    v, u = np.mgrid[:80, :120]
    shares = statistics.gradient_histogram(step * np.sqrt(0.5) * (u + v))
    [index] = np.flatnonzero(shares > 1e-3)
    assert shares[index] == pytest.approx(1.0)
    edges = statistics.GRADIENT_EDGES[index : index + 2]
    assert edges[0] - 1e-3 <= np.log10(step) <= edges[1] + 1e-3


def test_corners_of_a_checkerboard_are_its_inner_crossings():
    image = checkerboard(240, 24)
    places, strengths = statistics.corners(image)
    strong = strengths >= statistics.CORNER_LEVELS[0]
    assert strong.sum() == 81
    # Crossings lie between pixels.
    expected = np.stack(np.meshgrid(24.0 * np.arange(1, 10) - 0.5, 24.0 * np.arange(1, 10) - 0.5), axis=-1)
    distance = np.linalg.norm(places[strong][:, None] - expected.reshape(-1, 2)[None], axis=2).min(axis=0)
    assert distance.max() < 0.1
    assert statistics.corner_density(strengths, image.shape, statistics.CORNER_LEVELS[0]) == pytest.approx(
        1e4 * 81 / 240**2
    )


def test_strength_of_corners_is_in_grey_levels():
    weak, strong = (statistics.corners(checkerboard(120, 24, step))[1][0] for step in (20.0, 60.0))
    assert strong == pytest.approx(3.0 * weak, rel=1e-3)


def test_a_smooth_image_has_no_corners():
    _, strengths = statistics.corners(np.broadcast_to(np.arange(100.0), (80, 100)))
    assert len(strengths) == 0


@pytest.mark.parametrize("seed", range(3))
def test_repeatability_under_the_identity_is_one(seed: int):
    image = np.clip(128 + 40 * power_law(300, -2, seed) / power_law(300, -2, seed).std(), 0, 255).astype(np.uint8)
    assert statistics.repeatability(image, np.eye(3)) == 1.0


def test_repeatability_counts_corners_where_the_homography_takes_them():
    image = checkerboard(240, 24).astype(np.uint8)
    H = np.array([[1.0, 0.0, 7.0], [0.0, 1.0, 11.0], [0.0, 0.0, 1.0]])
    assert statistics.repeatability(image, H) > 0.9


def test_noise_is_recovered_as_a_function_of_brightness():
    rng = np.random.default_rng(1)
    levels = np.array([40.0, 100.0, 180.0])
    sigmas = np.array([1.0, 2.0, 4.0])
    columns = np.repeat(levels, 200) + np.zeros((400, 1))
    image = np.round(columns + np.repeat(sigmas, 200) * rng.standard_normal((400, 600))).astype(np.uint8)
    found = statistics.noise_by_brightness(statistics.noise_patches(image))
    bins = np.digitize(levels, statistics.BRIGHTNESS_EDGES) - 1
    rounding = 1 / 12
    assert found[bins] == pytest.approx(np.sqrt(sigmas**2 + rounding), rel=0.08)
    assert np.isnan(found[0])


def test_noise_is_robust_to_texture_in_part_of_the_image():
    rng = np.random.default_rng(2)
    image = 120.0 + 1.5 * rng.standard_normal((400, 600))
    image[:, :400] += checkerboard(400, 6)[:, :400] - 130.0
    patches = statistics.noise_patches(np.round(image).astype(np.uint8))
    found = statistics.noise_by_brightness(patches, np.array([0.0, 256.0]))
    assert found[0] == pytest.approx(1.53, rel=0.1)


def test_clipped_patches_say_nothing_about_noise():
    image = np.zeros((160, 160), np.uint8)
    image[:, 80:] = 255
    assert len(statistics.noise_patches(image).sigma) == 0


def test_distance_of_shifted_histograms_is_the_shift():
    edges = np.linspace(0.0, 10.0, 101)
    values = np.random.default_rng(0).uniform(2.0, 4.0, 5000)
    first, second = statistics.histogram(values, edges), statistics.histogram(values + 3.0, edges)
    assert statistics.wasserstein(first, second, edges) == pytest.approx(3.0, abs=0.01)
    assert statistics.wasserstein(first, first, edges) == 0.0
    assert statistics.quantile(first, edges, 0.5) == pytest.approx(np.median(values), abs=0.05)


def test_a_set_does_not_differ_from_itself_and_a_contrast_is_found_again():
    texture = power_law(256, -2)
    images = [128 + contrast * texture / texture.std() for contrast in (20.0, 10.0)]
    full, half = (statistics.summarize("set", [image]) for image in images)
    assert not any(difference.distance > 0.0 for difference in compare(full, full).values())
    difference = compare(half, full)
    assert difference["log gradient"].distance == pytest.approx(np.log10(2.0), abs=0.01)
    assert difference["slope"].distance < 1e-6
    assert half.median_gradient == pytest.approx(0.5 * full.median_gradient, rel=0.03)
    assert "log gradient" in [name for name, _, _ in gaps(difference, dict.fromkeys(difference, 0.1))]
    assert gaps(difference, dict.fromkeys(difference, 10.0)) == []
