"""The tracker's estimator as ONNX graphs: its modules, with examples of what they are called with."""

from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from sigmaslam_filters.manifolds.se3_matrices import exp_se3
from sigmaslam_models.estimator.frame_update import FrameViews, GatedStep, PredictViews, RobustStep
from sigmaslam_models.estimator.graph_examples import (
    GATED_INPUTS,
    GATED_OUTPUTS,
    PREDICTED,
    ROBUST_INPUTS,
    ROBUST_OUTPUTS,
    WINDOW_INPUTS,
    WINDOW_OUTPUTS,
    condition_example,
    frame_axes,
    frame_example,
    window_axes,
    window_example,
)
from sigmaslam_models.estimator.inertial_prediction import STATE_SIZE as INERTIAL_SIZE
from sigmaslam_models.estimator.inertial_prediction import InertialPredict
from sigmaslam_models.estimator.pose_prediction import STATE_SIZE, Predict
from sigmaslam_models.estimator.window_solution import Condition, EliminateLandmarks, GateWindow, WindowViews
from sigmaslam_models.graph_export import TracedModule, export_graph, update_manifest

# ONNX Runtime and torch may order sums differently; more than this is a wrong graph.
ESTIMATOR_TOLERANCE = 1e-9


def export_estimator(folder: Path) -> dict[str, float]:
    """Writes the estimator's graphs and returns the largest difference of each from torch."""
    differences = {
        name: export_graph(graph, folder / f"{name}.onnx", ESTIMATOR_TOLERANCE)
        for name, graph in estimator_graphs().items()
    }
    update_manifest(folder, [f"{name}.onnx" for name in differences])
    return differences


def estimator_graphs() -> dict[str, TracedModule]:
    """All of them, by name."""
    fixed: dict[int, Any] = {}
    state, columns = (torch.export.Dim(name, min=1, max=10_000) for name in ("state", "columns"))
    return {
        "pose_predict": TracedModule(
            Predict(),
            _predict_example(0),
            _predict_example(1),
            ["pose", "twist", "covariance", "step", "densities"],
            ["predicted_pose", "predicted_covariance"],
            (fixed,) * 5,
        ),
        "inertial_predict": TracedModule(
            InertialPredict(),
            _inertial_example(0),
            _inertial_example(1),
            [
                *("pose", "velocity", "gravity", "mounting", "root", "seconds", "turn", "velocity_change"),
                *("position_change", "slope", "noise", "walk"),
            ],
            ["predicted_pose", "predicted_velocity", "predicted_covariance", "carried"],
            (fixed,) * 12,
        ),
        "frame_predict": _step_graph(PredictViews(), (), PREDICTED, of_frame=True),
        "frame_robust": _step_graph(RobustStep(), ROBUST_INPUTS, ROBUST_OUTPUTS, of_frame=True),
        "frame_gated": _step_graph(GatedStep(), GATED_INPUTS, GATED_OUTPUTS, of_frame=True),
        "window_eliminate": _step_graph(EliminateLandmarks(), WINDOW_INPUTS, WINDOW_OUTPUTS, of_frame=False),
        "window_gate": _step_graph(GateWindow(), (), ("agree",), of_frame=False),
        "window_condition": TracedModule(
            Condition(),
            condition_example(0, 18, 7),
            condition_example(1, 30, 25),
            ["factor", "information", "vector", "common"],
            ["mean", "covariance", "common_after"],
            ({0: state, 1: columns}, {0: state, 1: state}, {0: state}, {0: state}),
        ),
    }


def _step_graph(
    module: nn.Module, inputs: tuple[str, ...], outputs: tuple[str, ...], *, of_frame: bool
) -> TracedModule:
    """A step of a frame's update, or of a window's solution, with inputs of its own before the fields of its views."""
    fields = FrameViews._fields if of_frame else WindowViews._fields
    example, axes_of = (frame_example, frame_axes) if of_frame else (window_example, window_axes)
    sizes = ((3, 40), (5, 77)) if of_frame else ((4, 30), (5, 50))
    traced, checked = (example(seed, *size, *inputs, *fields) for seed, size in enumerate(sizes))
    axes = (*axes_of(*inputs), axes_of(*fields))
    return TracedModule(module, traced, checked, [*inputs, *fields], list(outputs), axes)


def _predict_example(seed: int) -> tuple[Tensor, ...]:
    random = partial(torch.randn, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    root = 0.004 * random(STATE_SIZE, STATE_SIZE)
    densities = 0.1 + random(2).abs()
    step = torch.tensor(0.1 + 0.2 * seed, dtype=torch.float64)
    return exp_se3(0.3 * random(6)), random(6), root @ root.T, step, densities


def _inertial_example(seed: int) -> tuple[Tensor, ...]:
    random = partial(torch.randn, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    root, noise = 0.004 * random(INERTIAL_SIZE, INERTIAL_SIZE), 0.001 * random(9, 9)
    pose, mounting, turn = (exp_se3(0.3 * random(6)) for _ in range(3))
    seconds = torch.tensor(0.1 + 0.2 * seed, dtype=torch.float64)
    state = pose, random(3), 9.8 * random(3), mounting, root, seconds
    return *state, turn[:3, :3], random(3), random(3), random(9, 25), noise @ noise.T, 0.01 + random(2).abs()
