"""The page of the graphs that ship, and the table beside it: what each takes and gives, read from the files."""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import onnx
import yaml

from sigmaslam.errors import InputError
from sigmaslam.files import csv_text
from sigmaslam_models.model_card import fill_template

PAGE_COMMAND = "sigmaslam train export --page docs/onnx.md"
_UNKNOWN = {"purpose": "No text yet: `models/sigmaslam_models/graph_texts.yaml`.", "meanings": {}}


@cache
def graph_texts() -> dict[str, dict[str, Any]]:
    """What the files cannot say, by graph: its `purpose`, and the `meanings` of inputs and outputs by name."""
    text = Path(__file__).with_name("graph_texts.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text)["graphs"])


def graph_page(folder: Path, command: str) -> tuple[str, str]:
    """Markdown page of all graphs in a folder, and the table (CSV) of their inputs and outputs.

    Args:
        folder: with .onnx files; those of which nothing is known here come last.
    Raises:
        InputError: there are none, or one cannot be read.
    """
    paths = {path.stem: path for path in sorted(folder.glob("*.onnx"))}
    if not paths:
        raise InputError(f"{folder} has no .onnx files: give the folder that `sigmaslam train export` wrote")
    names = [*(name for name in graph_texts() if name in paths), *(name for name in paths if name not in graph_texts())]
    graphs = [_describe(name, paths[name]) for name in names]
    rows = ((graph["name"], *row) for graph in graphs for row in graph["rows"])
    table = csv_text([("graph", "", "name", "type", "shape", "meaning"), *rows])
    return fill_template("onnx.md", command=command, graphs=graphs, table="onnx.csv"), table


def _describe(name: str, path: Path) -> dict[str, Any]:
    """What the template says of a graph."""
    model, text = _load(path), graph_texts().get(name, _UNKNOWN)
    return {
        "name": name,
        "opset": next(each.version for each in model.opset_import if each.domain == ""),
        "nodes": len(model.graph.node),
        "size": f"{path.stat().st_size / 1000:.0f}",
        "purpose": text["purpose"],
        "rows": list(_rows(model, text["meanings"])),
    }


def _rows(model: onnx.ModelProto, meanings: dict[str, str]) -> Iterator[tuple[str, ...]]:
    """Way, name, type, shape and meaning of inputs and outputs."""
    for way, values in (("in", model.graph.input), ("out", model.graph.output)):
        for value in values:
            tensor = value.type.tensor_type
            kind = onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type).name
            lengths = [_length(each) for each in tensor.shape.dim]
            shape = ", ".join(lengths) + ("," if len(lengths) == 1 else "")
            yield way, value.name, kind, f"({shape})", meanings.get(value.name, "")


def _length(dimension: onnx.TensorShapeProto.Dimension) -> str:
    """A length, or an expression of those that are free; N for what the exporter counts."""
    return re.sub(r"\bu\d+\b", "N", dimension.dim_param.replace("*", " ")) or str(dimension.dim_value)


def _load(path: Path) -> onnx.ModelProto:
    try:
        return onnx.load(path)
    except Exception as error:  # of the parser of protocol buffers, which raises its own
        raise InputError(f"{path} is no ONNX graph ({error}): export it again with `sigmaslam train export`") from error
