"""The estimator's equations: the torch modules of `sigmaslam_models.estimator`, compiled or exported as graphs."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.frame_steps import gated_step, predict_views, robust_step
from sigmaslam.estimation.linearised_views import IS_COMPILED
from sigmaslam.estimation.window_steps import condition, eliminate_landmarks, gate_window
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.inference.backends import ONNX, load_step
from sigmaslam.inference.onnx_graph import Step

COMPILED: dict[str, Step] = {
    "frame_predict": predict_views,
    "frame_robust": robust_step,
    "frame_gated": gated_step,
    "window_eliminate": eliminate_landmarks,
    "window_gate": gate_window,
    "window_condition": condition,
}
"""Steps by the names of the graphs that they stand for."""


class EstimatorGraphs:
    """The steps that a frame's update and a window's solution are made of.

    Args:
        camera: the rectified pair.
        backend: "onnx" or "torch".
        unscented: linearise by sigma points; else by first derivatives.

    Attributes:
        predict_views, robust_step, gated_step: of a frame, see `sigmaslam_models.estimator.frame_update`.
        eliminate_landmarks, gate_window, condition: of a window, see `sigmaslam_models.estimator.window_solution`.
    """

    def __init__(self, camera: RectifiedStereo, backend: str, unscented: bool) -> None:
        # Graphs are the reference, and serve where nothing is compiled or another back end is asked for.
        is_compiled = IS_COMPILED and backend == ONNX and unscented
        (
            self.predict_views,
            self.robust_step,
            self.gated_step,
            self.eliminate_landmarks,
            self.gate_window,
            self.condition,
        ) = (step if is_compiled else load_step(name, backend) for name, step in COMPILED.items())
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline])
        self._unscented = np.array(float(unscented))

    def constants(self, depth: float) -> dict[str, np.ndarray]:
        """The inputs that all of them begin with, for a depth of the scene, metres."""
        return {"intrinsics": self._intrinsics, "depth": np.array(depth, float), "unscented": self._unscented}
