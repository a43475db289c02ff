"""What computes networks and the filter's steps: ONNX Runtime, or what an installed package registers.

A package registers a back end as an entry point of the group `sigmaslam.backends`, as `sigmaslam_models` does with
torch.
"""

from functools import cache
from typing import Protocol

from sigmaslam.errors import InputError
from sigmaslam.inference.networks import WeightsFolder, open_graph
from sigmaslam.inference.onnx_graph import OnnxGraph, Step, shipped_weights

ONNX = "onnx"
_GROUP = "sigmaslam.backends"


class Backend(Protocol):
    """What an entry point of the group names."""

    def open_network(self, name: str, weights: WeightsFolder) -> Step:
        """A network, one of `sigmaslam.inference.networks.NETWORKS`, of a folder or the one that ships."""
        ...

    def open_step(self, name: str) -> Step:
        """A step of the filter by the name of its graph."""
        ...


def backend_names() -> tuple[str, ...]:
    """What `backend` may be here."""
    from importlib.metadata import entry_points  # takes 30 ms, which ONNX Runtime does without

    return (ONNX, *sorted(entry_points(group=_GROUP).names))


def open_network(
    name: str, weights: WeightsFolder = None, threads: int = 1, provider: str = "cpu", backend: str = ONNX
) -> Step:
    """A network that is called with named arrays.

    Args:
        name: one of `sigmaslam.inference.networks.NETWORKS`.
        weights: folder; of what it lacks, the networks that ship are opened.
        threads, provider: of ONNX Runtime.
        backend: one of `backend_names()`.
    Raises:
        InputError: the network cannot be loaded, or the back end is not installed.
    """
    if backend == ONNX:
        return open_graph(name, weights, threads, provider)
    return _registered(backend).open_network(name, weights)


@cache
def load_step(name: str, backend: str = ONNX) -> Step:
    """A step of the filter by the name of its graph. It has no state, and is loaded once in a process.

    Raises:
        InputError: as `open_network`.
    """
    if backend == ONNX:
        return OnnxGraph(shipped_weights(f"{name}.onnx"))
    return _registered(backend).open_step(name)


def _registered(backend: str) -> Backend:
    from importlib.metadata import entry_points

    for entry in entry_points(group=_GROUP, name=backend):
        try:
            loaded: Backend = entry.load()
        except ImportError as error:
            raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[train]'") from error
        return loaded
    raise InputError(f"backend {backend} is not registered: use one of {', '.join(backend_names())}")
