"""What users see of a window: errors of the calibration are as large as the images show them to be.

Poses are estimated without: gates and weights that know of larger errors would move them.
"""

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.window_state import WindowState, scale_considered


def published_state(window: KeyframeWindow) -> WindowState:
    """The posterior with these errors."""
    if window.worse == 1.0:
        return window.posterior
    return scale_considered(window.posterior, considered_growth(window))


def considered_growth(window: KeyframeWindow) -> np.ndarray:
    """(15,) what columns of considered errors are multiplied by: those that images show by how much worse it is."""
    if window.worse == 1.0:
        return np.ones(len(ERRORS))
    whole, beside = window.calibration.sigma, window.corrected[1]
    usual = np.sqrt(np.maximum(whole**2 - beside**2, 0.0)) * np.where(np.isin(ERRORS, SHOWN), window.worse, 1.0)
    return np.where(whole > 0.0, np.hypot(usual, beside) / np.where(whole > 0.0, whole, 1.0), 1.0)
