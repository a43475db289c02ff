"""The filters of one image against formulas of their own, known answers and OpenCV."""

from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.image_filtering import NoiseModel, denoise_image, estimate_noise
from sigmaslam.image_filtering import group_filter as groups
from sigmaslam.image_filtering.patch_filter import filter_patches
from sigmaslam.readers.images import read_grey

DEMO = Path(__file__).resolve().parents[3] / "synthetic" / "sigmaslam_synthetic" / "demo" / "image_0"


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return read_grey(DEMO / "000000.png")[:160, :200]


def psnr(estimate: np.ndarray, truth: np.ndarray) -> float:
    return float(10 * np.log10(255.0**2 / np.mean((estimate.astype(float) - truth) ** 2)))


def test_the_patch_filter_equals_a_loop_over_patches(truth: np.ndarray):
    rng = np.random.default_rng(0)
    image = (truth[:40, :45] + rng.normal(0.0, 20.0, (40, 45))).astype(np.float32)
    variance = rng.uniform(300.0, 500.0, image.shape).astype(np.float32)
    pilot = loop_over_patches(image, variance, None)
    np.testing.assert_allclose(filter_patches(image, variance), loop_over_patches(image, variance, pilot), atol=2e-2)


def loop_over_patches(image: np.ndarray, variance: np.ndarray, pilot: np.ndarray | None) -> np.ndarray:
    """Hard thresholds at 2.7 sigma, or Wiener's filter with the pilot's power, by OpenCV's transform."""
    padded, noise = (np.pad(each.astype(float), 7, mode="reflect") for each in (image, variance))
    guide = None if pilot is None else np.pad(pilot.astype(float), 7, mode="reflect")
    total, weights = np.zeros_like(padded), np.zeros_like(padded)
    for y, x in product(range(0, padded.shape[0] - 7, 2), range(0, padded.shape[1] - 7, 2)):
        at = slice(y, y + 8), slice(x, x + 8)
        power, coefficients = noise[at].mean(), cv2.dct(padded[at])
        if guide is None:
            kept = (coefficients**2 > 2.7**2 * power).astype(float)
            kept[0, 0] = 1.0
        else:
            prior = cv2.dct(guide[at]) ** 2
            kept = prior / (prior + power)
        weight = 1.0 / (max((kept**2).sum(), 1.0) * power)
        total[at] += weight * cv2.idct(coefficients * kept)
        weights[at] += weight
    inner = slice(7, -7), slice(7, -7)
    return np.asarray(total[inner] / weights[inner])


def test_the_posterior_of_a_group_equals_the_dense_formula():
    rng = np.random.default_rng(0)
    size = groups._SIZE
    offsets = np.array([60 * y + x for y, x in product(range(size), repeat=2)])
    guide, image = rng.normal(100.0, 30.0, (2, 60 * 60)).astype(np.float32)
    members = rng.choice(3000, (3, groups._MEMBERS), replace=False)
    noise = np.full(60 * 60, 250.0, np.float32)
    estimates, weight = groups._posterior(image, guide, noise, members, offsets)
    for k, group in enumerate(members):
        prior, measured = guide[group[:, None] + offsets].astype(float), image[group[:, None] + offsets].astype(float)
        covariance = np.cov(prior, rowvar=False)
        gain = covariance @ np.linalg.inv(covariance + 250.0 * np.eye(size * size))
        expected = prior.mean(axis=0) + (measured - prior.mean(axis=0)) @ gain.T
        np.testing.assert_allclose(estimates[k], expected, atol=0.05)
        assert weight[k] == pytest.approx(1.0 / (250.0 * np.trace(gain @ gain)), rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("sigma", [15.0, 50.0])
def test_ours_beats_non_local_means_and_the_thorough_one_beats_ours(truth: np.ndarray, sigma: float):
    noisy = truth + np.random.default_rng(0).normal(0.0, sigma, truth.shape)
    bytes_ = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    means = cv2.fastNlMeansDenoising(bytes_, None, 0.9 * sigma, 7, 21)
    ours, thorough = (psnr(denoise_image(noisy, NoiseModel(sigma), each), truth) for each in (False, True))
    assert ours > psnr(means, truth) + 0.5
    assert thorough > ours + 0.1


def test_a_flat_image_keeps_its_mean_and_loses_nearly_all_of_its_noise():
    noisy = 90.0 + np.random.default_rng(0).normal(0.0, 20.0, (96, 96))
    for thorough in (False, True):
        estimate = denoise_image(noisy, NoiseModel(20.0), thorough)
        assert estimate.mean() == pytest.approx(noisy.mean(), abs=0.3)
        assert estimate.std() < 4.0


def test_an_image_without_noise_is_left_as_it_is(truth: np.ndarray):
    np.testing.assert_array_equal(denoise_image(truth, NoiseModel(0.0)), truth)


def test_a_turned_image_gives_the_turned_result(truth: np.ndarray):
    noisy = (truth + np.random.default_rng(0).normal(0.0, 20.0, truth.shape))[:64, :96]
    np.testing.assert_allclose(
        denoise_image(noisy.T.copy(), NoiseModel(20.0)), denoise_image(noisy, NoiseModel(20.0)).T, atol=1e-2
    )


def test_a_quantised_value_stays_in_its_bin(truth: np.ndarray):
    step = 17.0
    coarse = (np.rint(truth / step) * step).astype(np.uint8)
    estimate = denoise_image(coarse, NoiseModel(0.0, step=step))
    assert np.abs(estimate - coarse).max() <= step / 2 + 1e-3
    assert psnr(estimate, truth) > psnr(coarse, truth) + 1.0


def test_stuck_pixels_are_filled_in(truth: np.ndarray):
    drawn = np.random.default_rng(0).random(truth.shape)
    spoiled = np.where(drawn < 0.1, 0, np.where(drawn > 0.9, 255, truth)).astype(np.uint8)
    estimate = denoise_image(spoiled, estimate_noise(spoiled))
    assert psnr(estimate, truth) > psnr(cv2.medianBlur(spoiled, 3), truth) + 5.0


@pytest.mark.parametrize("shape", [(31, 64), (64, 64, 3)])
def test_other_shapes_are_refused(shape: tuple[int, ...]):
    with pytest.raises(ValueError, match="shape"):
        denoise_image(np.zeros(shape), NoiseModel(1.0))


@pytest.mark.parametrize(("blur", "sigma", "gain"), [(1.6, 2.0, 2.0), (2.5, 2.0, 2.0), (1.6, 8.0, 1.5)])
def test_a_blur_that_is_known_is_taken_out(truth: np.ndarray, blur: float, sigma: float, gain: float):
    rng = np.random.default_rng(3)
    soft = cv2.GaussianBlur(truth.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REFLECT)
    noisy = np.clip(np.rint(soft + rng.normal(0.0, sigma, truth.shape)), 0, 255).astype(np.uint8)
    sharp = denoise_image(noisy, NoiseModel(sigma, blur=blur))
    assert psnr(sharp, truth) > psnr(noisy, truth) + gain
    assert psnr(sharp, truth) > psnr(denoise_image(noisy, NoiseModel(sigma)), truth) + gain
    # What is found explains what was seen: its blur is off by about the noise.
    again = cv2.GaussianBlur(sharp, (0, 0), blur, borderType=cv2.BORDER_REFLECT)
    assert np.sqrt(np.mean((again - noisy) ** 2)) < 1.2 * sigma


def test_an_even_image_has_no_blur_to_take_out():
    even = np.full((40, 56), 90, np.uint8)
    np.testing.assert_allclose(denoise_image(even, NoiseModel(1.0, blur=2.0)), 90.0, atol=1e-3)


def test_a_negative_blur_is_refused():
    with pytest.raises(ValueError, match="blur is -1"):
        NoiseModel(1.0, blur=-1.0)
