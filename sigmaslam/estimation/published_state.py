"""What users see of a window: errors of the calibration are as large as the images show them to be, and what neighbours
in the image share counts in all poses.

Poses are estimated without: gates and weights that know of larger errors would move them.
"""

from dataclasses import replace

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, SHOWN
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.window_state import WindowState, scale_considered, scale_variances


def with_shown_errors(window: KeyframeWindow) -> WindowState:
    """The posterior with errors of the calibration as large as images show, as a map keeps it for later runs."""
    return scale_considered(window.posterior, _considered_growth(window))


def published_state(window: KeyframeWindow) -> WindowState:
    """The same with what neighbours share."""
    given, last = (window.worse, window.clustering), window.published
    if last is None or last[0] is not window.posterior or last[1] != given:
        state = scale_variances(with_shown_errors(window), window.clustering)
        last = window.published = window.posterior, given, state
    return last[2]


def published_fit(window: KeyframeWindow, fit: FrameFit) -> FrameFit:
    """A frame's fit to the posterior as one to `published_state`."""
    factor, joint = window.clustering, fit.joint
    growth, sigma = _considered_growth(window), window.calibration.sigma
    for name, cause in window.foreseen.items():
        if sigma[k := ERRORS.index(name)] > 0.0:
            growth[k] = np.hypot(growth[k], np.sqrt(cause.probability * (cause.variance + cause.mean**2)) / sigma[k])
    published = replace(
        joint,
        covariance=factor * joint.covariance,
        common=joint.common * growth,
        information=joint.information / factor,
        score=joint.score / factor,
    )
    # Errors that the frame's own views share are in `fit.inflation`: once is enough.
    twice = min(factor, fit.inflation) - 1.0
    covariance = fit.covariance + published.covariance[-6:, -6:] - joint.covariance[-6:, -6:] - twice * joint.relative
    return replace(fit, covariance=covariance, joint=published)


def _considered_growth(window: KeyframeWindow) -> np.ndarray:
    """(15,) what columns of considered errors are multiplied by: those that images show by how much worse it is."""
    if window.worse == 1.0:
        return np.ones(len(ERRORS))
    whole, beside = window.calibration.sigma, window.corrected[1]
    usual = np.sqrt(np.maximum(whole**2 - beside**2, 0.0)) * np.where(np.isin(ERRORS, SHOWN), window.worse, 1.0)
    return np.where(whole > 0.0, np.hypot(usual, beside) / np.where(whole > 0.0, whole, 1.0), 1.0)
