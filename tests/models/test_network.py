"""The network: shapes, what it must not depend on, and sampling between the cells of its maps."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam.models.detector import to_cells
from sigmaslam.models.network import (
    DESCRIPTOR_SIZE,
    SIZE_MULTIPLE,
    STRIDE,
    FeatureMaps,
    FeatureNetwork,
    normalize_image,
    sample_map,
)
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


def maps_of(network: FeatureNetwork, image: Tensor) -> FeatureMaps:
    with torch.no_grad():
        return network(to_cells(image))


@pytest.mark.parametrize("stride", [4, 8, 16])
@pytest.mark.parametrize(("batch", "height", "width"), [(1, 96, 96), (2, 112, 176)])
def test_maps_have_the_size_over_the_stride(stride, batch, height, width):
    assert height % SIZE_MULTIPLE == width % SIZE_MULTIPLE == 0
    maps = maps_of(FeatureNetwork(stride=stride).eval(), torch.rand(batch, 1, height, width))
    size = (height // stride, width // stride)
    assert maps.descriptors.shape == (batch, DESCRIPTOR_SIZE, *size)
    assert maps.quality.shape == maps.log_sigma.shape == (batch, 1, *size)


def test_the_length_of_descriptors_can_be_chosen():
    maps = maps_of(FeatureNetwork(descriptor_size=30).eval(), torch.rand(1, 1, 96, 96))
    assert maps.descriptors.shape[1] == 30


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
    """No layer is left out of the graph: each gets a gradient from the maps."""
    network = FeatureNetwork(stride=stride)
    sum(value.square().sum() for value in network(to_cells(torch.rand(2, 1, 96, 96)))).backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in network.parameters())


def test_maps_move_with_the_image(network, image):
    """A shift by 16 pixels, the network's coarsest cell, shifts the maps by 16 / stride cells, away from borders."""
    tiled = image.repeat(1, 1, 3, 3)
    shifted = torch.roll(tiled, (16, 32), dims=(2, 3))
    for a, b in zip(maps_of(network, tiled), maps_of(network, shifted), strict=True):
        moved = torch.roll(a, (16 // STRIDE, 32 // STRIDE), dims=(2, 3))
        inner = (..., slice(18, -18), slice(18, -18))
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


def test_sample_at_cell_centres_is_the_cell():
    features = torch.rand(2, 5, 6, 9)
    v, u = torch.meshgrid(torch.arange(6.0), torch.arange(9.0), indexing="ij")
    centres = torch.stack([STRIDE * u + 3.5, STRIDE * v + 3.5], dim=-1).reshape(1, -1, 2).expand(2, -1, -1)
    torch.testing.assert_close(sample_map(features, centres), features.flatten(2).mT, rtol=0, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1])
def test_samples_of_a_ramp_are_the_ramp_between_cell_centres(axis):
    v, u = torch.meshgrid(STRIDE * torch.arange(6.0) + 3.5, STRIDE * torch.arange(9.0) + 3.5, indexing="ij")
    ramp = (u, v)[axis][None, None]
    places = torch.tensor([[[10.0, 20.0], [33.3, 7.0], [66.9, 40.0]]])
    torch.testing.assert_close(sample_map(ramp, places)[..., 0], places[..., axis], rtol=0, atol=1e-4)
