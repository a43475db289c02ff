"""Graphs that are called with named arrays, and those that ship."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import read_bytes, shorten
from sigmaslam.errors import InputError
from sigmaslam.inference.session import RUNTIME_VERSION, open_session
from sigmaslam.inference.weight_manifest import check_weights

_GRAPH_BYTES = 1 << 31


Step = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]
"""What a loaded graph is called as: arrays by name, outputs in order."""


@dataclass(frozen=True, slots=True)
class GraphInput:
    """An input of a graph.

    Attributes:
        name, type: as the graph has them, the type as `tensor(float)`.
        shape: sizes; None for one that is free.
    """

    name: str
    type: str
    shape: tuple[int | None, ...]

    def __str__(self) -> str:
        sizes = ", ".join("any" if size is None else str(size) for size in self.shape)
        return f"{self.name} {self.type} ({sizes})"


class OnnxGraph:
    """A loaded graph that is called with named arrays.

    Args:
        path: .onnx file.
        threads: within one operator; results are the same bit for bit as long as it does not change.
        provider: where it computes, one of `sigmaslam.inference.session.PROVIDERS`.

    Attributes:
        inputs: in the order of the graph, without the optional ones.
        optional: names of those.
        outputs: their names, likewise.
    Raises:
        InputError: the file is missing, not the one that its manifest names, or no usable graph, or the provider is
            not installed.
    """

    def __init__(self, path: Path, threads: int = 1, provider: str = "cpu") -> None:
        self._path = path
        if not path.is_file():
            raise InputError(f"{path} does not exist: reinstall the package, or export the graph again")
        content = read_bytes(path, _GRAPH_BYTES, "the graph")
        check_weights(path, content)
        try:
            self._session = open_session(content, threads, provider)
        except InputError:
            raise
        except Exception as error:  # onnxruntime raises its own types, none of them public
            raise InputError(
                f"{path} is no graph that ONNX Runtime {RUNTIME_VERSION} can load (the shipped ones need 1.29): {error}"
            ) from error
        self.inputs = tuple(
            GraphInput(each.name, each.type, tuple(size if isinstance(size, int) else None for size in each.shape))
            for each in self._session.get_inputs()
        )
        self.optional: Sequence[str] = [each.name for each in self._session.get_overridable_initializers()]
        self.outputs: Sequence[str] = [output.name for output in self._session.get_outputs()]

    def __call__(self, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Outputs in the order of the graph."""
        try:
            outputs: list[np.ndarray] = self._session.run(None, dict(feed))
        except Exception as error:  # as above; ValueError where an input is missing
            raise InputError(
                f"{self._path}: the graph does not take {', '.join(feed)} ({shorten(str(error), 200)}): reinstall the "
                "package, or export the graph again with `sigmaslam train export`"
            ) from error
        return outputs


def shipped_weights(name: str) -> Path:
    """Path of a file in the package's folder of weights and graphs."""
    with as_file(files("sigmaslam_weights") / name) as path:
        return Path(path)
