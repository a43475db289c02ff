"""The network: shapes, what it must not depend on, and sampling between the cells of its maps."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.detector import to_cells
from sigmaslam_models.feature_network import (
    DESCRIPTOR_SIZE,
    SIZE_MULTIPLE,
    FeatureMaps,
    FeatureNetwork,
    normalize_image,
    sample_map,
    sample_window,
)
from sigmaslam_synthetic.rendering.textures import dead_leaves


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


def maps_of(network: FeatureNetwork, image: Tensor) -> FeatureMaps:
    with torch.no_grad():
        return network(to_cells(image))


@pytest.mark.parametrize(("batch", "height", "width"), [(1, 96, 96), (2, 112, 176)])
def test_maps_have_the_size_over_their_stride(network, batch, height, width):
    assert height % SIZE_MULTIPLE == width % SIZE_MULTIPLE == 0
    maps = maps_of(network, torch.rand(batch, 1, height, width))
    assert maps.fine.shape == (batch, 32, height // 4, width // 4)
    assert maps.coarse.shape == (batch, 64, height // 8, width // 8)
    assert maps.quality.shape == maps.log_sigma.shape == (batch, 1, height // 8, width // 8)


@pytest.mark.parametrize("stride", [4, 8, 16])
@pytest.mark.parametrize("size", [30, DESCRIPTOR_SIZE])
def test_descriptors_have_the_length_that_was_chosen_and_unit_norm(stride, size, image):
    network = FeatureNetwork(size, stride).eval()
    with torch.no_grad():
        descriptors = network.describe(network(to_cells(image)), 90 * torch.rand(1, 7, 2))
    assert descriptors.shape == (1, 7, size)
    torch.testing.assert_close(descriptors.norm(dim=-1), torch.ones(1, 7))


def test_a_descriptor_sees_both_maps(network, image):
    maps, keypoint = maps_of(network, image), torch.tensor([[[70.3, 60.8]]])
    with torch.no_grad():
        descriptor = network.describe(maps, keypoint)
        for other in (maps._replace(fine=maps.fine.roll(1, 2)), maps._replace(coarse=maps.coarse.roll(1, 2))):
            assert (network.describe(other, keypoint) - descriptor).abs().max() > 1e-3


@pytest.mark.parametrize(("gain", "offset"), [(0.3, 0.4), (1.0, -0.1), (0.05, 0.0)])
def test_gain_and_offset_of_the_grey_values_do_not_matter(network, image, gain, offset):
    for a, b in zip(maps_of(network, image), maps_of(network, gain * image + offset), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-4)


def test_images_of_a_batch_do_not_mix(network, image):
    together = maps_of(network, torch.cat([torch.rand_like(image), image]))
    for a, b in zip(maps_of(network, image), together, strict=True):
        torch.testing.assert_close(b[1:], a, rtol=0, atol=1e-5)


@pytest.mark.parametrize("stride", [4, 8, 16])
def test_every_parameter_learns(stride):
    """No layer is left out of the graph: each gets a gradient from descriptors, quality or log-sigma."""
    network = FeatureNetwork(stride=stride)
    maps = network(to_cells(torch.rand(2, 1, 96, 96)))
    descriptors = network.describe(maps, 90 * torch.rand(2, 40, 2))
    # The length of a descriptor is one: its square would teach nothing.
    (descriptors.sum() + maps.quality.square().sum() + maps.log_sigma.square().sum()).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


def test_maps_move_with_the_image(network, image):
    """A shift by the network's coarsest cell, 16 pixels, or two shifts the maps by as much, away from borders."""
    tiled = image.repeat(1, 1, 3, 3)
    shifted = torch.roll(tiled, (16, 32), dims=(2, 3))
    for a, b in zip(maps_of(network, tiled), maps_of(network, shifted), strict=True):
        cells = a.shape[2] * 16 // tiled.shape[2]
        moved = torch.roll(a, (cells, 2 * cells), dims=(2, 3))
        inner = (..., slice(9 * cells, -9 * cells), slice(9 * cells, -9 * cells))
        torch.testing.assert_close(b[inner], moved[inner], rtol=0, atol=1e-4)


def test_normalized_image_has_zero_mean_and_unit_variance(image):
    normalized = normalize_image(to_cells(image))
    assert float(normalized.mean()) == pytest.approx(0, abs=1e-5)
    assert float(normalized.var(correction=0)) == pytest.approx(1, abs=1e-4)


def test_normalized_image_of_one_grey_value_is_finite():
    assert (normalize_image(torch.full((1, 16, 4, 4), 0.5)).abs() < 1e-3).all()


# Sampling


@pytest.mark.parametrize("stride", [4, 8, 16])
def test_samples_are_torchs_grid_samples(stride):
    """`grid_sample` with pixel areas (align_corners=False) and a repeated border, also outside of the map."""
    torch.manual_seed(1)
    features = torch.rand(2, 5, 6, 9)
    size = torch.tensor([9.0 * stride, 6.0 * stride])
    places = torch.rand(2, 200, 2) * (size + 40) - 20
    grid = (2 * (places + 0.5) / size - 1)[:, :, None]
    expected = functional.grid_sample(features, grid, padding_mode="border", align_corners=False)
    torch.testing.assert_close(sample_map(features, places, stride), expected[..., 0].mT, rtol=0, atol=1e-4)


@pytest.mark.parametrize("stride", [4, 8])
def test_a_window_is_nine_samples_a_cell_apart(stride):
    """Row by row, also where it reaches out of the map."""
    torch.manual_seed(2)
    features = torch.rand(2, 5, 6, 9)
    places = torch.rand(2, 200, 2) * torch.tensor([9.0 * stride + 40, 6.0 * stride + 40]) - 20
    steps = [(stride * u, stride * v) for v in (-1, 0, 1) for u in (-1, 0, 1)]
    expected = [sample_map(features, places + torch.tensor(step), stride) for step in steps]
    window = sample_window(features, places, stride)
    torch.testing.assert_close(window, torch.cat(expected, dim=-1), rtol=0, atol=1e-4)


@pytest.mark.parametrize("stride", [4, 8])
def test_sample_at_cell_centres_is_the_cell(stride):
    features = torch.rand(2, 5, 6, 9)
    u, v = cell_centres(stride)
    centres = torch.stack([u, v], dim=-1).reshape(1, -1, 2).expand(2, -1, -1)
    torch.testing.assert_close(sample_map(features, centres, stride), features.flatten(2).mT, rtol=0, atol=1e-5)


@pytest.mark.parametrize("stride", [4, 8])
@pytest.mark.parametrize("axis", [0, 1])
def test_samples_of_a_ramp_are_the_ramp_between_cell_centres(stride, axis):
    ramp = cell_centres(stride)[axis][None, None]
    places = torch.tensor([[[10.0, 10.0], [18.3, 7.0], [32.9, 19.0]]])
    torch.testing.assert_close(sample_map(ramp, places, stride)[..., 0], places[..., axis], rtol=0, atol=1e-4)


def cell_centres(stride: int) -> tuple[Tensor, Tensor]:
    """Columns and rows (6, 9) of the pixels on which the cells of a map are centred."""
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    return stride * u + 0.5 * (stride - 1), stride * v + 0.5 * (stride - 1)
