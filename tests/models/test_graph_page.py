"""The page of the graphs is that of the graphs that ship, and they are what torch computes."""

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam_models.graph_page import PAGE_COMMAND, graph_page, graph_texts
from sigmaslam_models.onnx_export import check_graphs

WEIGHTS = shipped_weights("features.onnx").parent
PAGE = Path(__file__).resolve().parents[2] / "docs" / "onnx.md"


def test_the_page_is_that_of_the_files_that_ship():
    page, table = graph_page(WEIGHTS, PAGE_COMMAND)
    assert PAGE.read_text() == page, f"run `{PAGE_COMMAND}`"
    assert PAGE.with_suffix(".csv").read_text() == table, f"run `{PAGE_COMMAND}`"


@pytest.mark.parametrize("path", sorted(WEIGHTS.glob("*.onnx")), ids=lambda path: path.stem)
def test_every_input_and_output_of_a_graph_has_its_meaning(path):
    graph = onnx.load(path).graph
    assert {each.name for each in [*graph.input, *graph.output]} <= graph_texts()[path.stem]["meanings"].keys()


def test_there_is_no_text_of_a_graph_that_does_not_ship():
    assert set(graph_texts()) == {path.stem for path in WEIGHTS.glob("*.onnx")}


@pytest.mark.long
def test_the_graphs_that_ship_are_what_torch_computes():
    differences = check_graphs(WEIGHTS)
    assert set(differences) == {path.stem for path in WEIGHTS.glob("*.onnx")}


def test_a_graph_that_computes_something_else_is_found(tmp_path):
    shutil.copy(WEIGHTS / "pose_predict.onnx", tmp_path)
    model = onnx.load(tmp_path / "pose_predict.onnx")
    changed = max((each for each in model.graph.initializer if each.data_type == 11), key=lambda each: len(each.dims))
    changed.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(changed) + np.float64(1e-3), changed.name))
    onnx.save(model, tmp_path / "pose_predict.onnx")
    with pytest.raises(SigmaSlamError, match=r"pose_predict\.onnx differs from torch by"):
        check_graphs(tmp_path)


def test_a_graph_that_nobody_knows_is_named(tmp_path):
    with pytest.raises(InputError, match=r"no \.onnx file"):
        check_graphs(tmp_path)
    shutil.copy(WEIGHTS / "verifier.onnx", tmp_path / "other.onnx")
    with pytest.raises(InputError, match=r"other\.onnx"):
        check_graphs(tmp_path)
    page, table = graph_page(tmp_path, "command")
    assert "| `other.onnx` |" in page
    assert "\nother,in,columns,float32," in table
