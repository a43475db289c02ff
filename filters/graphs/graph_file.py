"""Files of ONNX graphs."""

from __future__ import annotations

from pathlib import Path


def strip_origins(path: Path) -> None:
    """Takes out of a graph where in whose source each node came from: paths of a machine, and half of the file."""
    import onnx  # the package loads it only to write a graph

    model = onnx.load(path)
    for function in (model.graph, *model.functions):
        for node in function.node:
            del node.metadata_props[:]
            node.doc_string = ""
    del model.graph.metadata_props[:]
    onnx.save(model, path)
