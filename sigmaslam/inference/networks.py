"""The networks: those that ship, or those of a folder that `sigmaslam train export` wrote."""

import os
from collections.abc import Sequence
from pathlib import Path

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import InputError
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights

NETWORKS = ("features", "scorer", "verifier", "place_verifier")
"""What is trained. The graphs of the estimator hold no weights: they are always those of the package."""
SUFFIXES = {"onnx": ".onnx", "torch": ".safetensors"}
"""Of the file that holds a network, by back-end."""

WeightsFolder = str | os.PathLike[str] | None
"""Folder of networks; None: those that ship."""


def network_path(name: str, weights: WeightsFolder = None, backend: str = "onnx") -> Path:
    """The file of a network; of those that a folder lacks, the one that ships.

    Args:
        name: one of `NETWORKS`.
        backend: "onnx" or "torch".
    Raises:
        InputError: the folder has the network, but not in the form that this back-end reads.
    """
    suffix = SUFFIXES[backend]
    if weights is None:
        return shipped_weights(name + suffix)
    path = Path(weights) / (name + suffix)
    if path.is_file():
        return path
    for other in SUFFIXES.values():
        if path.with_suffix(other).is_file():
            raise InputError(
                f"{path.parent}: holds {name}{other}, but no {path.name}: give a folder that `sigmaslam train export "
                "RUN --out FOLDER` wrote"
            )
    return shipped_weights(name + suffix)


def networks_in(weights: WeightsFolder, backend: str = "onnx", names: Sequence[str] = NETWORKS) -> tuple[str, ...]:
    """Which of these networks a folder has; none without a folder.

    Raises:
        InputError: there is no such folder, or none of the networks is in it, or one in the other form.
    """
    if weights is None:
        return ()
    folder = Path(weights)
    if not folder.is_dir():
        raise InputError(
            f"--weights {folder}: {'is no folder' if folder.exists() else 'does not exist'}: give one that `sigmaslam "
            "train export RUN --out FOLDER` wrote"
        )
    found = tuple(name for name in names if network_path(name, folder, backend).parent == folder)
    if not found:
        files = ", ".join(name + SUFFIXES[backend] for name in names)
        raise InputError(
            f"--weights {folder}: holds none of {files}: give a folder that `sigmaslam train export RUN --out "
            "FOLDER` wrote"
        )
    return found


def open_graph(name: str, weights: WeightsFolder = None, threads: int = 1, provider: str = "cpu") -> OnnxGraph:
    """The graph of a network.

    Args:
        name: one of `NETWORKS`.
        weights: folder; of what it lacks, the graphs that ship are opened.
        threads, provider: of `OnnxGraph`.
    Raises:
        InputError: the graph is not the one of the manifest beside it, cannot be loaded, or takes or gives something
            else than the one that ships.
    """
    path, shipped = network_path(name, weights), network_path(name)
    graph = OnnxGraph(path, threads, provider)
    if path != shipped:
        _check_same_signature(path, graph, OnnxGraph(shipped))
    return graph


def _check_same_signature(path: Path, graph: OnnxGraph, shipped: OnnxGraph) -> None:
    """Names, types and shapes of the inputs, and names of the outputs, are those of the graph that ships."""
    mend = "export it again with `sigmaslam train export` of this version"
    if graph.inputs != shipped.inputs:
        raise InputError(
            f"{path}: takes {shorten(_describe(graph), 200)}, and not {_describe(shipped)} as the graph that ships: "
            f"{mend}"
        )
    if graph.outputs != shipped.outputs:
        raise InputError(
            f"{path}: gives {shorten(', '.join(graph.outputs), 200)}, and not {', '.join(shipped.outputs)} as the "
            f"graph that ships: {mend}"
        )


def _describe(graph: OnnxGraph) -> str:
    return ", ".join(str(each) for each in graph.inputs)
