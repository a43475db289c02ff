"""The extractor: counts, order, two scales that agree, and images at the limits."""

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam_models.detector import BORDER, detect, to_cells
from sigmaslam_models.extractor import FeatureExtractor, find_blobs
from sigmaslam_models.feature_network import DESCRIPTOR_SIZE, FeatureNetwork
from sigmaslam_synthetic.rendering.textures import dead_leaves


@pytest.fixture(scope="module")
def extractor() -> FeatureExtractor:
    torch.manual_seed(0)
    return FeatureExtractor(FeatureNetwork().eval())


@pytest.fixture(scope="module")
def image() -> Tensor:
    """A texture with noise, (1, 1, 192, 256)."""
    rng = np.random.default_rng(1)
    grey = dead_leaves((192, 256), rng) / 255.0 + 0.02 * rng.standard_normal((192, 256))
    return torch.from_numpy(grey.clip(0, 1).astype(np.float32))[None, None]


def run(extractor: FeatureExtractor, image: Tensor, count: int) -> tuple[Tensor, ...]:
    with torch.no_grad():
        return extractor(image, torch.tensor(count))[:4]


def distances(points0: Tensor, points1: Tensor) -> Tensor:
    """(N, M); `torch.cdist` is an eighth of a pixel off where there are many."""
    return (points0[:, None] - points1[None]).norm(dim=2)


def level_of(extractor: FeatureExtractor, image: Tensor, count: int) -> tuple[Tensor, ...]:
    """Keypoints of one scale alone."""
    with torch.no_grad():
        places, strengths = detect(to_cells(image), 2 * count)
        return extractor._level(to_cells(image), places[0], strengths[0])


def as_image(grey: np.ndarray) -> Tensor:
    return torch.from_numpy(grey.astype(np.float32))[None, None]


@pytest.mark.parametrize("count", [4, 5, 200, 1024])
def test_as_many_unit_descriptors_as_were_wanted_come_best_first(extractor, image, count):
    keypoints, scores, descriptors, sigma = run(extractor, image, count)
    assert keypoints.shape == (count, 2)
    assert scores.shape == sigma.shape == (count,)
    assert descriptors.shape == (count, DESCRIPTOR_SIZE)
    torch.testing.assert_close(descriptors.norm(dim=1), torch.ones(count))
    assert (scores.diff() <= 0).all()
    assert ((scores >= 0) & (scores <= 1)).all()
    assert (sigma > 0).all()
    real = keypoints[scores > 0]
    assert len(real) >= min(count, 200)
    assert ((real > BORDER - 1) & (real < torch.tensor([256, 192]) - BORDER)).all()


def test_a_row_of_every_output_belongs_to_the_same_keypoint(extractor, image):
    """Few keypoints of many are the same rows: sorting moved all outputs alike."""
    keypoints, scores, descriptors, sigma = run(extractor, image, 400)
    level = level_of(extractor, image, 300)
    distance = distances(level[0], keypoints)
    nearest = distance.argmin(dim=1)
    assert distance.amin(dim=1).max() < 1e-4
    torch.testing.assert_close(scores[nearest], level[1])
    torch.testing.assert_close(descriptors[nearest], level[2])
    torch.testing.assert_close(sigma[nearest], level[3])


def test_three_in_four_come_from_the_image_and_one_from_half_of_it():
    """With a sigma of one pixel everywhere the level shows: two pixels mean half scale."""
    network = FeatureNetwork().eval()
    with torch.no_grad():
        network.judge.weight.zero_()
        network.judge.bias.zero_()
    rng = np.random.default_rng(4)
    image = as_image(cv2.GaussianBlur(dead_leaves((192, 256), rng) / 255.0, (0, 0), 0.8))
    _, _, _, sigma = run(FeatureExtractor(network), image, 101)
    assert sorted(sigma.tolist()) == [1.0] * 76 + [2.0] * 25


@pytest.mark.long
def test_keypoints_at_half_scale_lie_on_blobs_of_double_size(extractor):
    """Pixel k of the half-size image is the mean of pixels 2 k and 2 k + 1: its centre is 2 k + 0.5."""
    rng = np.random.default_rng(0)
    errors = []
    for place in rng.uniform(120, 136, (20, 2)):
        x, y = np.meshgrid(np.arange(256) - place[0], np.arange(256) - place[1])
        grey = 0.5 + 0.3 * np.exp(-(x**2 + y**2) / (2 * 4.0**2))
        half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        expected = 2.0 * detect(to_cells(as_image(half)), 1)[0][0, 0].numpy() + 0.5
        keypoints = run(extractor, as_image(grey), 4)[0].numpy()
        found = keypoints[np.linalg.norm(keypoints - expected, axis=1).argmin()]
        np.testing.assert_allclose(found, expected, atol=0.05)
        errors.append(found - place)
    assert np.linalg.norm(errors, axis=1).max() < 0.2
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05


def test_the_half_scale_level_is_the_half_image(extractor, image):
    """Its keypoints are those of the image shrunk by OpenCV, moved to the full image, with sigma doubled."""
    half = as_image(cv2.resize(image[0, 0].numpy(), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    keypoints, scores, descriptors, sigma = run(extractor, image, 160)
    level = level_of(extractor, half, 40)
    distance = distances(2.0 * level[0] + 0.5, keypoints)
    nearest, found = distance.argmin(dim=1), distance.amin(dim=1) < 1e-2
    assert found.float().mean() > 0.9
    index = nearest[found]
    torch.testing.assert_close(scores[index], level[1][found], rtol=0, atol=1e-3)
    torch.testing.assert_close(descriptors[index], level[2][found], rtol=0, atol=1e-3)
    torch.testing.assert_close(sigma[index], 2.0 * level[3][found], rtol=1e-3, atol=0)


def test_keypoints_of_an_image_are_found_again_when_it_is_zoomed_to_double_size(extractor):
    """Half-scale keypoints of the zoomed image are full-scale ones of the first, and have their descriptors."""
    rng = np.random.default_rng(6)
    large = cv2.GaussianBlur(dead_leaves((384, 512), rng).astype(np.float32) / 255.0, (0, 0), 1.0)
    small = cv2.resize(large, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    keypoints0, scores0, descriptors0, _ = run(extractor, as_image(small), 200)
    keypoints1, scores1, descriptors1, _ = run(extractor, as_image(large), 800)
    assert (scores0 > 0).all()
    assert (scores1 > 0).all()
    distance = distances(2.0 * keypoints0 + 0.5, keypoints1)
    coincident = distance.amin(dim=1) < 0.5
    # The level from the image itself, three quarters of 200, should be there again; half-scale ones need not.
    assert coincident.float().mean() > 0.6
    cosine = (descriptors0 * descriptors1[distance.argmin(dim=1)]).sum(dim=1)
    assert (cosine[coincident] > 0.99).float().mean() > 0.6


@pytest.mark.parametrize("count", [4, 96 * 96 // 8])
def test_the_smallest_image_takes_the_most_keypoints_allowed(extractor, count):
    torch.manual_seed(2)
    keypoints, scores, descriptors, sigma = run(extractor, torch.rand(1, 1, 96, 96), count)
    assert keypoints.shape == (count, 2)
    assert (scores[:4] > 0).all()
    for values in (keypoints, scores, descriptors, sigma):
        assert torch.isfinite(values).all()


@pytest.mark.parametrize("count", [3, 96 * 96 // 8 + 1])
def test_counts_beyond_the_limits_are_refused(extractor, count):
    with pytest.raises(RuntimeError):
        run(extractor, torch.rand(1, 1, 96, 96), count)


@pytest.mark.parametrize("grey", [0.3, 0.5, 1.0])
def test_an_image_without_texture_scores_zero(extractor, grey):
    keypoints, scores, descriptors, _ = run(extractor, torch.full((1, 1, 96, 96), grey), 64)
    assert (scores == 0).all()
    assert torch.isfinite(keypoints).all()
    assert torch.isfinite(descriptors).all()


def test_a_keypoint_of_low_quality_scores_less(image):
    """Scores are the product of the blob's strength and the learned quality."""
    torch.manual_seed(0)
    network = FeatureNetwork().eval()
    scores = []
    for logit in (0.0, -3.0):
        with torch.no_grad():
            network.judge.weight[0].zero_()
            network.judge.bias[0] = logit
        scores.append(run(FeatureExtractor(network), image, 100)[1])
    ratio = 1 / (1 + np.exp(3.0)) / 0.5
    torch.testing.assert_close(scores[1], ratio * scores[0], rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("height", "width", "count"), [(96, 96, 1152), (96, 96, 4), (192, 352, 700), (480, 640, 1500)])
def test_compiled_blobs_are_those_of_torch(height, width, count):
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    rng = np.random.default_rng(height + count)
    grey = dead_leaves((height, width), rng) / 255.0 + 0.02 * rng.standard_normal((height, width))
    grey = grey.clip(0, 1).astype(np.float32)
    expected = [each.numpy() for each in find_blobs(as_image(grey), torch.tensor(count))]
    found = kernels.find_blobs(grey, count)
    assert [each.shape for each in found] == [each.shape for each in expected]
    for places, strengths, their_places, their_strengths in (
        found[:2] + tuple(expected[:2]),
        found[2:] + tuple(expected[2:]),
    ):
        np.testing.assert_allclose(strengths, their_strengths, rtol=0, atol=1e-5 * their_strengths.max())
        nearest = np.linalg.norm(places[:, None] - their_places[None], axis=2).min(axis=1)
        # Round-off decides which of two blobs of nearly equal strength is the last.
        assert (nearest[strengths > 0] < 1e-3).mean() > 0.995


@pytest.mark.parametrize("grey", [0.0, 0.3, 1.0])
def test_compiled_blobs_of_no_texture_have_no_strength(grey):
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    places, strengths, half_places, half_strengths = kernels.find_blobs(np.full((96, 128), grey, np.float32), 64)
    assert np.isfinite([*places.ravel(), *half_places.ravel()]).all()
    assert not strengths.any()
    assert not half_strengths.any()


@pytest.mark.parametrize("shape", [(96, 100), (64, 96), (96,)])
def test_compiled_blobs_need_sides_as_the_network_does(shape):
    kernels = pytest.importorskip("sigmaslam.frontend._kernels", reason="installed without a compiler")
    with pytest.raises(ValueError, match="multiples of 32"):
        kernels.find_blobs(np.zeros(shape, np.float32), 10)


@pytest.mark.parametrize("shape", [(64, 64), (240, 33), (96, 96)])
def test_small_images_have_features_too(shape):
    image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    features = LearnedDetector(1500, threads=1)(image)
    assert len(features.keypoints) > 100
    assert (features.keypoints < shape[::-1]).all()
