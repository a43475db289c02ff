"""Graphs are made smaller without a change of any number."""

import numpy as np
import onnx_ir
import onnxruntime
import pytest
from onnx import parser

from sigmaslam_filters.graphs.graph_file import simplify

SMALL, NEAR_ONE = 8.2e-9, 1.0 + 1e-6


def graph(text: str) -> onnx_ir.Model:
    return onnx_ir.from_proto(parser.parse_model(f'<ir_version: 10, opset_import: ["" : 20]> {text}'))


def test_tiny_and_near_unit_constants_stay():
    """Which the exporter's own optimiser takes for 0 and 1."""
    model = graph(
        f"""agraph (double[n] x) => (double[n] y) {{
            small = Constant <value = double {{{SMALL!r}}}> ()
            near_one = Constant <value = double {{{NEAR_ONE!r}}}> ()
            a = Add (x, small)
            b = Mul (a, near_one)
            c = Sub (b, small)
            y = Div (c, near_one)
        }}"""
    )
    simplify(model)
    x = np.array([0.0, 1e-9, 0.5])
    session = onnxruntime.InferenceSession(onnx_ir.to_proto(model).SerializeToString())
    found = session.run(None, {"x": x})[0]
    np.testing.assert_array_equal(found, ((x + SMALL) * NEAR_ONE - SMALL) / NEAR_ONE)


def test_what_is_constant_unused_or_there_twice_goes():
    model = graph(
        """agraph (double[n] x) => (double[n] y) {
            two = Constant <value = double {2.0}> ()
            three = Constant <value = double {3.0}> ()
            six = Mul (two, three)
            unused = Sin (x)
            once = Mul (x, six)
            twice = Mul (x, six)
            y = Add (once, twice)
        }"""
    )
    simplify(model)
    assert sorted(node.op_type for node in model.graph) == ["Add", "Mul"]
    session = onnxruntime.InferenceSession(onnx_ir.to_proto(model).SerializeToString())
    assert session.run(None, {"x": np.array([0.5])})[0] == pytest.approx(6.0)
