"""Exports the network and the filter to ONNX and checks the graphs against torch at sizes that were not traced."""

from __future__ import annotations

import json
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.files import atomic_path, atomic_write_text, make_folder
from sigmaslam.filters.graphs.graph_file import strip_origins
from sigmaslam.filters.graphs.pose_prediction import STATE_SIZE, Predict
from sigmaslam.filters.manifolds.se3_matrices import exp_se3
from sigmaslam.filters.tracking.frame_update import FrameViews, GatedStep, PredictViews, RobustStep
from sigmaslam.filters.tracking.window_solution import Condition, EliminateLandmarks, GateWindow, WindowViews
from sigmaslam.inference.onnx_graph import OnnxGraph
from sigmaslam.inference.session import check_provider
from sigmaslam.inference.weight_manifest import check_weights, update_manifest
from sigmaslam.models.extractor import EXTRACTOR_SIZE_MULTIPLE, FeatureExtractor
from sigmaslam.models.feature_network import DESCRIPTOR_SIZE, STRIDE, FeatureNetwork
from sigmaslam.models.model_card import card_page, read_card, scoring_page
from sigmaslam.models.runtime_operators import inverse_operator
from sigmaslam.models.scorer_network import NEIGHBOURS, SIDE_CHANNELS, MatchScorer, ScoredMatches
from sigmaslam.models.tracking_graphs import (
    GATED_INPUTS,
    GATED_OUTPUTS,
    PREDICTED,
    ROBUST_INPUTS,
    ROBUST_OUTPUTS,
    WINDOW_INPUTS,
    WINDOW_OUTPUTS,
    condition_example,
    frame_axes,
    frame_example,
    window_axes,
    window_example,
)
from sigmaslam.models.verifier_network import PLACE_COLUMNS, VERIFIER_COLUMNS, MatchCovariance, MatchVerifier
from sigmaslam.synthetic.rendering.textures import dead_leaves

_OPSET = 20
# ONNX Runtime and torch may order sums differently; more than this is a wrong graph.
_FEATURE_TOLERANCE = 1e-4
_FILTER_TOLERANCE = 1e-9
_TIMED_CALLS = 9

_Module = TypeVar("_Module", bound=nn.Module)


@dataclass(frozen=True, slots=True)
class _Graph:
    """A module with inputs to trace it, others to check it, and which axes are free."""

    module: nn.Module
    traced: tuple[Tensor, ...]
    checked: tuple[Tensor, ...]
    inputs: list[str]
    outputs: list[str]
    dynamic: tuple[Any, ...]


def load_network(weights: Path, descriptor_size: int = DESCRIPTOR_SIZE, stride: int = STRIDE) -> FeatureNetwork:
    """The network with trained weights, in evaluation mode.

    Args:
        weights: safetensors file.
        descriptor_size, stride: of the network that was trained.
    Raises:
        InputError: the file is missing, not the one that its manifest names, or holds another network.
    """
    return _load(FeatureNetwork(descriptor_size, stride), weights)


def load_scorer(weights: Path) -> MatchScorer:
    """The match scorer with trained weights; raises as `load_network` does."""
    return _load(MatchScorer(), weights)


def load_verifier(weights: Path, columns: int = VERIFIER_COLUMNS) -> MatchVerifier:
    """A match verifier of so many columns with trained weights; raises as `load_network` does."""
    return _load(MatchVerifier(columns), weights)


def export_scoring(run: Path, out: Path) -> dict[str, float]:
    """Graphs, weights and card of a run of `sigmaslam train-scorer`, into one folder.

    Args:
        run: folder with scorer.safetensors, verifier.safetensors, place_verifier.safetensors and matching.json.
        out: folder.
    Returns:
        Largest differences of the graphs from torch.
    """
    content = read_card(run / "matching.json")
    make_folder(out)
    graphs = _scoring_graphs(
        load_scorer(run / "scorer.safetensors"),
        load_verifier(run / "verifier.safetensors"),
        load_verifier(run / "place_verifier.safetensors", PLACE_COLUMNS),
    )
    differences = {name: _export(graph, out / f"{name}.onnx", _FEATURE_TOLERANCE) for name, graph in graphs.items()}
    content["onnx_minus_torch"] = differences
    for name in graphs:
        copied = (run / f"{name}.safetensors").read_bytes()
        with atomic_path(out / f"{name}.safetensors") as path:
            path.write_bytes(copied)
    atomic_write_text(out / "matching.json", json.dumps(content, indent=2) + "\n")
    atomic_write_text(out / "matching.md", scoring_page(content))
    update_manifest(out, [f"{name}{suffix}" for name in graphs for suffix in (".onnx", ".safetensors")])
    return differences


def export_features(weights: Path, out: Path) -> float:
    """Writes the feature graph and returns the largest difference from torch, in pixels where there are any."""
    return _export(_feature_graph(load_network(weights)), out, _FEATURE_TOLERANCE, _feature_difference)


def check_graphs(folder: Path) -> dict[str, float]:
    """Compares every graph of a folder with torch, on inputs that are the same each time, and returns the differences.

    Args:
        folder: with the graphs and the weights, as `sigmaslam export` writes it and as it ships.
    Raises:
        InputError: a file is missing or not the one of the manifest, or there is a graph of which torch knows nothing.
        SigmaSlamError: a graph differs from torch by more than its tolerance.
    """
    present = {path.stem for path in folder.glob("*.onnx")}
    graphs = _filter_graphs() | _network_graphs(folder)
    if not present or present - graphs.keys():
        strangers = ", ".join(f"{name}.onnx" for name in sorted(present - graphs.keys())) or "no .onnx file"
        raise InputError(f"{folder}: {strangers}, but only what `sigmaslam export` writes can be compared with torch")
    differences = {}
    for name in sorted(present):
        compare = _feature_difference if name == "features" else _relative_difference
        differences[name] = _difference(graphs[name], folder / f"{name}.onnx", compare)
        tolerance = _FILTER_TOLERANCE if name in _filter_graphs() else _FEATURE_TOLERANCE
        if not differences[name] <= tolerance:
            raise SigmaSlamError(
                f"{folder / name}.onnx differs from torch by {differences[name]:.2e}, more than {tolerance:.0e}: "
                "export it again with `sigmaslam export`"
            )
    return differences


@dataclass(frozen=True, slots=True)
class CallTime:
    """Medians of a graph's calls.

    Attributes:
        wall_ms: milliseconds.
        process_ms: of CPU time, of all threads.
    """

    wall_ms: float
    process_ms: float


@dataclass(frozen=True, slots=True)
class ProviderCheck:
    """A network on an execution provider beside the same on the CPU.

    Attributes:
        difference: largest one of the outputs.
        on_cpu, on_provider: what a call takes.
    """

    difference: float
    on_cpu: CallTime
    on_provider: CallTime


def check_networks(folder: Path, provider: str) -> dict[str, ProviderCheck]:
    """Runs the networks of a folder on an execution provider and on the CPU, on the inputs of `check_graphs`.

    Args:
        folder: as of `check_graphs`.
        provider: one of `sigmaslam.inference.session.PROVIDERS`.
    Raises:
        InputError: the provider is not installed or does not start, or a file is missing.
        SigmaSlamError: a network differs by more than its tolerance.
    """
    check_provider(provider)
    checks = {}
    for name, graph in _network_graphs(folder).items():
        path, feed = folder / f"{name}.onnx", _feed(graph)
        expected, on_cpu = _timed(OnnxGraph(path), feed)
        actual, on_provider = _timed(OnnxGraph(path, provider=provider), feed)
        difference = (_feature_difference if name == "features" else _relative_difference)(actual, expected)
        if not difference <= _FEATURE_TOLERANCE:
            raise SigmaSlamError(
                f"{name}.onnx on the provider {provider} differs from the CPU by {difference:.2e}, more than "
                f"{_FEATURE_TOLERANCE:.0e}: track without it"
            )
        checks[name] = ProviderCheck(difference, on_cpu, on_provider)
    return checks


def _timed(graph: OnnxGraph, feed: dict[str, np.ndarray]) -> tuple[list[np.ndarray], CallTime]:
    """Outputs of a graph, and what a call takes."""
    outputs = graph(feed)  # the first call makes what the others use
    seconds = []
    for _ in range(_TIMED_CALLS):
        wall, process = time.perf_counter(), time.process_time()
        graph(feed)
        seconds.append((time.perf_counter() - wall, time.process_time() - process))
    return outputs, CallTime(*(1e3 * float(median) for median in np.median(seconds, axis=0)))


def _network_graphs(folder: Path) -> dict[str, _Graph]:
    """The networks of which the folder has graphs."""
    graphs = {}
    if (folder / "features.onnx").is_file():
        graphs["features"] = _feature_graph(load_network(folder / "features.safetensors"))
    if (folder / "scorer.onnx").is_file():
        graphs |= _scoring_graphs(
            load_scorer(folder / "scorer.safetensors"),
            load_verifier(folder / "verifier.safetensors"),
            load_verifier(folder / "place_verifier.safetensors", PLACE_COLUMNS),
        )
    return graphs


def _feature_graph(network: FeatureNetwork) -> _Graph:
    height = torch.export.Dim("height_blocks", min=3, max=256)
    width = torch.export.Dim("width_blocks", min=3, max=256)
    rng = np.random.default_rng(0)
    image, other = (_noisy_texture(rng, shape) for shape in ((256, 320), (192, 416)))
    multiple = EXTRACTOR_SIZE_MULTIPLE
    return _Graph(
        FeatureExtractor(network).eval(),
        (image, torch.tensor(512)),
        (other, torch.tensor(700)),
        ["image", "count"],
        ["keypoints", "scores", "descriptors", "sigma"],
        ({2: multiple * height, 3: multiple * width}, None),
    )


def export_filter(folder: Path) -> dict[str, float]:
    """Writes the filter's graphs and returns the largest difference of each from torch."""
    differences = {
        name: _export(graph, folder / f"{name}.onnx", _FILTER_TOLERANCE) for name, graph in _filter_graphs().items()
    }
    update_manifest(folder, [f"{name}.onnx" for name in differences])
    return differences


def export_all(
    weights: Path, card: Path, out: Path, scores: dict[str, dict[str, float]] | None = None
) -> dict[str, float]:
    """Everything the runtime needs, into one folder: graphs, weights and card.

    Args:
        weights: safetensors file of a training run.
        card: its JSON card; the differences found here are added to the copy in `out`.
        scores: of these weights on real sets, by set, for the card.
        out: folder that gets features.onnx, the filter's graphs, features.safetensors, and features.json and .md.
    """
    content = read_card(card)
    if scores is not None:
        content["metrics_on_real_sets"] = scores
    make_folder(out)
    differences = {"features": export_features(weights, out / "features.onnx"), **export_filter(out)}
    content["onnx_minus_torch"] = differences
    copied = weights.read_bytes()
    with atomic_path(out / "features.safetensors") as path:
        path.write_bytes(copied)
    atomic_write_text(out / "features.json", json.dumps(content, indent=2) + "\n")
    atomic_write_text(out / "features.md", card_page(content))
    update_manifest(out, ["features.safetensors", "features.onnx"])
    return differences


def _load(module: _Module, weights: Path) -> _Module:
    if not weights.is_file():
        raise InputError(f"{weights} does not exist: train first, or give the path of a .safetensors file")
    check_weights(weights, weights.read_bytes())
    try:
        module.load_state_dict(load_file(weights))
    except (RuntimeError, ValueError, SafetensorError) as error:
        raise InputError(f"{weights} does not hold the weights of this network: {error}") from error
    return module.eval()


def _scoring_graphs(scorer: MatchScorer, verifier: MatchVerifier, place_verifier: MatchVerifier) -> dict[str, _Graph]:
    free = {0: torch.export.Dim("matches", min=1, max=100_000)}
    return {
        "scorer": _Graph(
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


def _verifier_graph(verifier: MatchVerifier, columns: int) -> _Graph:
    return _Graph(
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


def _filter_graphs() -> dict[str, _Graph]:
    fixed: dict[int, Any] = {}
    state, columns = (torch.export.Dim(name, min=1, max=10_000) for name in ("state", "columns"))
    return {
        "pose_predict": _Graph(
            Predict(),
            _predict_example(0),
            _predict_example(1),
            ["pose", "twist", "covariance", "step", "densities"],
            ["predicted_pose", "predicted_covariance"],
            (fixed,) * 5,
        ),
        "frame_predict": _frame_graph(PredictViews(), (), PREDICTED),
        "frame_robust": _frame_graph(RobustStep(), ROBUST_INPUTS, ROBUST_OUTPUTS),
        "frame_gated": _frame_graph(GatedStep(), GATED_INPUTS, GATED_OUTPUTS),
        "window_eliminate": _window_graph(EliminateLandmarks(), WINDOW_INPUTS, WINDOW_OUTPUTS),
        "window_gate": _window_graph(GateWindow(), (), ("agree",)),
        "window_condition": _Graph(
            Condition(),
            condition_example(0, 18, 7),
            condition_example(1, 30, 25),
            ["factor", "information", "vector", "common"],
            ["mean", "covariance", "common_after"],
            ({0: state, 1: columns}, {0: state, 1: state}, {0: state}, {0: state}),
        ),
    }


def _frame_graph(module: nn.Module, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> _Graph:
    """A step of a frame's update with inputs of its own, before the fields of `FrameViews`."""
    fields = FrameViews._fields
    traced, checked = (
        frame_example(seed, keyframes, count, *inputs, *fields) for seed, keyframes, count in ((0, 3, 40), (1, 5, 77))
    )
    axes = (*frame_axes(*inputs), frame_axes(*fields))
    return _Graph(module, traced, checked, [*inputs, *fields], list(outputs), axes)


def _window_graph(module: nn.Module, inputs: tuple[str, ...], outputs: tuple[str, ...]) -> _Graph:
    """A step of a window's solution with inputs of its own, before the fields of `WindowViews`."""
    fields = WindowViews._fields
    traced, checked = (
        window_example(seed, keyframes, count, *inputs, *fields) for seed, keyframes, count in ((0, 4, 30), (1, 5, 50))
    )
    axes = (*window_axes(*inputs), window_axes(*fields))
    return _Graph(module, traced, checked, [*inputs, *fields], list(outputs), axes)


def _predict_example(seed: int) -> tuple[Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    root = 0.004 * random(STATE_SIZE, STATE_SIZE)
    densities = 0.1 + random(2).abs()
    step = torch.tensor(0.1 + 0.2 * seed, dtype=torch.float64)
    return exp_se3(0.3 * random(6)), random(6), root @ root.T, step, densities


def _export(
    graph: _Graph,
    out: Path,
    tolerance: float,
    compare: Callable[[list[np.ndarray], list[np.ndarray]], float] | None = None,
) -> float:
    with warnings.catch_warnings(), atomic_path(out) as path:
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            graph.module.eval(),
            graph.traced,
            dynamo=True,
            input_names=graph.inputs,
            output_names=graph.outputs,
            dynamic_shapes=graph.dynamic,
            opset_version=_OPSET,
            verbose=False,
            custom_translation_table={torch.ops.aten.linalg_inv_ex.default: inverse_operator()},
        )
        assert program is not None
        program.save(path, external_data=False)
        strip_origins(path)
        difference = _difference(graph, path, compare or _relative_difference)
        if not difference <= tolerance:
            raise SigmaSlamError(
                f"{out.name} differs from torch by {difference:.2e}, more than {tolerance:.0e}: not written"
            )
    return difference


def _difference(graph: _Graph, path: Path, compare: Callable[[list[np.ndarray], list[np.ndarray]], float]) -> float:
    """Of a written graph from its module, on inputs that it was not traced with."""
    actual = OnnxGraph(path)(_feed(graph))
    with torch.no_grad():
        outputs = graph.module(*graph.checked)
    expected = [value.numpy() for value in (outputs if isinstance(outputs, tuple) else (outputs,))]
    return compare(actual, expected)


def _feed(graph: _Graph) -> dict[str, np.ndarray]:
    """The inputs by which it is checked."""
    return {name: np.asarray(value) for name, value in zip(graph.inputs, graph.checked, strict=True)}


def _relative_difference(actual: list[np.ndarray], expected: list[np.ndarray]) -> float:
    """Largest difference over all outputs, relative to an output's largest value where that exceeds 1."""
    pairs = [(np.asarray(a, np.float64), np.asarray(b, np.float64)) for a, b in zip(actual, expected, strict=True)]
    return max(float(np.abs(a - b).max() / max(1.0, float(np.abs(b).max()))) for a, b in pairs)


def _feature_difference(actual: list[np.ndarray], expected: list[np.ndarray]) -> float:
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
