"""Places on what moves: carried by optical flow, kept while they move, given up where they rest."""

import numpy as np
import pytest

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.moving_region import MovingRegion

CAMERA = RectifiedStereo(200.0, 200.0, 80.0, 60.0, 0.1, 160, 120)
DEPTH = 4.0
PLACES = np.array([[60.0, 40.0], [70.0, 50.0], [62.0, 64.0]])


@pytest.fixture
def texture() -> np.ndarray:
    """(120, 200) smooth noise."""
    rng, grid = np.random.default_rng(0), np.mgrid[0:120, 0:200]
    waves = rng.uniform(-0.5, 0.5, (30, 2)), rng.uniform(0.0, 2 * np.pi, 30)
    image = sum(np.cos(np.tensordot(k, grid, 1) + phase) for k, phase in zip(*waves, strict=True))
    return np.uint8(np.clip(128.0 + 12.0 * image, 0, 255))


def region_in(image: np.ndarray, patience: int) -> MovingRegion:
    """Of the three places at rest at `DEPTH`, as the camera at the origin sees them."""
    region = MovingRegion(10.0, patience)
    region.carry(image, np.eye(4), CAMERA)
    disparity = np.full((3, 1), CAMERA.focal_baseline / DEPTH)
    region.add(PLACES, CAMERA.triangulate(np.hstack([PLACES, disparity])), np.zeros((3, 2)))
    return region


def test_a_region_goes_where_the_image_goes(texture: np.ndarray):
    region = region_in(texture[:, :160].copy(), patience=0)
    for shift in (3, 6, 9):
        region.carry(texture[:, shift : shift + 160].copy(), np.eye(4), CAMERA)
    moved = PLACES - (9.0, 0.0)
    assert region.covers(moved, share=0.05).all()  # half a pixel
    assert not region.covers(moved + (0.0, 40.0)).any()


def test_places_at_rest_are_given_up_after_the_patience(texture: np.ndarray):
    image = texture[:, :160].copy()
    region = region_in(image, patience=2)
    carried = []
    for _ in range(3):
        region.carry(image, np.eye(4), CAMERA)
        carried.append(bool(region))
    assert carried == [True, True, False]


def test_what_the_camera_passes_rests(texture: np.ndarray):
    """The image shifts as the camera's own way makes it."""
    region = region_in(texture[:, :160].copy(), patience=0)
    pose = np.eye(4)
    pose[0, 3] = 6.0 * DEPTH / CAMERA.fx
    region.carry(texture[:, 6:166].copy(), pose, CAMERA)
    assert not region


@pytest.mark.parametrize("step", [9.0, 0.0, -9.0])
def test_a_motion_that_the_image_does_not_show_is_forgotten(texture: np.ndarray, step: float):
    """The image shifts as if the camera, which stands, went 9 px to the right; what else it may do was expected."""
    region = region_in(texture[:, :160].copy(), patience=0)
    region.carry(texture[:, 9:169].copy(), np.eye(4), CAMERA)
    expected = np.eye(4)
    expected[0, 3] = step * DEPTH / CAMERA.fx
    region.keep_if_seen_from(expected, CAMERA)
    assert bool(region) == (step > 0.0)


def test_an_empty_region_covers_nothing():
    assert not MovingRegion(10.0, 0).covers(PLACES).any()
