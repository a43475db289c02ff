"""Where landmarks of a window should be seen."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.geometry.se3 import se3_inverse


def seen_from(window: KeyframeWindow, rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(K, 3) (u, v, disparity) of landmarks as a pose (4, 4) sees them; NaN of those that are behind it or far away."""
    landmarks, camera = window.landmarks, window.camera
    measured = window.as_calibrated(landmarks.estimate[rows])
    near = measured[:, 2] > 0.0
    points = camera.triangulate(np.where(near[:, None], measured, [0.0, 0.0, 1.0]))
    T = (se3_inverse(pose) @ window.posterior.poses)[landmarks.anchor[rows]]
    here = np.einsum("kij,kj->ki", T[:, :3, :3], points) + T[:, :3, 3]
    front = near & (here[:, 2] > 0.0)
    seen = camera.project(np.where(front[:, None], here, [0.0, 0.0, 1.0]))
    return np.where(front[:, None], seen, np.nan)
