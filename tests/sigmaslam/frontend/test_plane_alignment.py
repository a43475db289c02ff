"""Slopes of disparities, what they make of patches seen from elsewhere, and places that such patches give."""

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.affine_alignment import align_patches
from sigmaslam.frontend.image_sharpness import patch_energies, sharpness
from sigmaslam.frontend.lucas_kanade import refine
from sigmaslam.frontend.plane_alignment import disparity_slopes, plane_maps, refine_in_rows, refine_on_planes
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp
from tests.support.warped_images import HEIGHT, WIDTH, corners, digitised, maps_of, textured, warped

CAMERA = RectifiedStereo(WIDTH, HEIGHT, 500.0, 480.0, 320.5, 241.5, 0.3)
ROAD = np.array([0.02, 0.31])


def scattered(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform((20, 20), (WIDTH - 20, HEIGHT - 20), (count, 2))


# Slopes


def test_the_slope_of_a_plane_is_found():
    points = scattered(300)
    slope = disparity_slopes(points, 20.0 + points @ ROAD)
    np.testing.assert_allclose(slope, np.tile(ROAD, (300, 1)), atol=0.02)


def test_a_wall_in_front_of_the_road_does_not_tilt_it():
    points = scattered(800)
    wall = points[:, 0] > 320
    slope = disparity_slopes(points, np.where(wall, 200.0, 20.0 + points @ ROAD))
    error = np.abs(slope - np.where(wall[:, None], 0.0, ROAD)).max(axis=1)
    # Of the points at the very edge a few have no neighbours of their own surface on two sides.
    assert (error < 0.03).mean() > 0.97


def test_without_neighbours_nothing_slopes():
    points = scattered(30)
    disparity = 20.0 + points @ ROAD
    disparity[5:] = np.nan
    slope = disparity_slopes(points, disparity)
    assert slope.shape == (30, 2)
    assert slope[:5].any()
    assert not slope[5:].any()
    assert not disparity_slopes(points[:3], disparity[:3]).any()
    assert disparity_slopes(points[:0], disparity[:0]).shape == (0, 2)


# Maps


def test_maps_agree_with_the_projection_of_points_of_the_plane():
    points = scattered(50)
    disparity = 15.0 + 0.05 * points @ np.array([0.3, 1.0])
    slope = np.tile(0.05 * np.array([0.3, 1.0]), (50, 1))
    T = se3_exp(np.array([0.1, -0.05, -0.8, 0.02, -0.03, 0.1]))
    maps = plane_maps(CAMERA, np.column_stack([points, disparity]), slope, T)

    def seen(offset: np.ndarray) -> np.ndarray:
        there = np.column_stack([points + offset, disparity + slope @ offset])
        return CAMERA.project(CAMERA.triangulate(there) @ T[:3, :3].T + T[:3, 3])[:, :2]

    for offset in np.array([[4.0, 0.0], [0.0, -6.0], [5.0, 5.0]]):
        expected = seen(offset) - seen(np.zeros(2))
        np.testing.assert_allclose((maps.A @ offset) / (1.0 + maps.tilt @ offset)[:, None], expected, atol=1e-9)


def test_without_motion_a_map_is_the_identity():
    points = scattered(20)
    maps = plane_maps(CAMERA, np.column_stack([points, np.full(20, 30.0)]), np.tile(ROAD, (20, 1)), np.eye(4))
    np.testing.assert_allclose(maps.A, np.tile(np.eye(2), (20, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(maps.tilt, 0.0, atol=1e-12)


# Places


def test_a_road_that_comes_nearer_pulls_no_place_towards_its_near_side():
    # A road under a camera that drives on: v' = h + (v - h) / (1 - share (v - h)), the same for u.
    share, horizon = 0.0011, 120.0
    depth = np.array([0.0, -share, 1.0 + share * horizon])
    H = np.array([[1.0, 0.0, -320.5], [0.0, 1.0, -horizon], [0.0, 0.0, 0.0]]) + np.outer([320.5, horizon, 1.0], depth)
    texture = textured()
    image0, image1 = digitised(texture, 1), digitised(warped(texture, H), 2)
    points0, points1 = corners(image0, H)
    below = points0[:, 1] > horizon + 60
    points0, points1 = points0[below], points1[below]
    assert len(points0) > 100
    shifted = refine(image0, image1, points0, points1)
    aligned = refine_on_planes(image0, image1, points0, points1, maps_of(H, points0))
    before, after = shifted.places - points1, aligned.places - points1
    scale = [np.median(np.linalg.norm(error, axis=1)) for error in (before, after)]
    assert scale[1] < 0.5 * scale[0]
    assert abs(np.median(before[:, 1])) > 0.02
    assert abs(np.median(after[:, 1])) < 0.01


def test_disparities_of_a_slope_are_not_those_of_a_shift():
    slope = np.array([0.1, 0.3])
    H = np.array([[1.0 - slope[0], -slope[1], 60.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    texture = textured()
    left, right = digitised(texture, 1), digitised(warped(texture, H), 2)
    points0, points1 = corners(left, H)
    shifted, (aligned, _) = refine(left, right, points0, points1), refine_in_rows(left, right, points0, points1)
    errors = [np.median(np.abs(found.places[:, 0] - points1[:, 0])) for found in (shifted, aligned)]
    assert errors[1] < 0.5 * errors[0]
    assert aligned.A is None


def test_no_tilt_is_a_tilt_of_zero():
    texture = textured()
    H = np.array([[1.1, 0.0, -20.0], [0.0, 1.1, -20.0], [0.0, 0.0, 1.0]])
    image0, image1 = digitised(texture, 1), digitised(warped(texture, H), 2)
    points0, points1 = corners(image0, H)
    maps = maps_of(H, points0)
    plain, _, _ = align_patches(image0, image1, points0, points1 + 0.5, maps.A)
    tilted, _, _ = align_patches(image0, image1, points0, points1 + 0.5, maps.A, np.zeros((len(points0), 2)))
    np.testing.assert_array_equal(plain, tilted)


@pytest.mark.parametrize("shift", [0.1, 0.25])
def test_what_moves_alike_is_not_misplaced_alike_between_pixels(shift):
    """All keypoints on pixels, all at the same place between two in the other image: bilinear samples are 0.012 off."""
    H = np.eye(3)
    H[0, 2] = shift
    image0, image1 = digitised(textured(), 1), digitised(warped(textured(), H), 2)
    points0, points1 = corners(image0, H)
    places, moved, _ = align_patches(image0, image1, points0, points1 + 0.3, np.tile(np.eye(2), (len(points0), 1, 1)))
    assert moved.mean() > 0.95
    assert np.abs((places - points1)[moved].mean(axis=0)).max() < 0.006


# Sharpness


@pytest.mark.parametrize(("kernel", "least", "most"), [((11, 1), 0.4, 0.8), ((5, 5), 0.2, 0.6), ((1, 1), 1.0, 1.0)])
def test_blur_is_less_sharp_and_darkness_is_not(kernel, least, most):
    image = digitised(textured(), 3)
    whole = sharpness(image)
    assert least <= sharpness(cv2.blur(image, kernel)) / whole <= most
    assert sharpness((0.5 * image + 20.0).astype(np.uint8)) == pytest.approx(whole, rel=0.02)
    assert sharpness(np.full_like(image, 7)) == 0.0


def test_energies_of_patches_are_those_of_the_image_cut_out():
    image = digitised(textured(), 3)
    places = np.array([[60.2, 40.0], [100.0, 71.4]])
    for place, (first, second) in zip(places, patch_energies(image, places), strict=True):
        u, v = np.rint(place).astype(int)
        # The derivatives need a margin, which the mean leaves out; its own border is that of the whole image.
        cut = image[v - 30 : v + 31, u - 30 : u + 31]
        alone = patch_energies(cut, np.array([[30.0, 30.0]]))[0]
        np.testing.assert_allclose((first, second), alone, rtol=1e-6)
    # All over the image they say what it does.
    grid = np.stack(np.meshgrid(*(np.arange(11, side - 11, 15) for side in image.shape[::-1])), axis=-1).reshape(-1, 2)
    sharp, blurred = (patch_energies(each, grid).sum(axis=0) for each in (image, cv2.blur(image, (11, 1))))
    expected = sharpness(cv2.blur(image, (11, 1))) / sharpness(image)
    assert blurred[1] / blurred[0] / (sharp[1] / sharp[0]) == pytest.approx(expected, rel=0.05)
    assert not patch_energies(np.full_like(image, 7), places).any()
    assert patch_energies(image, np.zeros((0, 2))).shape == (0, 2)


def test_energies_outside_the_image_are_those_at_its_edge():
    image = digitised(textured(), 3)
    height = len(image)
    outside, edge = np.array([[-5.0, height + 9.0]]), np.array([[0.0, height - 1.0]])
    np.testing.assert_array_equal(patch_energies(image, outside), patch_energies(image, edge))
