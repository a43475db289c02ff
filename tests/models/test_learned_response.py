"""The learned response: first the Hessian's, smooth weights, nothing on flat images, and known by its file."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.detector import detect, hessian_response, pick_peaks, to_cells
from sigmaslam_models.extractor import FeatureExtractor
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.learned_response import _at_pixels
from sigmaslam_models.network_export import export_features, load_network
from sigmaslam_synthetic.rendering.textures import dead_leaves


def texture(height: int, width: int) -> Tensor:
    rng = np.random.default_rng(1)
    grey = dead_leaves((height, width), rng) / 255.0 + 0.02 * rng.standard_normal((height, width))
    return torch.from_numpy(grey.clip(0, 1).astype(np.float32))[None, None]


def network(seed: int = 0, gain: float = 0.0) -> FeatureNetwork:
    """With a response that departs from the Hessian's by a random gain."""
    torch.manual_seed(seed)
    result = FeatureNetwork(detects=True).eval().requires_grad_(False)
    assert result.response is not None
    result.response.decide.weight.normal_(0.0, gain)
    return result


def response_of(net: FeatureNetwork, image: Tensor) -> Tensor:
    assert net.response is not None
    cells = to_cells(image)
    return net.response(cells, net(cells).fine)


@pytest.mark.long
def test_untrained_it_detects_what_the_hessian_does():
    image = texture(192, 256)
    learned = response_of(network(), image)
    keypoints, strength = pick_peaks(learned, learned, 100)
    expected, expected_strength = detect(to_cells(image), 100)
    # The surroundings are interpolated between cells: an order, and no places, changes by a few per cent.
    torch.testing.assert_close(strength, expected_strength, rtol=0.05, atol=1e-3)
    nearest = (expected[0][:, None] - keypoints[0][None]).norm(dim=2).amin(dim=1)
    assert (nearest < 0.1).float().mean() > 0.93


@pytest.mark.parametrize("kind", [0, 1])
def test_weights_are_bilinear_between_cells(kind: int):
    values = torch.zeros(1, 2, 4, 5)
    values[0, kind] = torch.rand(4, 5, generator=torch.Generator().manual_seed(4))
    pixels = functional.pixel_shuffle(_at_pixels(values)[:, 16 * kind : 16 * kind + 16], 4)
    expected = functional.interpolate(
        values[:, kind : kind + 1], scale_factor=4.0, mode="bilinear", align_corners=False
    )
    torch.testing.assert_close(pixels, expected)
    other = 1 - kind
    assert not _at_pixels(values)[:, 16 * other : 16 * other + 16].any()


def test_a_flat_image_has_no_keypoints_whatever_was_learned():
    learned = response_of(network(gain=1.0), torch.full((1, 1, 96, 96), 0.4))
    assert not pick_peaks(learned, learned, 100)[1].any()


def test_it_can_raise_saddles_above_blobs():
    image = texture(96, 128)
    determinant = hessian_response(to_cells(image))
    saddle = determinant < -1e-3
    plain, net = response_of(network(), image), network()
    assert net.response is not None
    assert net.response.decide.bias is not None
    net.response.decide.bias[1] = 100.0
    raised = response_of(net, image)
    # As far as e^4.
    torch.testing.assert_close(raised[saddle], np.float32(np.exp(4.0)) * plain[saddle], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(raised[determinant > 0], plain[determinant > 0])


def test_its_weights_are_known_by_their_file(tmp_path: Path):
    image = texture(96, 128)
    for detects in (False, True):
        torch.manual_seed(3)
        net = FeatureNetwork(detects=detects).eval()
        path = tmp_path / f"{detects}.safetensors"
        save_file({name: value.contiguous() for name, value in net.state_dict().items()}, path)
        loaded = load_network(path)
        assert (loaded.response is not None) == detects
        with torch.no_grad():
            first, second = (FeatureExtractor(each)(image, torch.tensor(100)) for each in (net, loaded))
        for mine, theirs in zip(first, second, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=0, atol=0)


@pytest.mark.slow
def test_its_graph_equals_torch(tmp_path: Path):
    net = network(gain=0.05)
    save_file({name: value.contiguous() for name, value in net.state_dict().items()}, tmp_path / "w.safetensors")
    assert export_features(tmp_path / "w.safetensors", tmp_path / "features.onnx") < 1e-4
