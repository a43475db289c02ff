"""The estimator's equations: the torch modules of `sigmaslam_models.estimator`, compiled or exported as graphs."""

from typing import cast

import numpy as np

from sigmaslam.compiled import open_compiled, tell_slow
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.inference.backends import ONNX, load_step
from sigmaslam.inference.onnx_graph import Step

_compiled = open_compiled("estimation._estimator")


class EstimatorGraphs:
    """The steps that a frame's update and a window's solution are made of.

    Args:
        backend: "onnx", of which what is compiled takes the place; or "torch".
        unscented: linearise by sigma points; else by first derivatives.

    Attributes:
        predict_views, robust_step, gated_step: of a frame, see `sigmaslam_models.estimator.frame_update`.
        is_compiled: these take `rows` of the dependence, too, and the gated one `inliers`, which it stops to confirm.
        eliminate_landmarks, gate_window, condition: of a window, see `sigmaslam_models.estimator.window_solution`.
    """

    def __init__(self, camera: RectifiedStereo, backend: str, unscented: bool) -> None:
        self.predict_views = open_step("frame_predict", backend)
        self.robust_step = open_step("frame_robust", backend)
        self.gated_step = open_step("frame_gated", backend)
        self.is_compiled = self.gated_step is getattr(_compiled, "frame_gated", None)
        self.eliminate_landmarks = open_step("window_eliminate", backend)
        self.gate_window = open_step("window_gate", backend)
        self.condition = open_step("window_condition", backend)
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline])
        self._unscented = np.array(float(unscented))

    def constants(self, depth: float) -> dict[str, np.ndarray]:
        """The inputs that all of them begin with, for a depth of the scene, metres."""
        return {"intrinsics": self._intrinsics, "depth": np.array(depth, float), "unscented": self._unscented}


def open_step(name: str, backend: str = ONNX) -> Step:
    """A step by its graph's name: compiled where that is faster, else the graph."""
    if backend != ONNX:
        return load_step(name, backend)
    if _compiled is None or not _compiled.FAST:
        tell_slow("poses are estimated by graphs, which takes four times longer")
        return load_step(name)
    return cast(Step, getattr(_compiled, name))
