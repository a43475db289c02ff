"""Where landmarks of a window should be seen."""

import numpy as np

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.geometry.se3 import se3_inverse


def landmark_places(window: KeyframeWindow) -> tuple[np.ndarray, np.ndarray]:
    """Of all landmarks where their keyframes see them without errors of the calibration, and points there, metres.

    Found once a solution. (L, 3) each; of what is behind the camera or far away the point means nothing.
    """
    key = window.posterior, window.landmarks.estimate
    if window.places is None or any(one is not other for one, other in zip(key, window.places, strict=False)):
        measured = window.as_calibrated(window.landmarks.estimate)
        near = measured[:, 2:] > 0.0
        window.places = *key, measured, window.camera.triangulate(np.where(near, measured, [0.0, 0.0, 1.0]))
    return window.places[2:]


def seen_from(window: KeyframeWindow, rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """(K, 3) (u, v, disparity) of landmarks as a pose (4, 4) sees them; NaN of those that are behind it or far away."""
    measured, points = landmark_places(window)
    T = (se3_inverse(pose) @ window.posterior.poses).take(window.landmarks.anchor[rows], axis=0)
    here = np.einsum("kij,kj->ki", T[:, :3, :3], points.take(rows, axis=0)) + T[:, :3, 3]
    front = (measured[rows, 2] > 0.0) & (here[:, 2] > 0.0)
    seen = window.camera.project(np.where(front[:, None], here, [0.0, 0.0, 1.0]))
    return np.where(front[:, None], seen, np.nan)


def seen_apart(window: KeyframeWindow, rows: np.ndarray, pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(K,) pixels between where two poses (4, 4) see landmarks; NaN of those that are behind one or far away."""
    here, there = (seen_from(window, rows, each)[:, :2] for each in (pose, other))
    return np.asarray(np.linalg.norm(here - there, axis=1))
