"""Files of ONNX graphs."""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import onnx_ir


def simplify(model: "onnx_ir.Model") -> None:
    """Folds constants and takes out what is unused or there twice, in place, without a change of any number.

    `torch.onnx.export(optimize=True)` also drops sums with a constant below 1e-8 in size and products with one within
    1e-5 of 1, in float64 too, as if they were 0 and 1.
    """
    from onnx_ir.passes import common  # these two only to write a graph
    from onnxscript import optimizer

    optimizer.inline(model)
    optimizer.fold_constants(model)
    common.RemoveUnusedNodesPass()(model)
    common.RemoveUnusedOpsetsPass()(model)
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(model)
    common.DeduplicateInitializersPass()(model)
    common.CommonSubexpressionEliminationPass()(model)
    common.NameFixPass()(model)


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
