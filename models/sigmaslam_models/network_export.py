"""The trained networks: read from their weights, and exported to ONNX."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file as read_arrays
from safetensors.torch import load_file
from torch import Tensor, nn

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_bytes, atomic_write_json, atomic_write_text, make_folder
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.inference.weight_manifest import check_weights
from sigmaslam_models.extractor import BLOBS, EXTRACTOR_SIZE_MULTIPLE, FeatureExtractor
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.graph_export import TracedModule, exchange_weights, export_graph, update_manifest
from sigmaslam_models.model_card import read_card, scoring_page
from sigmaslam_models.scorer_network import NEIGHBOURS, SIDE_CHANNELS, MatchScorer, ScoredMatches
from sigmaslam_models.verifier_network import PLACE_COLUMNS, VERIFIER_COLUMNS, MatchCovariance, MatchVerifier
from sigmaslam_synthetic.rendering.textures import dead_leaves

# ONNX Runtime and torch may order sums differently; more than this is a wrong graph.
NETWORK_TOLERANCE = 1e-4

_Module = TypeVar("_Module", bound=nn.Module)


def load_network(weights: Path) -> FeatureNetwork:
    """The network with trained weights, in evaluation mode.

    Args:
        weights: safetensors file.
    Raises:
        InputError: the file is missing, not the one that its manifest names, or holds another network.
    """
    return _load(FeatureNetwork(), weights)


def load_scorer(weights: Path) -> MatchScorer:
    """The match scorer with trained weights; raises as `load_network` does."""
    return _load(MatchScorer(), weights)


def load_verifier(weights: Path, columns: int = VERIFIER_COLUMNS) -> MatchVerifier:
    """A match verifier of so many columns with trained weights; raises as `load_network` does."""
    return _load(MatchVerifier(columns), weights)


def export_features(weights: Path, out: Path) -> float:
    """Writes the feature graph and returns the largest difference from torch, in pixels where there are any."""
    graph, draft = _feature_graph(load_network(weights)), _with_weights("features", weights)
    return export_graph(graph, out, NETWORK_TOLERANCE, feature_difference, draft)


def export_scoring(run: Path, out: Path) -> dict[str, float]:
    """Graphs, weights and card of a run of `sigmaslam train scorer`, into one folder.

    Args:
        run: folder with scorer.safetensors, verifier.safetensors, place_verifier.safetensors and matching.json.
        out: folder.
    Returns:
        Largest differences of the graphs from torch.
    """
    content = read_card(run / "matching.json")
    make_folder(out)
    graphs = _load_scoring(run)
    content["onnx_minus_torch"] = differences = {
        name: export_graph(
            graph, out / f"{name}.onnx", NETWORK_TOLERANCE, draft=_with_weights(name, run / f"{name}.safetensors")
        )
        for name, graph in graphs.items()
    }
    for name in graphs:
        atomic_write_bytes(out / f"{name}.safetensors", (run / f"{name}.safetensors").read_bytes())
    atomic_write_json(out / "matching.json", content)
    atomic_write_text(out / "matching.md", scoring_page(content))
    update_manifest(out, [f"{name}{suffix}" for name in graphs for suffix in (".onnx", ".safetensors")])
    return differences


def network_graphs(folder: Path) -> dict[str, TracedModule]:
    """The networks of which the folder has graphs."""
    graphs = {}
    if (folder / "features.onnx").is_file():
        graphs["features"] = _feature_graph(load_network(folder / "features.safetensors"))
    if (folder / "scorer.onnx").is_file():
        graphs |= _load_scoring(folder)
    return graphs


def feature_difference(actual: list[np.ndarray], expected: list[np.ndarray]) -> float:
    """Largest difference of common keypoints, their scores, descriptors and sigmas; infinite if over 2 % are missing.

    Round-off may swap two keypoints of nearly equal score, so they are paired by place.
    """
    count = int((expected[1] > 0).sum())
    distance = np.linalg.norm(expected[0][:count, None] - actual[0][None, :count], axis=2)
    nearest = distance.argmin(axis=1)
    common = distance[np.arange(count), nearest] < 1.0
    if common.mean() < 0.98:
        return float("inf")
    return max(
        float(np.abs(a[nearest[common]] - b[:count][common]).max()) for a, b in zip(actual, expected, strict=True)
    )


def _with_weights(name: str, weights: Path) -> Callable[[Path], None]:
    """Writes the graph of this name that ships, with other weights."""
    shipped = shipped_weights(f"{name}.safetensors")
    return partial(exchange_weights, shipped.with_suffix(".onnx"), read_arrays(shipped), read_arrays(weights))


def _feature_graph(network: FeatureNetwork) -> TracedModule:
    height = torch.export.Dim("height_blocks", min=3, max=256)
    width = torch.export.Dim("width_blocks", min=3, max=256)
    rng = np.random.default_rng(0)
    image, other = (_noisy_texture(rng, shape) for shape in ((256, 320), (192, 416)))
    multiple = EXTRACTOR_SIZE_MULTIPLE
    return TracedModule(
        FeatureExtractor(network).eval(),
        (image, torch.tensor(512)),
        (other, torch.tensor(700)),
        ["image", "count"],
        ["keypoints", "scores", "descriptors", "sigma", *(f"found_{name}" for name in BLOBS)],
        ({2: multiple * height, 3: multiple * width}, None),
        BLOBS,
    )


def _load(module: _Module, weights: Path) -> _Module:
    if not weights.is_file():
        raise InputError(f"{weights} does not exist: train first, or give the path of a .safetensors file")
    check_weights(weights, weights.read_bytes())
    try:
        module.load_state_dict(load_file(weights))
    except (RuntimeError, ValueError, SafetensorError) as error:
        raise InputError(f"{weights} does not hold the weights of this network: {error}") from error
    return module.eval()


def _load_scoring(folder: Path) -> dict[str, TracedModule]:
    scorer, verifier, place_verifier = (
        folder / f"{name}.safetensors" for name in ("scorer", "verifier", "place_verifier")
    )
    return _scoring_graphs(load_scorer(scorer), load_verifier(verifier), load_verifier(place_verifier, PLACE_COLUMNS))


def _scoring_graphs(
    scorer: MatchScorer, verifier: MatchVerifier, place_verifier: MatchVerifier
) -> dict[str, TracedModule]:
    free = {0: torch.export.Dim("matches", min=1, max=100_000)}
    return {
        "scorer": TracedModule(
            ScoredMatches(scorer),
            _matches_example(0, 300),
            _matches_example(1, 77),
            ["points0", "points1", "side", "near"],
            ["logit"],
            (free,) * 4,
        ),
        "verifier": _verifier_graph(verifier, VERIFIER_COLUMNS),
        "place_verifier": _verifier_graph(place_verifier, PLACE_COLUMNS),
    }


def _verifier_graph(verifier: MatchVerifier, columns: int) -> TracedModule:
    return TracedModule(
        MatchCovariance(verifier),
        _columns_example(0, 300, columns),
        _columns_example(1, 77, columns),
        ["columns", "axes"],
        ["probability", "covariance"],
        ({0: torch.export.Dim("matches", min=1, max=100_000)},) * 2,
    )


def _matches_example(seed: int, count: int) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    points0 = 400.0 * torch.rand(count, 2, generator=generator)
    points1 = points0 + 4.0 * torch.rand(count, 2, generator=generator)
    near = torch.randint(0, count, (count, NEIGHBOURS), generator=generator)
    return points0, points1, torch.rand(count, SIDE_CHANNELS, generator=generator), near


def _columns_example(seed: int, count: int, columns: int) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    angle = torch.pi * torch.rand(count, generator=generator)
    axes = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()], dim=1).reshape(count, 2, 2)
    return torch.randn(count, columns, generator=generator), axes


def _noisy_texture(rng: np.random.Generator, shape: tuple[int, int]) -> Tensor:
    """A texture with noise: drawn edges alone have exact ties among corners, which round-off decides."""
    image = dead_leaves(shape, rng) / 255.0 + 0.02 * rng.standard_normal(shape)
    return torch.from_numpy(image.clip(0, 1).astype(np.float32))[None, None]
