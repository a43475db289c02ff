"""The estimator's equations as graphs: the torch modules of `sigmaslam_models.estimator`, exported."""

from __future__ import annotations

import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.inference.backends import load_step


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
        self.predict_views = load_step("frame_predict", backend)
        self.robust_step = load_step("frame_robust", backend)
        self.gated_step = load_step("frame_gated", backend)
        self.eliminate_landmarks = load_step("window_eliminate", backend)
        self.gate_window = load_step("window_gate", backend)
        self.condition = load_step("window_condition", backend)
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline])
        self._unscented = np.array(float(unscented))

    def constants(self, depth: float) -> dict[str, np.ndarray]:
        """The inputs that all of them begin with, for a depth of the scene, metres."""
        return {"intrinsics": self._intrinsics, "depth": np.array(depth, float), "unscented": self._unscented}
