"""ONNX Runtime sessions: their options, and the shipped graphs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import onnxruntime

from sigmaslam.bounded_files import read_bytes, shorten
from sigmaslam.errors import InputError
from sigmaslam.inference.weight_manifest import check_weights

# This fusion moves a constant factor into a float32 attribute of the product, even if the product is float64. The
# covariances of the filter would be wrong in the eighth digit.
_DISABLED = ["MatMulScaleFusion"]
BACKENDS = ("onnx", "torch")
_GRAPH_BYTES = 1 << 31


Step = Callable[[Mapping[str, np.ndarray]], list[np.ndarray]]
"""What a loaded graph is called as: arrays by name, outputs in order."""


class OnnxGraph:
    """A loaded graph that is called with named arrays.

    Args:
        path: .onnx file.
        threads: within one operator; results are the same bit for bit as long as it does not change.
    Raises:
        InputError: the file is missing, not the one that its manifest names, or no usable graph.
    """

    def __init__(self, path: Path, threads: int = 1) -> None:
        self._path = path
        if not path.is_file():
            raise InputError(f"{path} does not exist: reinstall the package, or export the graph again")
        content = read_bytes(path, _GRAPH_BYTES, "the graph")
        check_weights(path, content)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Several sessions take turns. A session that spins while it waits halves the speed of the others.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"], disabled_optimizers=_DISABLED
            )
        except Exception as error:  # onnxruntime raises its own types, none of them public
            raise InputError(f"{path} is not a graph that ONNX Runtime can load: {error}") from error
        self.outputs: Sequence[str] = [output.name for output in self._session.get_outputs()]

    def __call__(self, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Outputs in the order of the graph."""
        try:
            outputs: list[np.ndarray] = self._session.run(None, dict(feed))
        except Exception as error:  # as above; ValueError where an input is missing
            raise InputError(
                f"{self._path}: the graph does not take {', '.join(feed)} ({shorten(str(error), 200)}): reinstall the "
                "package, or export the graph again with `sigmaslam export`"
            ) from error
        return outputs


def shipped_weights(name: str) -> Path:
    """Path of a file in the package's folder of weights and graphs."""
    with as_file(files("sigmaslam.models.weights") / name) as path:
        return Path(path)


@cache
def load_step(name: str, backend: str) -> Step:
    """A step of the filter by the name of its graph, with one of `BACKENDS`; "torch" is the same step in torch.

    It has no state, and is loaded once in a process.
    """
    if backend == "torch":
        from sigmaslam.models.torch_runtime import filter_module

        return filter_module(name)
    return OnnxGraph(shipped_weights(f"{name}.onnx"))
