from pathlib import Path

import numpy as np
import pytest

from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam_models.estimator import estimator_export
from sigmaslam_models.estimator.estimator_export import estimator_graphs, export_estimator
from sigmaslam_models.estimator.graph_examples import condition_example, frame_example, window_example
from sigmaslam_models.torch_runtime import open_step

FRAME_STEPS = ("frame_predict", "frame_robust", "frame_gated")
WINDOW_STEPS = ("window_eliminate", "window_gate")
ESTIMATOR = ("pose_predict", "inertial_predict", *FRAME_STEPS, *WINDOW_STEPS, "window_condition")


def shipped(name: str) -> Path:
    path = shipped_weights(name)
    if not path.is_file():
        pytest.skip(f"{name} is not in models/sigmaslam_weights")
    return path


@pytest.mark.slow
def test_exported_estimator_equals_torch(tmp_path):
    differences = export_estimator(tmp_path)
    assert set(differences) == set(ESTIMATOR)
    assert max(differences.values()) < 1e-9
    assert_graphs_equal_torch(tmp_path)


@pytest.mark.parametrize("name", ESTIMATOR)
def test_shipped_estimator_equals_torch(name):
    shipped(f"{name}.onnx")
    assert_graphs_equal_torch(shipped(f"{name}.onnx").parent, (name,))


def assert_graphs_equal_torch(folder: Path, names: tuple[str, ...] = ESTIMATOR) -> None:
    """On states and numbers of keyframes, landmarks and views that the export neither traced nor checked."""
    graphs = estimator_graphs()
    for name in names:
        inputs = graphs[name].inputs
        if name in FRAME_STEPS:
            # Two views of one keyframe's landmarks, and a full window.
            examples = [
                frame_example(seed, *sizes, *inputs) for seed, sizes in ((5, (1, 2)), (6, (6, 211)), (7, (7, 40)))
            ]
        elif name in WINDOW_STEPS:
            examples = [window_example(seed, *sizes, *inputs) for seed, sizes in ((5, (2, 3)), (6, (7, 120)))]
        elif name == "window_condition":
            examples = [condition_example(5, 12, 1), condition_example(6, 54, 43)]
        elif name == "inertial_predict":
            examples = [estimator_export._inertial_example(seed) for seed in (5, 6)]
        else:
            examples = [estimator_export._predict_example(seed) for seed in (5, 6)]
        for example in examples:
            feed = {key: value.numpy() for key, value in zip(inputs, example, strict=True)}
            found, expected = OnnxGraph(folder / f"{name}.onnx")(feed), open_step(name)(feed)
            for a, b in zip(found, expected, strict=True):
                size = max(1.0, float(np.abs(b).max()))
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * size, err_msg=name)
