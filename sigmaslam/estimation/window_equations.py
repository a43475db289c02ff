"""The equations of a window of keyframes, as its graphs take them."""

from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.estimation.landmark_table import KeyframeViews
from sigmaslam.table import distinct

if TYPE_CHECKING:
    from sigmaslam.estimation.keyframe_window import KeyframeWindow


def eliminate_landmarks(
    window: "KeyframeWindow", observations: KeyframeViews
) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
    """Information matrix and vector of the state at the posterior, every landmark's own equations solved for it.

    Returns:
        Both, and of the landmarks (K,) that are seen: their rows; covariance, dependence on the state, and step to
        their best places if it stays, or nothing where there are none.
    """
    size = len(window.posterior.covariance)
    rows, owner = distinct(observations.views.landmark)
    if not len(rows):  # the graph takes no empty batch
        return np.zeros((size, size)), np.zeros(size), rows, []
    landmarks, freedom = window.landmarks, np.array(window.student_freedom)
    own = {"measured": landmarks.measured[rows], "variance": landmarks.variance[rows], "freedom": freedom}
    feed = {**own, **_views(window, observations, rows, owner)}
    information, vector, *eliminated = window.graphs.eliminate_landmarks(feed)
    return information, vector, rows, eliminated


def gate_views(window: "KeyframeWindow", observations: KeyframeViews) -> np.ndarray:
    """(O,) bool: which views fit the posterior (99.9 %)."""
    rows, owner = distinct(observations.views.landmark)
    if not len(rows):
        return np.zeros(0, bool)
    return window.graphs.gate_window(_views(window, observations, rows, owner))[0]


def _views(
    window: "KeyframeWindow", observations: KeyframeViews, rows: np.ndarray, owner: np.ndarray
) -> dict[str, np.ndarray]:
    """The fields of `sigmaslam_models.estimator.window_solution.WindowViews`.

    View o of O sees the landmark in row `rows[owner[o]]` (K,) of the landmark table.
    """
    state, landmarks, views = window.posterior, window.landmarks, observations.views
    pairs, pair = distinct(landmarks.anchor[views.landmark] * len(state) + observations.keyframe)
    return {
        **window.graphs.constants(window.depth),
        "anchors": pairs // len(state),
        "views": pairs % len(state),
        "pair": pair,
        "common": views.common,
        "owner": owner,
        "estimate": landmarks.estimate[rows],
        "covariance": landmarks.covariance[rows],
        "poses": state.poses,
        "calibration": state.calibration,
        "spread": state.covariance,
        "measurement": views.measurement,
        "noise": views.noise,
    }
