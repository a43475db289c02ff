"""The learned response: first the Hessian's, nothing on flat images, one graph, and known by its file."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from sigmaslam_models.detector import detect, hessian_response, pick_peaks, to_cells
from sigmaslam_models.extractor import FeatureExtractor
from sigmaslam_models.feature_network import FeatureNetwork
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
    keypoints, strength = pick_peaks(learned, learned, 300)
    expected, expected_strength = detect(to_cells(image), 300)
    # Above the floor the order is the same, and a constant shifts no peak.
    torch.testing.assert_close(strength, expected_strength + 0.02)
    distance = (keypoints - expected).norm(dim=2)
    assert distance.quantile(0.95) < 0.1
    assert distance.max() < 1.5


def test_a_flat_image_has_no_keypoints_whatever_was_learned():
    learned = response_of(network(gain=1.0), torch.full((1, 1, 96, 96), 0.4))
    assert not pick_peaks(learned, learned, 100)[1].any()


def test_it_can_raise_a_corner_that_is_no_blob():
    image = torch.zeros(1, 1, 96, 96)
    image[:, :, 48:, 48:] = 1.0
    # Beside the corner of two edges the determinant is negative.
    saddle = hessian_response(to_cells(image)) < -1e-3
    assert saddle.any()
    plain = response_of(network(), image)
    torch.testing.assert_close(plain[saddle], torch.full_like(plain[saddle], 0.02))
    raised = response_of(network(gain=100.0), image)[saddle]
    # As far as e^4 to either side.
    assert raised.max() == pytest.approx(0.02 * np.exp(4.0), rel=1e-3)
    assert raised.min() == pytest.approx(0.02 * np.exp(-4.0), rel=1e-3)


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
