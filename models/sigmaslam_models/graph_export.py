"""A module as an ONNX graph: written, kept by its hash, and compared with torch on inputs of other sizes."""

import contextlib
import hashlib
import logging
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.files import atomic_path, atomic_write_json
from sigmaslam.inference.onnx_graph import OnnxGraph
from sigmaslam.inference.weight_manifest import MANIFEST_NAME, read_manifest
from sigmaslam_filters.graphs.graph_file import simplify, strip_origins
from sigmaslam_models.runtime_operators import inverse_operator

_OPSET = 20
Compare = Callable[[list[np.ndarray], list[np.ndarray]], float]


@dataclass(frozen=True, slots=True)
class TracedModule:
    """A module with inputs to trace it, others to check it, and which axes are free.

    Attributes:
        traced, checked: arguments of the module, of other sizes.
        inputs, outputs: names in the graph.
        optional: inputs that need not be given, as there are outputs `found_NAME`, which the graph loses.
        dynamic: of each argument the free axes, as `torch.onnx.export` takes them.
    """

    module: nn.Module
    traced: tuple[Tensor, ...]
    checked: tuple[Tensor, ...]
    inputs: list[str]
    outputs: list[str]
    dynamic: tuple[Any, ...]
    optional: tuple[str, ...] = ()


def export_graph(
    graph: TracedModule,
    out: Path,
    tolerance: float,
    compare: Compare | None = None,
    draft: Callable[[Path], None] | None = None,
) -> float:
    """Writes a graph and returns its difference from torch.

    Args:
        draft: writes what may be the graph already; it is traced, for minutes, only where that is another one.

    Raises:
        SigmaSlamError: it is larger than the tolerance. Nothing is written.
    """
    with warnings.catch_warnings(), atomic_path(out) as path:
        if draft is not None:
            with contextlib.suppress(InputError, ValueError):
                draft(path)
                difference = graph_difference(graph, path, compare or relative_difference)
                if difference <= tolerance:
                    return difference
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
            optimize=False,
            custom_translation_table={torch.ops.aten.linalg_inv_ex.default: inverse_operator()},
        )
        assert program is not None
        simplify(program.model)
        program.save(path, external_data=False)
        strip_origins(path)
        if graph.optional:
            _make_optional(path, graph.optional)
        difference = graph_difference(graph, path, compare or relative_difference)
        if not difference <= tolerance:
            raise SigmaSlamError(
                f"{out.name} differs from torch by {difference:.2e}, more than {tolerance:.0e}: not written"
            )
    return difference


def _make_optional(path: Path, names: Sequence[str]) -> None:
    """Inputs `names` in place of outputs `found_NAME` (float32): what finds these runs where the first is left out."""
    from onnx import compose, helper, load, numpy_helper, parser, save, utils  # only to write a graph

    parts, found = utils.Extractor(load(path)), [f"found_{name}" for name in names]
    inputs, outputs = ([each.name for each in values] for values in (parts.graph.input, parts.graph.output))
    making = parts.extract_model(inputs, found).graph
    compose.add_prefix_graph(making, "made_", rename_inputs=False, rename_value_infos=False, inplace=True)
    making = helper.make_graph(making.node, "made", [], making.output, making.initializer)
    given, kept = (" ".join(text.format(name) for name in names) for text in ("k_{0} = Identity ({0})", "k_{0}"))
    keeping = parser.parse_graph(f"kept () => (float[n] {kept.replace(' ', ', float[n] ')}) {{ {given} }}")
    model = parts.extract_model([*inputs, *found], [name for name in outputs if name not in found])
    for each, name in zip(model.graph.input[-len(names) :], names, strict=True):
        each.name = name
        shape = [size.dim_value for size in each.type.tensor_type.shape.dim]
        model.graph.initializer.append(numpy_helper.from_array(np.zeros(shape, np.float32), name))
    nodes = [
        helper.make_node("Size", [names[0]], ["size"]),
        helper.make_node("Cast", ["size"], ["is_given"], to=9),  # to bool
        helper.make_node("If", ["is_given"], found, then_branch=keeping, else_branch=making),
    ]
    for place, node in enumerate(nodes):
        model.graph.node.insert(place, node)
    save(model, path)


def exchange_weights(graph: Path, old: Mapping[str, np.ndarray], new: Mapping[str, np.ndarray], out: Path) -> None:
    """Writes a graph with the weights `new` in place of those that it has by name, or transposed by value of `old`."""
    import onnx  # the package loads it only to write a graph

    model = onnx.load(graph)
    transposed = {weight.T.tobytes(): name for name, weight in old.items() if weight.ndim == 2}
    for constant in model.graph.initializer:
        value, name = onnx.numpy_helper.to_array(constant), constant.name.partition(".")[2]
        weight = new.get(name) if name in old else new.get(transposed.get(value.tobytes(), ""), np.empty((0, 0, 0))).T
        if weight is not None and weight.shape == value.shape:
            constant.CopyFrom(onnx.numpy_helper.from_array(np.ascontiguousarray(weight), constant.name))
    onnx.save(model, out)


def graph_difference(graph: TracedModule, path: Path, compare: Compare) -> float:
    """Of a written graph from its module, on inputs that it was not traced with."""
    feed = {name: np.asarray(value) for name, value in zip(graph.inputs, graph.checked, strict=True)}
    actual = OnnxGraph(path)(feed)
    with torch.no_grad():
        outputs = graph.module(*graph.checked)
    expected = [value.numpy() for value in (outputs if isinstance(outputs, tuple) else (outputs,))]
    return compare(actual, expected[: len(actual)])


def relative_difference(actual: list[np.ndarray], expected: list[np.ndarray]) -> float:
    """Largest difference over all outputs, relative to an output's largest value where that exceeds 1."""
    pairs = [(np.asarray(a, np.float64), np.asarray(b, np.float64)) for a, b in zip(actual, expected, strict=True)]
    return max(float(np.abs(a - b).max() / max(1.0, float(np.abs(b).max()))) for a, b in pairs)


def update_manifest(folder: Path, names: Iterable[str]) -> None:
    """Writes the hashes of these files of a folder into its manifest; other entries stay.

    Raises:
        InputError: the manifest that is there cannot be read, or the folder cannot be written.
    """
    path = folder / MANIFEST_NAME
    hashes = read_manifest(path) if path.is_file() else {}
    hashes |= {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}
    atomic_write_json(path, dict(sorted(hashes.items())))
