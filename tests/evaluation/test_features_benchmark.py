"""The benchmark of features: what it times and writes, with a stub in place of the real sets."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam_benchmarks.filters.speed import Timing
from sigmaslam_benchmarks.tracking import features
from sigmaslam_models.feature_network import FeatureNetwork


def test_costs_are_compared_round_by_round_with_the_reference():
    costs = [
        features.Cost("ours", Timing([0.01, 0.02, 0.03]), 0.125, 200_000, 1024),
        features.Cost("orb", Timing([0.02, 0.02, 0.02]), None, None, 1000),
    ]
    ours, orb = features.cost_rows(costs, "orb")
    assert ours == ["ours", "20.0 (15.0 - 25.0)", "x1.00 (0.50 - 1.50)", "1024", "125", "200,000"]
    assert orb == ["orb", "20.0 (20.0 - 20.0)", "1", "1000", "", ""]


@pytest.mark.long
def test_the_picture_is_the_same_every_time_and_has_keypoints_for_everyone():
    image = features.photograph_like((240, 320))
    np.testing.assert_array_equal(image, features.photograph_like((240, 320)))
    assert image.shape == (240, 320)
    assert image.dtype == np.uint8
    assert image.std() > 20
    costs = features.measure_costs(["sift", "orb"], 1)
    assert all(cost.keypoints > 500 for cost in costs)


def test_parameters_of_weights_and_graphs_are_counted(tmp_path: Path):
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    network = FeatureNetwork()
    save_file({k: v.contiguous() for k, v in network.state_dict().items()}, tmp_path / "w.safetensors")
    count = sum(p.numel() for p in network.parameters())
    assert features.count_parameters(str(tmp_path / "w.safetensors")) == count
    constants = [
        numpy_helper.from_array(np.zeros((3, 4), np.float32), "a"),
        numpy_helper.from_array(np.zeros(5, np.int64), "shape"),
    ]
    value = helper.make_tensor_value_info("b", TensorProto.FLOAT, (3, 4))
    graph = helper.make_graph([helper.make_node("Identity", ["a"], ["b"])], "g", [], [value], constants)
    onnx.save(helper.make_model(graph), tmp_path / "g.onnx")
    assert features.count_parameters(str(tmp_path / "g.onnx")) == 12
    assert features.count_parameters("orb") is None


@pytest.mark.long
def test_the_command_writes_costs_and_scores_and_keeps_notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    torch.manual_seed(0)
    weights, page = tmp_path / "ours.safetensors", tmp_path / "features.md"
    save_file({k: v.contiguous() for k, v in FeatureNetwork().state_dict().items()}, weights)
    page.write_text("old\n<!-- notes -->\nMine.\n")
    asked = []

    def stub(names, sets, data, note):
        asked.append((names, sets, data))
        return {name: {"boat": {"mma_1": 0.5}} for name in names}

    monkeypatch.setattr(features, "compare", stub)
    (tmp_path / "homography_boat").mkdir()
    arguments = ["benchmark", "features", "--out", str(page), "--data", str(tmp_path), "--weights", str(weights)]
    result = CliRunner().invoke(app, [*arguments, "--sets", "boat", "--rounds", "2"], catch_exceptions=False)
    assert result.exit_code == 0
    assert asked == [([str(weights), "sift", "orb"], ["boat"], tmp_path)]
    text = page.read_text()
    assert f"| {weights} | 50.0 |" in text
    assert "time / orb" in text
    assert json.loads(page.with_suffix(".json").read_text())["sift"] == {"boat": {"mma_1": 0.5}}
    assert "2 rounds" in text
    assert f"--weights {weights} --sets boat --rounds 2" in text
    assert text.endswith("<!-- notes -->\nMine.\n")
    assert "old" not in text


def test_an_extractor_given_twice_is_refused(tmp_path: Path):
    path = Path("a.onnx")
    with pytest.raises(InputError, match=r"given twice among a\.onnx"):
        features.write_features(tmp_path / "page.md", tmp_path, [path], [path], "command")
