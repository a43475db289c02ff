"""Maps around matches from their neighbours, and patches aligned by them: known fields and known warps."""

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from sigmaslam.frontend.affine_alignment import align_patches, local_maps
from sigmaslam_synthetic.rendering.textures import dead_leaves

WIDTH, HEIGHT = 640, 480
FIELDS = {
    "sheared": np.array([[1.1, -0.3], [0.25, 0.9]]),
    "turned by 35 degrees, 0.6 times as large": 0.6 * np.array([[0.819, -0.574], [0.574, 0.819]]),
    "turned by 35 degrees, 1.7 times as large": 1.7 * np.array([[0.819, -0.574], [0.574, 0.819]]),
}
OFFSET = np.array([30.0, -20.0])
ZOOMS = (0.6, 1.0, 1.7)


@dataclass(frozen=True, slots=True)
class View:
    """A textured image, the same turned by 35 degrees and scaled, and places on corners of the first.

    Attributes:
        image0, image1: (480, 640) uint8, each with noise of 2 grey levels.
        points0, points1: (N, 2) true correspondences, with 30 pixels or more around them in both images.
        A: (N, 2, 2) Jacobians of the homography.
    """

    image0: np.ndarray
    image1: np.ndarray
    points0: np.ndarray
    points1: np.ndarray
    A: np.ndarray


def view(zoom: float) -> View:
    rng = np.random.default_rng(1)
    texture = dead_leaves((HEIGHT, WIDTH), np.random.default_rng(0)).astype(np.float32)
    cosine, sine = zoom * np.cos(np.radians(35.0)), zoom * np.sin(np.radians(35.0))
    centred = np.array([[1.0, 0.0, -WIDTH / 2], [0.0, 1.0, -HEIGHT / 2], [0.0, 0.0, 1.0]])
    H = np.array([[cosine, -sine, WIDTH / 2], [sine, cosine, HEIGHT / 2], [2e-4, -1e-4, 1.0]]) @ centred
    # Each pixel is the mean of 4 x 4 samples: no aliasing.
    fine = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]]) @ H
    large = cv2.warpPerspective(
        texture, fine, (4 * WIDTH, 4 * HEIGHT), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101
    )
    warped = cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    image0, image1 = (
        np.clip(np.round(image + rng.normal(0.0, 2.0, image.shape)), 0, 255).astype(np.uint8)
        for image in (texture, warped)
    )
    points0 = cv2.goodFeaturesToTrack(image0, 800, 0.01, 6)[:, 0].astype(np.float64)
    points0 = points0[_inside(points0, 30.0) & _inside(_apply(H, points0), 30.0 * max(1.0, zoom))]
    steps = np.array([[1e-3, 0.0], [0.0, 1e-3]])
    A = np.stack([(_apply(H, points0 + step) - _apply(H, points0 - step)) / 2e-3 for step in steps], axis=2)
    return View(image0, image1, points0, _apply(H, points0), A)


@pytest.fixture(scope="module", params=ZOOMS)
def zoomed(request: pytest.FixtureRequest) -> View:
    return view(request.param)


@pytest.fixture(scope="module")
def turned() -> View:
    return view(1.0)


def _apply(H: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(cv2.perspectiveTransform(points[None], H)[0])


def _inside(points: np.ndarray, margin: float) -> np.ndarray:
    return np.asarray(((points > margin) & (points < (WIDTH - margin, HEIGHT - margin))).all(axis=1))


def disturbed(points: np.ndarray, longest: float = 1.5) -> np.ndarray:
    """Points (N, 2), each moved by up to `longest` pixels in any direction."""
    rng = np.random.default_rng(2)
    angle, length = rng.uniform(0.0, 2.0 * np.pi, len(points)), rng.uniform(0.0, longest, len(points))
    return points + length[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def field(A: np.ndarray, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    points0 = np.random.default_rng(seed).uniform((0, 0), (WIDTH, HEIGHT), (count, 2))
    return points0, points0 @ A.T + OFFSET


# Maps


@pytest.mark.parametrize("A", FIELDS.values(), ids=FIELDS)
@pytest.mark.parametrize("count", [4, 23, 24, 400, 1100])
def test_an_affine_field_is_found_around_every_match(A: np.ndarray, count: int):
    # 1100: more than the distances that are held at once.
    found, distance = local_maps(*field(A, count), np.ones(count))
    assert found.shape == (count, 2, 2)
    np.testing.assert_allclose(found, np.broadcast_to(A, found.shape), atol=1e-3)
    assert distance.shape == (count,)
    assert distance.max() < 0.02


def test_little_trust_in_all_matches_changes_little():
    A = FIELDS["sheared"]
    found, distance = local_maps(*field(A, 400), np.full(400, 0.1))
    np.testing.assert_allclose(found, np.broadcast_to(A, found.shape), atol=1e-2)
    assert distance.max() < 0.1


def test_a_field_that_bends_is_followed_by_its_jacobians():
    points0, _ = field(np.eye(2), 800)
    H = np.array([[0.9, -0.2, 60.0], [0.15, 1.0, -20.0], [3e-4, -2e-4, 1.0]])
    points1 = _apply(H, points0)
    steps = np.array([[1e-3, 0.0], [0.0, 1e-3]])
    jacobian = np.stack([(_apply(H, points0 + s) - _apply(H, points0 - s)) / 2e-3 for s in steps], axis=2)
    found, distance = local_maps(points0, points1, np.ones(800))
    assert np.quantile(np.abs(found - jacobian).max(axis=(1, 2)), 0.9) < 0.05
    assert np.quantile(distance, 0.9) < 0.5


@pytest.mark.parametrize("A", FIELDS.values(), ids=FIELDS)
def test_less_probable_outliers_are_far_from_their_neighbours_map_and_the_others_near(A: np.ndarray):
    right_near, wrong_far = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        points0, exact = field(A, 500, seed)
        wrong = rng.random(500) < 0.3
        points1 = exact + rng.normal(0.0, 0.3, exact.shape)
        points1[wrong] = rng.uniform((0, 0), (WIDTH, HEIGHT), (int(wrong.sum()), 2))
        # As the probabilities of real matches: those of wrong ones are mostly low.
        weight = np.where(wrong, rng.beta(1.0, 3.0, 500), rng.beta(3.0, 1.5, 500))
        _, distance = local_maps(points0, points1, weight)
        right_near.append((distance[~wrong] < 1.0).mean())
        wrong_far.append((distance[wrong] > 4.0).mean())
    assert np.mean(right_near) > 0.97
    assert np.mean(wrong_far) > 0.9


@pytest.mark.parametrize("count", [0, 1, 3])
def test_fewer_than_four_matches_have_no_map(count: int):
    found, distance = local_maps(*field(np.eye(2), count), np.ones(count))
    assert found.shape == (count, 2, 2)
    assert distance.shape == (count,)
    assert np.isinf(found).all()
    assert np.isinf(distance).all()


def test_maps_do_not_depend_on_the_order_and_leave_their_input():
    points0, points1 = field(FIELDS["sheared"], 200)
    points1[::5] += 50.0
    weight = np.random.default_rng(0).uniform(0.1, 1.0, 200)
    before = points0.copy(), points1.copy(), weight.copy()
    found, distance = local_maps(points0, points1, weight)
    order = np.random.default_rng(1).permutation(200)
    found_again, distance_again = local_maps(points0[order], points1[order], weight[order])
    np.testing.assert_allclose(found_again, found[order], atol=1e-6)
    np.testing.assert_allclose(distance_again, distance[order], atol=1e-6)
    for array, copy in zip((points0, points1, weight), before, strict=True):
        np.testing.assert_array_equal(array, copy)


# Alignment


def test_disturbed_places_come_back(zoomed: View):
    start = disturbed(zoomed.points1)
    places, moved, _ = align_patches(zoomed.image0, zoomed.image1, zoomed.points0, start, zoomed.A)
    error = np.linalg.norm(places - zoomed.points1, axis=1)
    assert len(error) > 200
    assert np.median(np.linalg.norm(start - zoomed.points1, axis=1)) > 0.6
    assert moved.mean() > 0.99
    assert np.median(error) < 0.04
    assert np.quantile(error, 0.95) < 0.1
    # The two kinds of sampling of both images favour no side.
    np.testing.assert_allclose(np.median(places - zoomed.points1, axis=0), 0.0, atol=0.015)


def test_gain_and_offset_of_the_grey_values_do_not_matter(zoomed: View):
    start = disturbed(zoomed.points1)
    places, _, _ = align_patches(zoomed.image0, zoomed.image1, zoomed.points0, start, zoomed.A)
    darker = np.round(0.5 * zoomed.image1.astype(float) + 40.0).astype(np.uint8)
    again, moved, _ = align_patches(zoomed.image0, darker, zoomed.points0, start, zoomed.A)
    assert moved.mean() > 0.99
    # Rounding to half as many grey levels is all that differs.
    assert np.linalg.norm(again - places, axis=1).max() < 0.02


def test_a_map_that_is_slightly_wrong_still_aligns(turned: View):
    """By a twentieth of zoom and 3 degrees, as of keypoints that lie half a pixel off."""
    angle = np.radians(3.0)
    wrong = 1.05 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    places, moved, _ = align_patches(
        turned.image0, turned.image1, turned.points0, disturbed(turned.points1), wrong @ turned.A
    )
    assert moved.mean() > 0.95
    assert np.median(np.linalg.norm(places - turned.points1, axis=1)) < 0.2


def test_one_place_is_aligned_as_among_many(zoomed: View):
    start = disturbed(zoomed.points1)
    places, _, _ = align_patches(zoomed.image0, zoomed.image1, zoomed.points0, start, zoomed.A)
    for row in range(0, len(start), 40):
        one = slice(row, row + 1)
        alone, _, _ = align_patches(zoomed.image0, zoomed.image1, zoomed.points0[one], start[one], zoomed.A[one])
        # Sums of single precision depend on how many are taken at once.
        np.testing.assert_allclose(alone, places[one], rtol=0, atol=1e-4)


def test_a_place_too_far_away_stays(turned: View):
    start = turned.points1 + (7.0, 0.0)
    places, moved, _ = align_patches(turned.image0, turned.image1, turned.points0, start, turned.A)
    np.testing.assert_array_equal(places[~moved], start[~moved])
    assert np.linalg.norm(places - start, axis=1).max() <= 3.0
    assert moved.mean() < 0.05


def test_other_texture_stays(turned: View):
    other = dead_leaves((HEIGHT, WIDTH), np.random.default_rng(99))
    places, moved, _ = align_patches(turned.image0, other, turned.points0, turned.points1, turned.A)
    np.testing.assert_array_equal(places[~moved], turned.points1[~moved])
    assert moved.mean() < 0.08


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_flat_patches_stay(turned: View, flat: int):
    """In either image, or in both."""
    grey = np.full((HEIGHT, WIDTH), 128, np.uint8)
    image0, image1 = (grey if flat in (index, 2) else turned.image0 for index in (0, 1))
    places, moved, _ = align_patches(image0, image1, turned.points0, turned.points1, turned.A)
    assert not moved.any()
    np.testing.assert_array_equal(places, turned.points1)


def test_places_far_outside_stay(turned: View):
    outside = np.array([[-200.0, 50.0], [WIDTH + 200.0, 50.0], [300.0, -200.0], [300.0, HEIGHT + 200.0]])
    inside = np.tile([320.0, 240.0], (4, 1))
    A = np.tile(np.eye(2), (4, 1, 1))
    for points0, points1 in ((outside, inside), (inside, outside), (outside, outside)):
        places, moved, _ = align_patches(turned.image0, turned.image1, points0, points1, A)
        assert not moved.any()
        np.testing.assert_array_equal(places, points1)


@pytest.mark.parametrize("bad", [np.full((2, 2), np.inf), np.full((2, 2), np.nan), np.zeros((2, 2)), 10.0 * np.eye(2)])
def test_matches_without_a_usable_map_stay_and_the_others_move(turned: View, bad: np.ndarray):
    start = disturbed(turned.points1)
    A = turned.A.copy()
    A[::3] = bad
    places, moved, _ = align_patches(turned.image0, turned.image1, turned.points0, start, A)
    assert not moved[::3].any()
    np.testing.assert_array_equal(places[::3], start[::3])
    expected, _, _ = align_patches(turned.image0, turned.image1, turned.points0, start, turned.A)
    usable = np.arange(len(A)) % 3 > 0
    np.testing.assert_allclose(places[usable], expected[usable], atol=1e-6)


def test_nothing_to_align_is_no_error(turned: View):
    none = np.zeros((0, 2))
    places, moved, _ = align_patches(turned.image0, turned.image1, none, none, np.zeros((0, 2, 2)))
    assert places.shape == (0, 2)
    assert moved.shape == (0,)


def test_images_of_two_sizes_and_float32_points_are_taken(turned: View):
    start = disturbed(turned.points1).astype(np.float32)
    before = start.copy()
    places, moved, _ = align_patches(
        np.pad(turned.image0, ((0, 40), (0, 20))), turned.image1, turned.points0.astype(np.float32), start, turned.A
    )
    assert places.dtype == np.float64
    assert moved.dtype == bool
    assert np.median(np.linalg.norm(places - turned.points1, axis=1)) < 0.04
    np.testing.assert_array_equal(start, before)
