"""How disparities vary within a keypoint's patch, on images whose disparities are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.patch_disparity_range import patch_disparity_range

WIDTH, HEIGHT = 320, 160
EDGE = 180  # columns before it are nearer, so that the left eye sees nothing that is hidden from the right one
FAR, STEP = 10.0, 12.0


def _pair(disparity: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A textured pair whose right image has that (H, W) disparity."""
    noise = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH + 64)).astype(np.uint8)
    right = cv2.GaussianBlur(noise, (0, 0), 1.2)
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    left = cv2.remap(right, u + 32 - disparity.astype(np.float32), v, cv2.INTER_LINEAR)
    return left, np.ascontiguousarray(right[:, 32 : 32 + WIDTH])


def _keypoints(columns: list[float], disparity: np.ndarray) -> np.ndarray:
    rows = np.linspace(30, HEIGHT - 30, 12)
    places = np.array([(u, v) for u in columns for v in rows])
    return np.column_stack([places, disparity[places[:, 1].astype(int), places[:, 0].astype(int)]])


def test_a_step_within_the_patch_is_seen_and_one_beyond_is_not() -> None:
    disparity = np.where(np.arange(WIDTH) < EDGE, FAR + STEP, FAR) * np.ones((HEIGHT, 1))
    pair = _pair(disparity)
    at = _keypoints([EDGE - 3.0, EDGE + 3.0], disparity)
    away = _keypoints([60.0, 120.0, 260.0], disparity)
    assert np.median(patch_disparity_range(*pair, at, np.zeros((len(at), 2)))) == pytest.approx(STEP, abs=1.5)
    assert np.quantile(patch_disparity_range(*pair, away, np.zeros((len(away), 2))), 0.9) < 0.1 * STEP


def test_the_slope_of_the_surface_is_no_relief() -> None:
    slope = np.array([0.0, 0.2])
    disparity = FAR + slope[1] * np.arange(HEIGHT)[:, None] * np.ones(WIDTH)
    points = _keypoints([100.0, 160.0, 220.0], disparity)
    pair = _pair(disparity)
    level = np.median(patch_disparity_range(*pair, points, np.zeros((len(points), 2))))
    tilted = np.median(patch_disparity_range(*pair, points, np.tile(slope, (len(points), 1))))
    assert level == pytest.approx(12 * slope[1], abs=1.0)
    assert tilted < 0.5 * level


def test_images_without_texture_say_nothing() -> None:
    blank = np.zeros((HEIGHT, WIDTH), np.uint8)
    points = _keypoints([100.0], np.full((HEIGHT, WIDTH), FAR))
    assert (patch_disparity_range(blank, blank, points, np.zeros((len(points), 2))) == 0.0).all()
    assert len(patch_disparity_range(blank, blank, points[:0], np.zeros((0, 2)))) == 0
