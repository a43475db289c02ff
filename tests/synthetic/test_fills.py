from itertools import pairwise

import numpy as np
import pytest

from sigmaslam_synthetic.rendering.fills import FILLS, bricks, cells, checker, glyphs, noise, stripes, strokes, vessels

TEXTURED = [name for name in FILLS if name != "flat"]
SEEDS = range(8)


def power(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Power (N,) and frequency (N,), cycles a pixel, of the upper half plane without the mean."""
    window = np.hanning(image.shape[0])[:, None] * np.hanning(image.shape[1])
    spectrum = np.abs(np.fft.rfft2((image - image.mean()) * window)) ** 2
    frequency = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1]))
    return spectrum.ravel()[1:], frequency.ravel()[1:]


def roughness(image: np.ndarray) -> float:
    """Mean squared step to the next pixel: fine patterns have more."""
    return float((np.diff(image, axis=0) ** 2).mean() + (np.diff(image, axis=1) ** 2).mean())


@pytest.mark.parametrize("name", FILLS)
def test_fills_are_reproducible_and_differ_with_the_seed(name):
    first, again, other = (FILLS[name]((96, 70), np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert name == "flat" or np.abs(first - other).mean() > 0.1


@pytest.mark.parametrize("name", FILLS)
@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (3, 150), (61, 40)])
def test_fills_have_the_shape_asked_for(name, shape):
    for seed in SEEDS:
        image = FILLS[name](shape, np.random.default_rng(seed))
        assert image.shape == shape
        assert image.dtype == np.float32
        assert np.isfinite(image).all()


@pytest.mark.parametrize("name", TEXTURED)
def test_fills_have_zero_mean_and_unit_deviation(name):
    for seed in SEEDS:
        image = FILLS[name]((128, 128), np.random.default_rng(seed))
        assert image.mean() == pytest.approx(0, abs=1e-3)
        assert image.std() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("persistence", "slope"), [(1.0, -2.0), (0.7, -3.0)])
def test_noise_has_a_power_law_spectrum(persistence, slope):
    """An octave's amplitude is `persistence` of the one before: power falls as f^(2 log2(persistence) - 2)."""
    slopes = []
    for seed in SEEDS:
        spectrum, frequency = power(noise((256, 256), np.random.default_rng(seed), persistence))
        edges = np.geomspace(0.02, 0.25, 8)
        bands = [spectrum[(frequency >= a) & (frequency < b)].mean() for a, b in pairwise(edges)]
        slopes.append(np.polyfit(np.log(edges[:-1]), np.log(bands), 1)[0])
    assert np.mean(slopes) == pytest.approx(slope, abs=0.4)


@pytest.mark.parametrize("period", [6.0, 17.0])
def test_the_spectrum_of_stripes_peaks_at_their_period_or_a_harmonic(period):
    found = []
    for seed in range(16):
        spectrum, frequency = power(stripes((192, 192), np.random.default_rng(seed), period))
        harmonic = frequency[spectrum.argmax()] * period
        found.append(abs(harmonic - max(1, round(harmonic))) < 0.15)
    assert np.mean(found) > 0.8


def test_level_bricks_repeat_down_the_wall():
    for seed in SEEDS:
        rows = bricks((200, 200), np.random.default_rng(seed), 20.0, level=True).mean(axis=1)
        spectrum = np.abs(np.fft.rfft(rows))  # ten courses: the mortar is in the multiples of frequency 10
        assert spectrum[[9, 10, 11, 19, 20, 21, 29, 30, 31]].max() > 2 * np.median(spectrum[1:])


def test_a_lattice_has_few_frequencies_and_noise_has_many():
    def share(image: np.ndarray) -> float:
        spectrum = np.sort(power(image)[0])
        return float(spectrum[-60:].sum() / spectrum.sum())

    lattice = [share(checker((192, 192), np.random.default_rng(seed))) for seed in SEEDS]
    grain = [share(noise((192, 192), np.random.default_rng(seed), 1.0)) for seed in SEEDS]
    assert min(lattice) > 0.4
    assert np.median(lattice) > 1.5 * np.median(grain)


@pytest.mark.parametrize(
    ("fill", "fine", "coarse"),
    [(cells, 8.0, 40.0), (strokes, 6.0, 40.0), (glyphs, 8.0, 40.0), (bricks, 6.0, 40.0), (checker, 8.0, 40.0)],
)
def test_the_length_given_sets_the_scale_of_the_pattern(fill, fine, coarse):
    ratio = [
        roughness(fill((160, 160), np.random.default_rng(seed), fine))
        / roughness(fill((160, 160), np.random.default_rng(seed), coarse))
        for seed in SEEDS
    ]
    assert np.median(ratio) > 1.7


def test_strokes_of_one_direction_are_coherent():
    def coherence(image: np.ndarray) -> float:
        v, u = np.gradient(image)
        tensor = np.array([[(u * u).sum(), (u * v).sum()], [(u * v).sum(), (v * v).sum()]])
        small, large = np.linalg.eigvalsh(tensor)
        return float((large - small) / (large + small))

    combed = [coherence(strokes((160, 160), np.random.default_rng(s), 24.0, 0.05)) for s in SEEDS]
    tousled = [coherence(strokes((160, 160), np.random.default_rng(s), 24.0, 3.0)) for s in SEEDS]
    assert np.median(combed) > 2 * np.median(tousled)


def test_glyphs_are_ink_on_paper():
    """Two values, that of the paper being the more frequent, hold most pixels."""
    for seed in SEEDS:
        image = glyphs((160, 160), np.random.default_rng(seed), 30.0)
        ends = np.minimum(image - image.min(), image.max() - image)
        assert (ends < 0.05 * np.ptp(image)).mean() > 0.7


def test_vessels_are_thin_dark_lines_that_branch():
    skewness = [(vessels((256, 256), np.random.default_rng(seed)) ** 3).mean() for seed in SEEDS]
    assert np.median(skewness) < -1
    narrow, wide = (
        np.median([roughness(vessels((256, 256), np.random.default_rng(s), width)) for s in SEEDS])
        for width in (2.0, 10.0)
    )
    assert narrow > wide
