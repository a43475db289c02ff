"""The blob detector against independent implementations, known places, and what must always hold."""

import cv2
import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.detector import BORDER, CELL, detect, hessian_response, to_cells, to_half_cells
from sigmaslam_synthetic.rendering.textures import dead_leaves

SIGMA = 1.4
INNER = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))


@pytest.fixture(scope="module")
def image() -> Tensor:
    """A texture with noise, (1, 1, 128, 160)."""
    rng = np.random.default_rng(1)
    grey = dead_leaves((128, 160), rng) / 255.0 + 0.02 * rng.standard_normal((128, 160))
    return as_image(grey.clip(0, 1))


def as_image(grey: np.ndarray) -> Tensor:
    return torch.from_numpy(grey.astype(np.float32))[None, None]


def response_of(image: Tensor) -> Tensor:
    """(H, W) response of a (1, 1, H, W) image."""
    return functional.pixel_shuffle(hessian_response(to_cells(image)), CELL)[0, 0]


def peaks_of(image: Tensor, count: int) -> tuple[np.ndarray, np.ndarray]:
    keypoints, strength = detect(to_cells(image), count)
    return keypoints[0].numpy(), strength[0].numpy()


def blob(
    u: float, v: float, sigmas: tuple[float, float] = (2.0, 2.0), angle: float = 0.0, contrast: float = 0.6
) -> Tensor:
    """(1, 1, 64, 64) image of a Gaussian blob whose centre is (u, v), elongated along `angle`."""
    x, y = np.meshgrid(np.arange(64) - u, np.arange(64) - v)
    along, across = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
    grey = 0.5 + 0.5 * contrast * np.exp(-0.5 * ((along / sigmas[0]) ** 2 + (across / sigmas[1]) ** 2))
    return as_image(grey)


# Cells


def test_cells_are_the_unshuffled_pixels(image):
    assert torch.equal(to_cells(image), functional.pixel_unshuffle(image, CELL))


def test_half_cells_are_the_unshuffled_means_of_2x2_pixels(image):
    expected = functional.pixel_unshuffle(functional.avg_pool2d(image, 2), CELL)
    torch.testing.assert_close(to_half_cells(image), expected, rtol=0, atol=1e-6)


# Response


def test_response_is_the_determinant_of_scipys_gaussian_derivatives(image):
    """Theirs are derivatives of the Gaussian, ours differences of a truncated one: equal up to a few per cent."""
    grey = image[0, 0].double().numpy()
    uu, vv, uv = (ndimage.gaussian_filter(grey, SIGMA, order=order) for order in ((0, 2), (2, 0), (1, 1)))
    theirs = (SIGMA**4 * (uu * vv - uv * uv))[INNER]
    ours = response_of(image).numpy()[INNER]
    assert np.corrcoef(ours.ravel(), theirs.ravel())[0, 1] > 0.99
    assert ours.std() == pytest.approx(theirs.std(), rel=0.15)


def test_response_is_opencvs_blur_and_differences(image):
    """The same taps written with OpenCV's filters: equal up to round-off."""
    places = np.arange(-3, 4)
    taps = np.exp(-0.5 * (places / SIGMA) ** 2)
    smooth = cv2.sepFilter2D(image[0, 0].double().numpy(), cv2.CV_64F, taps / taps.sum(), taps / taps.sum())
    second, first, one = np.array([1.0, -2.0, 1.0]), np.array([-0.5, 0.0, 0.5]), np.array([0.0, 1.0, 0.0])
    uu, vv, uv = (
        cv2.sepFilter2D(smooth, cv2.CV_64F, kernel_u, kernel_v)
        for kernel_u, kernel_v in ((second, one), (one, second), (first, first))
    )
    expected = SIGMA**4 * (uu * vv - uv * uv)
    np.testing.assert_allclose(response_of(image).numpy()[INNER], expected[INNER], rtol=1e-3, atol=1e-6)


def test_response_does_not_depend_on_where_a_cell_begins(image):
    """A shift of the image by pixels shifts the response."""
    shifted = torch.roll(image, (1, 3), dims=(2, 3))
    expected = torch.roll(response_of(image), (1, 3), dims=(0, 1))
    torch.testing.assert_close(response_of(shifted)[16:-16, 16:-16], expected[16:-16, 16:-16], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 4, np.pi / 2])
def test_an_edge_and_a_ramp_have_no_response_and_a_blob_has(angle):
    u, v = np.meshgrid(np.arange(64) - 31.3, np.arange(64) - 31.3)
    across = np.cos(angle) * u + np.sin(angle) * v
    edge = as_image(0.2 + 0.6 / (1 + np.exp(-across / 0.7)))
    ramp = as_image(0.5 + 0.005 * across)
    strength = response_of(blob(31.3, 31.3)).max()
    # Sampling a slanted edge this sharp leaves a few per cent of a blob's response.
    assert response_of(edge)[INNER].max() < (0.04 if 0 < angle < np.pi / 2 else 1e-5) * strength
    assert response_of(ramp)[INNER].abs().max() < 1e-6 * strength


def test_bright_and_dark_blobs_respond_alike_and_saddles_negatively():
    bright, dark = response_of(blob(32, 32, contrast=0.6)), response_of(blob(32, 32, contrast=-0.6))
    torch.testing.assert_close(bright, dark, rtol=1e-3, atol=1e-6)
    u, v = np.meshgrid(np.arange(64) - 32.0, np.arange(64) - 32.0)
    saddle = 0.5 + 0.4 * u * v / 100 * np.exp(-(u * u + v * v) / 200)
    assert response_of(as_image(saddle))[32, 32] < -1e-5


# Places


@pytest.mark.parametrize("contrast", [0.6, -0.6])
@pytest.mark.parametrize(
    ("sigmas", "angle"),
    [((1.0, 1.0), 0.0), ((1.5, 1.5), 0.0), ((2.5, 2.5), 0.0), ((4.0, 4.0), 0.0), ((3.0, 1.5), 0.4), ((3.0, 1.5), 1.2)],
)
def test_a_blob_is_found_at_its_subpixel_place_without_bias(sigmas, angle, contrast):
    places = np.random.default_rng(0).uniform(28, 36, (30, 2))
    errors = np.array([peaks_of(blob(u, v, sigmas, angle, contrast), 1)[0][0] - (u, v) for u, v in places])
    assert np.linalg.norm(errors, axis=1).max() < 0.15
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.08
    assert np.abs(errors.mean(axis=0)).max() < 0.03


@pytest.mark.parametrize("shift", [(0.25, 0.0), (0.5, 0.5), (0.3, -0.4)])
def test_keypoints_of_a_texture_follow_a_subpixel_shift(shift):
    """A textured image and the same moved by part of a pixel: peaks move with it, without bias."""
    rng = np.random.default_rng(3)
    large = cv2.GaussianBlur(dead_leaves((1024, 1280), rng).astype(np.float32) / 255.0, (0, 0), 4.0)
    views = []
    for du, dv in ((0.0, 0.0), shift):
        moved = cv2.warpAffine(large, np.array([[1, 0, 8 * du], [0, 1, 8 * dv]]), (1280, 1024))
        small = cv2.resize(moved, (160, 128), interpolation=cv2.INTER_AREA)
        views.append(peaks_of(as_image(small), 120)[0])
    difference = views[1][None] - views[0][:, None] - np.array(shift)
    nearest = np.linalg.norm(difference, axis=2).argmin(axis=1)
    errors = difference[np.arange(len(nearest)), nearest]
    close = np.linalg.norm(errors, axis=1) < 1.0
    assert close.mean() > 0.9
    assert np.median(np.linalg.norm(errors[close], axis=1)) < 0.13
    assert np.abs(errors[close].mean(axis=0)).max() < 0.04


# Peaks


def test_peaks_are_maxima_away_from_the_border_and_best_first(image):
    keypoints, strength = peaks_of(image, 2000)
    real = strength > 0
    assert 100 < real.sum() < 2000
    assert (np.diff(strength) <= 0).all()
    # The fit moves a peak by at most 0.75 px an axis.
    low, high = BORDER - 0.75, np.array([159, 127]) - BORDER + 0.75
    assert ((keypoints[real] >= low) & (keypoints[real] <= high)).all()
    response = response_of(image)
    highest = functional.max_pool2d(response[None], 3, stride=1, padding=1)[0]
    # What the response is divided by varies slowly: a maximum of one is nearly a maximum of the other.
    maxima = torch.nonzero((response > 0.9 * highest) & (response > 0)).flip(1).numpy()
    offset = np.abs(keypoints[real][:, None] - maxima[None]).max(axis=2).min(axis=1)
    assert (offset <= 0.75 + 1e-4).all()


def test_no_two_peaks_are_neighbours(image):
    keypoints, strength = peaks_of(image, 400)
    keypoints = keypoints[strength > 0]
    distance = np.linalg.norm(keypoints[:, None] - keypoints[None], axis=2) + 10.0 * np.eye(len(keypoints))
    # Maxima of a 3x3 window are two pixels apart along an axis, and fits move each by at most 0.75.
    assert distance.min() >= 0.5 - 1e-4


def test_fewer_peaks_are_the_first_of_more(image):
    few, many = peaks_of(image, 40), peaks_of(image, 200)
    np.testing.assert_array_equal(few[0], many[0][:40])
    np.testing.assert_array_equal(few[1], many[1][:40])


def test_places_do_not_depend_on_contrast_and_gain(image):
    keypoints, strength = peaks_of(image, 100)
    other, _ = peaks_of(0.25 * image + 0.1, 100)
    assert (strength > 0).all()
    distance = np.linalg.norm(keypoints[:, None] - other[None], axis=2).min(axis=1)
    # A few of equal strength change places with what comes after the hundredth.
    assert (distance < 0.02).mean() > 0.9


def test_weak_texture_beside_a_strong_one_keeps_keypoints():
    """Half of the image has a third of the contrast, a ninth of the response: evened scores leave it its share."""
    rng = np.random.default_rng(5)
    grey = cv2.GaussianBlur(rng.standard_normal((128, 256)), (0, 0), 1.5)
    grey *= 0.15 / grey.std()
    grey[:, 128:] /= 3.0
    image = as_image(0.5 + grey)
    response = response_of(image)
    highest = functional.max_pool2d(response[None], 3, stride=1, padding=1)[0]
    maxima = torch.where(response >= highest, response, 0.0)[INNER]
    strongest = maxima.flatten().topk(300).indices % maxima.shape[1] + BORDER
    assert (strongest > 128).sum() < 5
    assert (peaks_of(image, 300)[0][:, 0] > 128).sum() > 40


@pytest.mark.parametrize("grey", [0.0, 0.3, 0.5, 1.0])
def test_an_image_without_texture_has_no_peaks(grey):
    keypoints, strength = peaks_of(torch.full((1, 1, 96, 96), grey), 64)
    # Round-off, which `FeatureExtractor` must not take for texture either.
    assert (strength < 1e-9).all()
    assert np.isfinite(keypoints).all()


def test_images_of_a_batch_do_not_mix(image):
    other = torch.flip(image, dims=(3,))
    together, strengths = detect(torch.cat([to_cells(other), to_cells(image)]), 100)
    alone, strength = detect(to_cells(image), 100)
    torch.testing.assert_close(together[1:], alone, rtol=0, atol=1e-3)
    torch.testing.assert_close(strengths[1:], strength, rtol=1e-4, atol=0)
