"""Graphs of EdgePoint2 and XFeat, made of checkouts with small networks of the same inputs, outputs and files."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from torch import nn
from torch.nn import functional

from sigmaslam.errors import InputError
from sigmaslam_benchmarks.matching import PeerExtractor
from sigmaslam_benchmarks.matching.peer_exports import export_peer, load_edgepoint2, load_xfeat

EDGEPOINT2 = """
import torch
from torch import nn
from .layers import Shrink

class EdgePoint2(nn.Module):
    def __init__(self, c1, c2, c3, c4, cdesc, cdetect):
        super().__init__()
        self.describe, self.score = Shrink(cdesc), nn.Conv2d(1, 1, 3, padding=1)

    def forward(self, x):
        return self.describe(x), self.score(x)
"""
LAYERS = """
from torch import nn

class Shrink(nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.convolution = nn.Conv2d(1, channels, 4, stride=4)

    def forward(self, x):
        return self.convolution(x)
"""
XFEAT = """
from torch import nn

class XFeatModel(nn.Module):
    def __init__(self, width=64):
        super().__init__()
        self.logits = nn.Conv2d(8, 65, 1)
        self.first = nn.Sequential(
            nn.Conv2d(1, 8, 8, stride=8, bias=False), nn.BatchNorm2d(8, affine=False), nn.ReLU(inplace=True)
        )
        self.features, self.heat = nn.Conv2d(8, width, 1), nn.Sequential(nn.Conv2d(8, 1, 1), nn.Sigmoid())

    def forward(self, x):
        x = self.first(x)
        return self.features(x), self.logits(x), self.heat(x)
"""


def edgepoint2(folder: Path) -> Path:
    (folder / "model").mkdir()
    (folder / "weights").mkdir()
    (folder / "model" / "model.py").write_text(EDGEPOINT2)
    (folder / "model" / "layers.py").write_text(LAYERS)
    torch.manual_seed(0)
    state = {"describe.convolution": nn.Conv2d(1, 64, 4), "score": nn.Conv2d(1, 1, 3)}
    torch.save(
        {f"{name}.{key}": value for name, each in state.items() for key, value in each.state_dict().items()},
        folder / "weights" / "S64.pth",
    )
    return folder


def xfeat(folder: Path, width: int = 64) -> tuple[Path, nn.Module]:
    """A checkout, and the network whose graph is in it, normalisation folded as an exporter does."""
    (folder / "modules").mkdir()
    (folder / "weights").mkdir()
    (folder / "modules" / "model.py").write_text(XFEAT)
    scope: dict[str, type[nn.Module]] = {}
    exec(XFEAT, scope)
    torch.manual_seed(1)
    network = scope["XFeatModel"](width).eval()
    network.first[1].running_mean.normal_()
    network.first[1].running_var.uniform_(0.5, 2.0)
    folded = torch.nn.utils.fusion.fuse_conv_bn_eval(network.first[0], network.first[1])
    nodes, constants = [], []
    for name, each in (
        ("first", folded), ("features", network.features), ("logits", network.logits), ("heat", network.heat[0])
    ):  # fmt: skip
        for key in ("weight", "bias"):
            constants.append(onnx.numpy_helper.from_array(getattr(each, key).detach().numpy(), f"{name}.{key}"))
        nodes.append(onnx.helper.make_node("Conv", ["x", f"{name}.weight", f"{name}.bias"], [name]))
    graph = onnx.helper.make_graph(nodes, "xfeat", [], [], constants)
    onnx.save(onnx.helper.make_model(graph), folder / "weights" / "xfeat.onnx")
    return folder, network


def image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 255, (height, width), np.uint8)


def peaks(response: np.ndarray, border: int) -> set[tuple[int, int]]:
    """(u, v) of what is the largest of the 5x5 pixels around it, by a loop."""
    height, width = response.shape
    return {
        (u, v)
        for v in range(border, height - border)
        for u in range(border, width - border)
        if response[v, u] == response[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3].max()
    }


@pytest.mark.long
def test_edgepoint2_gives_all_peaks_with_the_descriptors_around_them(tmp_path: Path):
    extractor = load_edgepoint2(edgepoint2(tmp_path))
    export_peer(extractor, tmp_path / "peer.onnx")
    grey = image(96, 160)
    keypoints, descriptors = PeerExtractor(tmp_path / "peer.onnx", 2048)(grey)
    tensor = torch.from_numpy(grey)[None, None].float() / 255.0
    with torch.no_grad():
        dense, response = extractor.network(tensor)
        upsampled = functional.interpolate(dense, scale_factor=4.0, mode="bilinear")[0].numpy()
    assert {(int(u), int(v)) for u, v in keypoints} == peaks(response[0, 0].numpy(), 4)
    scores = response[0, 0].numpy()[keypoints[:, 1].astype(int), keypoints[:, 0].astype(int)]
    assert (np.diff(scores) <= 0).all()
    # Inside, a bilinear enlargement says at every pixel what a bilinear sample there is.
    inner = ((keypoints > 8) & (keypoints < (151, 87))).all(axis=1)
    u, v = keypoints[inner].astype(int).T
    expected = upsampled[:, v, u].T / np.linalg.norm(upsampled[:, v, u].T, axis=1, keepdims=True)
    np.testing.assert_allclose(descriptors[inner], expected, atol=1e-4)


def test_xfeat_has_the_weights_of_the_graph(tmp_path: Path):
    checkout, network = xfeat(tmp_path)
    found = load_xfeat(checkout).network
    tensor = torch.rand(1, 1, 64, 96)
    with torch.no_grad():
        for mine, theirs in zip(found(tensor), network(tensor), strict=True):
            torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)


@pytest.mark.long
def test_xfeat_ranks_peaks_by_probability_times_reliability(tmp_path: Path):
    checkout, network = xfeat(tmp_path)
    export_peer(load_xfeat(checkout), tmp_path / "peer.onnx")
    grey = image(64, 128)
    keypoints, descriptors = PeerExtractor(tmp_path / "peer.onnx", 2048)(grey)
    with torch.no_grad():
        dense, logits, heat = network(torch.from_numpy(grey)[None, None].float() / 255.0)
    # Channel k of a cell is its pixel (k mod 8, k div 8).
    cells = logits.softmax(1)[0, :64].numpy().reshape(8, 8, 8, 16)
    response = cells.transpose(2, 0, 3, 1).reshape(64, 128)
    assert {(int(u), int(v)) for u, v in keypoints} == peaks(response, 0)
    u, v = keypoints.astype(int).T
    sure = functional.interpolate(heat, scale_factor=8.0, mode="bilinear")[0, 0].numpy()[v, u]
    scores = response[v, u] * sure
    inner = np.flatnonzero(((keypoints > 8) & (keypoints < (119, 55))).all(axis=1))
    # The authors' samples lie up to half a pixel from these.
    assert np.corrcoef(np.argsort(np.argsort(-scores[inner])), np.arange(len(inner)))[0, 1] > 0.99
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-5)
    assert dense.shape[1] == descriptors.shape[1]


def test_what_is_missing_is_named(tmp_path: Path):
    with pytest.raises(InputError, match=r"model\.py is missing: give the folder of a checkout"):
        load_edgepoint2(tmp_path)
    (tmp_path / "modules").mkdir()
    (tmp_path / "modules" / "model.py").write_text(XFEAT)
    with pytest.raises(InputError, match=r"xfeat\.onnx is missing"):
        load_xfeat(tmp_path)


def test_a_graph_of_another_network_is_refused(tmp_path: Path):
    checkout, _ = xfeat(tmp_path, width=32)
    with pytest.raises(InputError, match=r"xfeat\.onnx holds another network than .*check out c58e74f"):
        load_xfeat(checkout)
