"""Operators of ONNX Runtime that ONNX does not have, as the exporter takes them."""

from collections.abc import Callable
from typing import Any


def inverse_operator() -> Callable[..., Any]:
    """Translation of `torch.linalg.inv_ex` into `com.microsoft.Inverse`: of what it returns, the inverse alone."""
    import onnx  # the package loads it only to write a graph
    from onnxscript.values import Opset

    domain = "com.microsoft"
    if not onnx.defs.has("Inverse", domain):
        parameter = onnx.defs.OpSchema.FormalParameter
        schema = onnx.defs.OpSchema(
            "Inverse",
            domain,
            1,
            inputs=[parameter("X", "T")],
            outputs=[parameter("Y", "T")],
            type_constraints=[("T", ["tensor(float)", "tensor(double)"], "")],
        )
        onnx.defs.register_schema(schema)
    operators = Opset(domain, 1)

    def inverse(matrix: Any, check_errors: bool = False) -> tuple[Any, Any]:
        found = operators.Inverse(matrix)
        return found, found

    return inverse
