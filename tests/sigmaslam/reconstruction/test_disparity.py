from __future__ import annotations

import cv2
import numpy as np
import pytest

from sigmaslam.reconstruction import disparity
from sigmaslam.reconstruction.disparity import align_disparity, measure_disparity, row_offset, semi_global_disparity
from tests.support.textured_pairs import textured_pair

HEIGHT, WIDTH = 120, 200


def test_alignment_finds_the_fraction_of_a_pixel_on_a_slanted_surface():
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    true = (9.3 + 0.02 * u - 0.03 * v).astype(np.float32)
    left, right = textured_pair(true, noise=0.0)
    found = align_disparity(left, right, np.round(true)).disparity
    inner = (slice(10, -10), slice(30, -10))
    assert np.median(np.abs(found - true)[inner]) < 0.03
    assert np.median(np.abs(np.round(true) - true)[inner]) > 0.2


@pytest.mark.parametrize("size", [(41, 53), (4, 5), (30, 64)])
def test_compiled_steps_are_those_of_numpy(size: tuple[int, int], monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("sigmaslam.reconstruction._depths", reason="installed without a compiler")
    rng = np.random.default_rng(0)
    images = rng.uniform(0.0, 255.0, (3, *size)).astype(np.float32)
    weight = (rng.random(size) > 0.3).astype(np.float32)
    found = np.where(weight > 0, images[0], disparity._NOWHERE)

    def results() -> list[np.ndarray]:
        return [*disparity._gauss_newton(*images, weight), disparity._variance(found, *images[1:], images[0], 0.1)]

    compiled = results()
    monkeypatch.setattr(disparity, "kernels", None)
    for one, another in zip(compiled, results(), strict=True):
        np.testing.assert_allclose(one, another, rtol=1e-3, atol=1e-5)


def test_brightness_that_differs_by_an_offset_changes_nothing():
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    left, right = textured_pair(true, noise=0.0)
    dimmer = cv2.subtract(right, 20)
    plain, offset = (align_disparity(left, each, np.round(true)).disparity for each in (right, dimmer))
    assert np.median(np.abs(plain - offset)[10:-10, 30:-10]) < 0.01


@pytest.mark.parametrize("noise", [2.0, 6.0])
def test_noise_makes_the_errors_and_the_claimed_variance_grow_alike(noise: float):
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    measured = measure_disparity(*textured_pair(true, noise), semi_global_disparity)
    inner = np.zeros_like(true, bool)
    inner[10:-10, 30:-10] = True
    inner &= np.isfinite(measured.disparity)
    assert inner.mean() > 0.5
    sigmas = np.abs(measured.disparity - true)[inner] / np.sqrt(measured.variance[inner])
    assert np.mean(sigmas < 1.96) > 0.90
    assert np.median(sigmas) > 0.15


def test_more_noise_is_more_variance():
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    medians = [
        np.nanmedian(measure_disparity(*textured_pair(true, noise), semi_global_disparity).variance)
        for noise in (1.0, 4.0, 8.0)
    ]
    assert medians == sorted(medians)
    assert medians[2] > 3.0 * medians[0]


def test_without_a_match_there_is_neither_disparity_nor_variance():
    rng = np.random.default_rng(3)
    left, right = rng.integers(0, 255, (2, HEIGHT, WIDTH)).astype(np.uint8)
    measured = measure_disparity(left, right, semi_global_disparity)
    assert np.isnan(measured.disparity).mean() > 0.8
    assert np.array_equal(np.isnan(measured.disparity), np.isnan(measured.variance))


def test_what_the_right_image_does_not_show_has_no_disparity():
    true = np.full((HEIGHT, WIDTH), 20.0, np.float32)
    found = semi_global_disparity(*textured_pair(true, noise=1.0))
    assert np.nanmin(np.arange(WIDTH) - found) >= 0.0
    assert np.isfinite(found[10:-10, 30:-10]).mean() > 0.9


def test_a_near_body_in_a_wide_image_widens_the_search_whatever_the_size_it_is_looked_for_at():
    true = np.full((2 * HEIGHT, 6 * WIDTH), 10.0, np.float32)
    true[30:120, 700:790] = 90.0
    found = semi_global_disparity(*textured_pair(true, noise=1.0))
    assert np.mean(np.abs(found - true)[35:115, 710:780] < 1.0) > 0.8


def test_chance_matches_of_one_direction_do_not_widen_the_search(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(disparity, "_SPECKLE", 0)
    rng = np.random.default_rng(3)
    left, right = rng.integers(0, 255, (2, HEIGHT, 2 * WIDTH)).astype(np.uint8)
    one_way = np.isfinite(disparity._semi_global(left, right, 150.0)).sum()
    assert one_way > 200
    assert np.isfinite(disparity._seen_by_both(left, right, 150.0)).sum() < 0.5 * one_way
    true = np.full((HEIGHT, 2 * WIDTH), 12.0, np.float32)
    found = disparity._seen_by_both(*textured_pair(true, noise=1.0), 150.0)
    assert np.isfinite(found).sum() > 0.8 * true.size
    np.testing.assert_allclose(np.nanpercentile(found, 99.8), 12.0, atol=0.5)


def test_rows_that_are_off_are_found_and_do_not_move_the_disparity():
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    left, right = textured_pair(true, noise=1.0)
    offset = (0.3 - 0.4 * (u / WIDTH - 0.5)).astype(np.float32)
    lower = cv2.remap(right, u.astype(np.float32), (v - offset).astype(np.float32), cv2.INTER_CUBIC)
    found = row_offset(left.astype(np.float32), lower.astype(np.float32), true)
    np.testing.assert_allclose(found[10:-10, 20:-20], offset[10:-10, 20:-20], atol=0.1)
    errors = [align_disparity(left, each, np.round(true)).disparity - true for each in (right, lower)]
    inner = (slice(10, -10), slice(30, -10))
    assert np.std(errors[1][inner]) < 1.2 * np.std(errors[0][inner])


def test_unlike_gains_change_little():
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    left, right = textured_pair(true, noise=0.0)
    dimmer = np.clip(0.8 * right, 0, 255).astype(np.uint8)
    plain, dim = (align_disparity(left, each, np.round(true)).disparity for each in (right, dimmer))
    assert np.median(np.abs(plain - dim)[10:-10, 30:-10]) < 0.02


def test_what_is_saturated_is_no_disparity():
    true = np.full((HEIGHT, WIDTH), 7.4, np.float32)
    left, right = textured_pair(true, noise=1.0)
    left[:, 90:150], right[:, 80:144] = 255, 255
    measured = measure_disparity(left, right, semi_global_disparity)
    assert np.isfinite(measured.disparity[10:-10, 110:130]).mean() < 0.05
    assert np.isfinite(measured.disparity[10:-10, 30:80]).mean() > 0.5
