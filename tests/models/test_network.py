import cv2
import numpy as np
import pytest
import torch
from kornia.feature import gftt_response
from torch import Tensor

from sigmaslam.models.corners import BORDER, corner_response, corner_scores, select_peaks
from sigmaslam.models.extractor import FeatureExtractor
from sigmaslam.models.network import DESCRIPTOR_SIZE, STRIDE, FeatureNetwork, normalize_image, sample_map
from sigmaslam.synthetic.textures import dead_leaves


@pytest.fixture(scope="module")
def network() -> FeatureNetwork:
    torch.manual_seed(0)
    return FeatureNetwork().eval()


@pytest.fixture(scope="module")
def image() -> Tensor:
    """A texture with noise, (1, 1, 128, 160)."""
    rng = np.random.default_rng(1)
    grey = dead_leaves((128, 160), rng) / 255.0 + 0.02 * rng.standard_normal((128, 160))
    return torch.from_numpy(grey.clip(0, 1).astype(np.float32))[None, None]


def chequer(u: float, v: float, angle: float = 0.0, quadrants: int = 2, size: int = 64) -> Tensor:
    """Area-sampled crossing of two edges at (u, v): two opposite quadrants are bright, or only one."""
    fine = 16
    places = (np.arange(size * fine) + 0.5) / fine - 0.5
    x, y = np.meshgrid(places - u, places - v)
    along, across = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
    bright = (along * across > 0) if quadrants == 2 else (along > 0) & (across > 0)
    grey = 0.2 + 0.6 * bright.reshape(size, fine, size, fine).mean(axis=(1, 3))
    return torch.from_numpy(cv2.GaussianBlur(grey, (0, 0), 0.6).astype(np.float32))[None, None]


def best_peak(image: Tensor) -> np.ndarray:
    response = corner_response(image)
    keypoints, _ = select_peaks(corner_scores(response), response, 1)
    return keypoints[0, 0].numpy()


# The network


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 96, 96), (2, 112, 176)])
def test_maps_have_an_eighth_of_the_size(network, batch, height, width):
    descriptors, quality = network(torch.rand(batch, 1, height, width))
    assert descriptors.shape == (batch, DESCRIPTOR_SIZE, height // STRIDE, width // STRIDE)
    assert quality.shape == (batch, 1, height // STRIDE, width // STRIDE)


@pytest.mark.parametrize(("gain", "offset"), [(0.3, 0.4), (1.0, -0.1), (0.05, 0.0)])
def test_gain_and_offset_of_the_grey_values_do_not_matter(network, image, gain, offset):
    with torch.no_grad():
        first, second = network(image), network(gain * image + offset)
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def test_images_of_a_batch_do_not_mix(network, image):
    other = torch.rand_like(image)
    with torch.no_grad():
        alone, together = network(image)[0], network(torch.cat([other, image]))[0]
    torch.testing.assert_close(together[1:], alone, rtol=0, atol=1e-5)


def test_normalized_image_has_zero_mean_and_unit_variance(image):
    normalized = normalize_image(image)
    assert float(normalized.mean()) == pytest.approx(0, abs=1e-5)
    assert float(normalized.var(correction=0)) == pytest.approx(1, abs=1e-4)


def test_normalized_image_of_one_grey_value_is_finite():
    assert (normalize_image(torch.full((1, 1, 16, 16), 0.5)).abs() < 1e-3).all()


def test_sample_at_cell_centres_is_the_cell():
    features = torch.rand(2, 5, 6, 9)
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    centres = torch.stack([STRIDE * u + 3.5, STRIDE * v + 3.5], dim=-1).reshape(1, -1, 2).expand(2, -1, -1)
    torch.testing.assert_close(sample_map(features, centres), features.flatten(2).mT, rtol=0, atol=1e-5)


def test_samples_of_a_ramp_are_the_ramp_between_cell_centres():
    u = STRIDE * torch.arange(9.0) + 3.5
    ramp = u.expand(1, 1, 6, 9)
    places = torch.tensor([[[10.0, 20.0], [33.3, 7.0], [66.9, 40.0]]])
    torch.testing.assert_close(sample_map(ramp, places)[..., 0], places[..., 0], rtol=0, atol=1e-4)


def test_extractor_gives_unit_descriptors_best_first(network, image):
    with torch.no_grad():
        keypoints, scores, descriptors = FeatureExtractor(network, 200)(image)
    assert keypoints.shape == (200, 2)
    assert descriptors.shape == (200, DESCRIPTOR_SIZE)
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(200))
    assert (scores.diff() <= 0).all()


# Corners


def test_response_is_kornias_up_to_the_window(image):
    ours, theirs = corner_response(image)[0, 0], gftt_response(image)[0, 0]
    inner = (slice(8, -8), slice(8, -8))
    correlation = np.corrcoef(ours[inner].flatten(), theirs[inner].flatten())[0, 1]
    assert correlation > 0.98


def test_response_is_opencvs_up_to_the_window(image):
    ours = corner_response(image)[0, 0].numpy()
    theirs = cv2.cornerMinEigenVal(image[0, 0].numpy(), 3, ksize=3)
    assert np.corrcoef(ours[8:-8, 8:-8].ravel(), theirs[8:-8, 8:-8].ravel())[0, 1] > 0.95


def test_an_edge_has_no_response_and_a_corner_has():
    edge = torch.zeros(1, 1, 64, 64)
    edge[..., 30:] = 1.0
    corner = edge.clone()
    corner[..., :30, :] = 0.0
    assert corner_response(edge)[0, 0, 8:-8].max() < 1e-6
    assert corner_response(corner)[0, 0, 8:-8].max() > 1e-3


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.9])
def test_crossing_is_found_at_its_subpixel_place(angle):
    """The smaller eigenvalue peaks in a tip there, to which a quadratic fits only so well: 0.25 px rms, no bias."""
    places = np.random.default_rng(0).uniform(28, 36, (20, 2))
    errors = np.array([best_peak(chequer(u, v, angle)) - (u, v) for u, v in places])
    distance = np.linalg.norm(errors, axis=1)
    assert np.sqrt((distance**2).mean()) < 0.3
    assert distance.max() < 0.5
    assert np.abs(errors.mean(axis=0)).max() < 0.12


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.9])
def test_corner_of_one_quadrant_is_found_at_a_constant_distance_inside(angle):
    """A lone corner pulls the response into itself; what counts for matching is that it is always as much."""
    places = np.random.default_rng(0).uniform(28, 36, (20, 2))
    errors = np.array([best_peak(chequer(u, v, angle, quadrants=1)) - (u, v) for u, v in places])
    inward = np.array([np.cos(angle + np.pi / 4), np.sin(angle + np.pi / 4)])
    mean = errors.mean(axis=0)
    assert 1.2 < mean @ inward < 1.7
    scatter = np.linalg.norm(errors - mean, axis=1)
    assert np.sqrt((scatter**2).mean()) < 0.2
    assert scatter.max() < 0.4


def test_scores_are_zero_near_the_border_and_off_the_maxima(image):
    response = corner_response(image)
    scores = corner_scores(response)
    assert scores.shape == response.shape
    assert (scores >= 0).all()
    inside = torch.zeros_like(scores, dtype=torch.bool)
    inside[..., BORDER:-BORDER, BORDER:-BORDER] = True
    assert (scores[~inside] == 0).all()
    for v, u in torch.nonzero(scores[0, 0])[::5].tolist():
        assert response[0, 0, v, u] == response[0, 0, v - 2 : v + 3, u - 2 : u + 3].max()


def test_peaks_are_ordered_and_within_a_pixel_of_their_maximum(image):
    response = corner_response(image)
    scores = corner_scores(response)
    keypoints, best = select_peaks(scores, response, 150)
    assert (best.diff(dim=1) <= 0).all()
    torch.testing.assert_close(best[0], scores.flatten().topk(150).values, rtol=0, atol=0)
    order = scores.flatten().topk(150).indices
    places = torch.stack([order % 160, order // 160], dim=1)
    assert (keypoints[0] - places).abs()[best[0] > 0].max() <= 0.75


def test_an_image_without_texture_has_no_corners(network):
    with torch.no_grad():
        keypoints, scores, descriptors = FeatureExtractor(network, 64)(torch.full((1, 1, 96, 96), 0.5))
    assert (scores == 0).all()
    assert torch.isfinite(keypoints).all()
    assert torch.isfinite(descriptors).all()
