"""Noise that is known is estimated, and stuck pixels are told from bright and dark ones."""

import numpy as np
import pytest

from sigmaslam.image_filtering.noise import (
    NoiseModel,
    estimate_noise,
    impulse_share,
    mean_of_others,
    quantiser_step,
    stuck_pixels,
)


def ramp(height: int = 128, width: int = 256) -> np.ndarray:
    """Grey levels 40 to 200 from left to right."""
    return np.tile(np.linspace(40.0, 200.0, width), (height, 1))


@pytest.mark.parametrize("sigma", [2.0, 10.0, 25.0])
def test_the_sigma_of_gaussian_noise_is_found(sigma: float):
    noise = estimate_noise(ramp() + np.random.default_rng(0).normal(0.0, sigma, (128, 256)))
    assert noise.variance(np.array(120.0)) == pytest.approx(sigma**2, rel=0.15)
    assert noise.variance(np.array(200.0)) / noise.variance(np.array(40.0)) < 1.5


def test_the_gain_of_shot_noise_is_found():
    gain = 4.0
    noise = estimate_noise(np.random.default_rng(0).poisson(ramp() / gain) * gain)
    for signal in (60.0, 180.0):
        assert noise.variance(np.array(signal)) == pytest.approx(gain * signal, rel=0.2)


def test_the_variance_is_the_sum_of_its_parts():
    np.testing.assert_allclose(NoiseModel(3.0, 2.0, 6.0).variance(np.array([-5.0, 0.0, 10.0])), [12.0, 12.0, 32.0])


@pytest.mark.parametrize("bits", [1, 3, 4, 7])
def test_the_step_of_a_coarse_quantiser_is_found(bits: int):
    steps = 2**bits - 1
    image = np.rint(np.rint(ramp() / 255 * steps) * 255 / steps).astype(np.uint8)
    assert quantiser_step(image) == pytest.approx(255 / steps)
    image[0, 0] ^= 1
    assert quantiser_step(image) == 0.0


@pytest.mark.parametrize("share", [0.02, 0.2, 0.4])
def test_the_share_of_stuck_pixels_is_found(share: float):
    rng = np.random.default_rng(1)
    drawn, image = rng.random((128, 256)), ramp() + rng.normal(0.0, 3.0, (128, 256))
    image = np.where(drawn < share / 2, 0, np.where(drawn > 1 - share / 2, 255, image)).astype(np.uint8)
    noise = estimate_noise(image)
    assert noise.impulses == pytest.approx(share, rel=0.1)
    wrong = stuck_pixels(image, noise) != ((drawn < share / 2) | (drawn > 1 - share / 2))
    assert wrong.mean() < 2e-3
    assert noise.variance(np.array(120.0)) == pytest.approx(9.0, rel=0.35)


def test_saturated_noise_and_saturated_areas_are_not_taken_for_stuck_pixels():
    noisy = np.clip(ramp() + np.random.default_rng(0).normal(0.0, 40.0, (128, 256)), 0, 255).astype(np.uint8)
    assert impulse_share(noisy) == 0.0
    sky = ramp().astype(np.uint8)
    sky[:40] = 255
    assert not stuck_pixels(sky, NoiseModel(1.0, impulses=0.1))[:38].any()


def test_the_mean_of_others_leaves_pixels_out():
    image, left_out = np.full((9, 9), 10.0), np.zeros((9, 9), bool)
    image[4, 4], left_out[4, 4] = 1000.0, True
    np.testing.assert_allclose(mean_of_others(image, left_out, 3), 10.0, rtol=1e-6)


@pytest.mark.parametrize("values", [{"sigma": -1.0}, {"sigma": np.nan}, {"sigma": 1.0, "impulses": 1.0}])
def test_impossible_noise_is_refused(values: dict[str, float]):
    with pytest.raises(ValueError, match=r"-1|nan|below 1"):
        NoiseModel(**values)


def test_a_tiny_image_is_refused():
    with pytest.raises(ValueError, match="20x31"):
        estimate_noise(np.zeros((31, 20), np.uint8))
