import numpy as np
import pytest

from sigmaslam_synthetic.rendering.textures import KINDS, dead_leaves, leaf_outline, leaf_radii, paint

NAMED = {"leaves", "noise", "stripes", "bricks", "cells", "strokes", "glyphs", "vessels", "facade", "asphalt"}


@pytest.mark.parametrize("shape", [(64, 96), (97, 33), (8, 8)])
def test_dead_leaves_are_reproducible_grey_images_with_texture(shape):
    first, second = (dead_leaves(shape, np.random.default_rng(7)) for _ in range(2))
    assert first.shape == shape
    assert first.dtype == np.uint8
    np.testing.assert_array_equal(first, second)
    assert first.std() > 5
    assert (dead_leaves(shape, np.random.default_rng(8)) != first).mean() > 0.5


@pytest.mark.parametrize("exponent", [1.3, 2.0, 3.0])
def test_leaf_sizes_follow_the_power_law_asked_for(exponent):
    """The maximum-likelihood exponent of a power law without upper end is 1 + 1 / mean(log(r / low))."""
    radii = leaf_radii(np.random.default_rng(0), 40_000, exponent, 3.0, 1e30)
    assert 1.0 + 1.0 / np.log(radii / 3.0).mean() == pytest.approx(exponent, abs=0.03)
    bounded = leaf_radii(np.random.default_rng(0), 1000, exponent, 3.0, 80.0)
    assert bounded.min() >= 3.0
    assert bounded.max() <= 80.0


def test_an_outline_scales_with_its_radius():
    for seed in range(40):
        small, large = (leaf_outline(radius, np.random.default_rng(seed)) for radius in (2.0, 20.0))
        np.testing.assert_allclose(large, 10.0 * small, rtol=1e-9, atol=1e-9)
        assert len(small) >= 3
        assert 0.3 < np.linalg.norm(small, axis=1).max() / 2.0 < 2.0


def test_dead_leaves_have_the_edges_that_noise_lacks():
    """Derivatives of natural images have heavy tails; those of Gaussian noise have a kurtosis of 3."""

    def kurtosis(image: np.ndarray) -> float:
        step = np.diff(image.astype(float), axis=1)
        return float((step**4).mean() / (step**2).mean() ** 2)

    leaves, grain = (np.median([kurtosis(paint(kind, 160, seed)) for seed in range(8)]) for kind in ("leaves", "noise"))
    assert leaves > 2 * grain


@pytest.mark.parametrize("kind", KINDS)
def test_paint_depends_on_its_arguments_alone(kind):
    first = paint(kind, 96, 2)
    paint("leaves", 32, 5)
    np.testing.assert_array_equal(paint(kind, 96, 2), first)
    assert first.shape == (96, 96)
    assert first.dtype == np.uint8
    assert not first.flags.writeable
    assert (paint(kind, 96, 3) != first).mean() > 0.3


@pytest.mark.parametrize("kind", KINDS)
def test_textures_of_a_kind_have_contrast_and_vary_in_brightness(kind):
    images = np.stack([paint(kind, 128, seed) for seed in range(10)]).astype(float)
    assert np.median(images.std(axis=(1, 2))) > (3 if kind == "plaster" else 8)
    assert images.mean(axis=(1, 2)).std() > 5


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [8, 17])
def test_small_textures_can_be_painted(kind, size):
    assert paint(kind, size, 0).shape == (size, size)


def test_kinds_do_not_share_their_random_numbers(monkeypatch):
    """With one seed, each kind draws from a stream of its own."""
    named, default_rng = [], np.random.default_rng
    monkeypatch.setattr(np.random, "default_rng", lambda name: named.append(name) or default_rng(name))
    for kind in KINDS:
        paint(kind, 8, 1)
    streams = {name for name in named if isinstance(name, tuple)}
    states = {tuple(np.random.SeedSequence(name).generate_state(4)) for name in streams}
    assert len(states) == len(streams) == len(KINDS)


def test_all_surfaces_and_patterns_of_the_worlds_can_be_named():
    assert set(KINDS) >= NAMED | {"grass", "tissue", "wood", "plaster"}


def test_an_unknown_kind_is_refused():
    with pytest.raises(ValueError, match=r"unknown texture 'marble'.*leaves"):
        paint("marble", 64, 0)
