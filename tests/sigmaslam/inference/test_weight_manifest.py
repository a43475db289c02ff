"""Shipped graphs are the ones that were exported, or are refused by name; graphs without a manifest are the user's."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam.inference.weight_manifest import MANIFEST_NAME, check_weights, read_manifest
from sigmaslam_models.graph_export import update_manifest

GRAPH = "place_verifier.onnx"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Shipped graphs with their manifest."""
    for name in (GRAPH, "verifier.onnx", MANIFEST_NAME):
        shutil.copy(shipped_weights(name), tmp_path / name)
    return tmp_path


def test_the_manifest_is_of_the_shipped_files():
    """After an export into models/sigmaslam_weights: `update_manifest` has been called for what changed."""
    shipped = shipped_weights(MANIFEST_NAME)
    files = [path for path in shipped.parent.iterdir() if path.suffix in (".onnx", ".safetensors")]
    assert set(read_manifest(shipped)) == {path.name for path in files}
    for path in files:
        check_weights(path, path.read_bytes())


def test_a_changed_byte_is_refused_by_name(folder: Path):
    OnnxGraph(folder / GRAPH)
    content = bytearray((folder / GRAPH).read_bytes())
    content[len(content) // 2] ^= 1
    (folder / GRAPH).write_bytes(content)
    with pytest.raises(
        InputError, match=r"place_verifier\.onnx: is not the file.*SHA-256.*reinstall.*sigmaslam train export"
    ):
        OnnxGraph(folder / GRAPH)


def test_another_graph_under_the_name_is_refused(folder: Path):
    shutil.copy(folder / "verifier.onnx", folder / GRAPH)
    with pytest.raises(InputError, match=r"place_verifier\.onnx: is not the file that was exported"):
        OnnxGraph(folder / GRAPH)


def test_a_changed_shipped_graph_stops_the_front_end(folder: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copy(shipped_weights("verifier.onnx"), folder / "features.onnx")
    monkeypatch.setattr("sigmaslam.inference.networks.shipped_weights", lambda name: folder / name)
    with pytest.raises(InputError, match=r"features\.onnx: is not the file"):
        LearnedDetector(100)


def test_weights_of_torch_are_compared_as_well(folder: Path):
    from sigmaslam_models.network_export import load_verifier  # torch takes seconds to import

    content = bytearray(shipped_weights("verifier.safetensors").read_bytes())
    content[-1] ^= 1
    (folder / "verifier.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=r"verifier\.safetensors: is not the file"):
        load_verifier(folder / "verifier.safetensors")


def test_graphs_of_a_user_work_with_their_own_manifest_or_none(folder: Path):
    shutil.copy(folder / "verifier.onnx", folder / GRAPH)
    update_manifest(folder, [GRAPH])
    OnnxGraph(folder / GRAPH)
    assert read_manifest(folder / MANIFEST_NAME)["scorer.onnx"]  # other entries stay
    (folder / MANIFEST_NAME).unlink()
    OnnxGraph(folder / GRAPH)
    update_manifest(folder, [GRAPH])
    assert set(read_manifest(folder / MANIFEST_NAME)) == {GRAPH}


@pytest.mark.parametrize("content", ["[1]", '{"a": 1}', "{", "[" * 100_000, "\udcff"])
def test_a_broken_manifest_is_refused(folder: Path, content: str):
    (folder / MANIFEST_NAME).write_text(content, errors="surrogateescape")
    with pytest.raises(InputError, match=r"manifest\.json.*reinstall|manifest\.json.*is not text"):
        OnnxGraph(folder / GRAPH)


def test_a_graph_with_other_inputs_is_named_when_it_is_run(folder: Path):
    graph = OnnxGraph(folder / "verifier.onnx")
    with pytest.raises(InputError, match=r"verifier\.onnx: the graph does not take image.*reinstall"):
        graph({"image": np.zeros((1, 1, 96, 96), np.float32)})
