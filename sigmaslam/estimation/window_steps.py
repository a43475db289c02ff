"""The solution of a window with compiled views: the twin of `sigmaslam_models.estimator.window_solution`."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.linearised_views import (
    UNKNOWN_VARIANCE,
    Feed,
    Slopes,
    chi_square,
    invert,
    linearise,
    student_weight,
    sum_by_landmark,
    weigh,
)
from sigmaslam.estimation.state_layout import MODELLED


def gate_window(feed: Feed) -> list[np.ndarray]:
    """As `window_solution.GateWindow`."""
    linear, stacked, components = _window_views(feed, all_count=True)
    residual = stacked[..., 24]
    return [linear.in_front & ((residual * residual).sum(axis=1) <= chi_square(CHI_SQUARE_999, components))]


def eliminate_landmarks(feed: Feed) -> list[np.ndarray]:
    """As `window_solution.EliminateLandmarks`."""
    linear, stacked, components = _window_views(feed, all_count=False)
    freedom = float(feed["freedom"])
    squared = (stacked[..., 24] * stacked[..., 24]).sum(axis=1)
    stacked = stacked * np.sqrt(student_weight(squared, components, freedom))[:, None, None]
    by_state = linear.by_state(stacked[..., :18], stacked[..., 18:24])
    size = by_state.shape[2]
    rows = np.concatenate([by_state, stacked[..., 24:]], axis=2)
    by_landmark = stacked[..., 18:24]
    sums = sum_by_landmark(by_landmark, rows, feed["owner"], len(feed["measured"]))
    departure = feed["measured"] - feed["estimate"]
    precision = _prior_precision(departure, feed["variance"], freedom)
    inverse = invert(sums[:, :, :6] + np.eye(6) * precision[:, None, :])
    sums = sums[:, :, 6:]
    sums[:, :, size] += departure * precision
    solved = inverse @ sums
    flat, each = rows.reshape(-1, size + 1), (-1, size + 1)
    whole = flat.T @ flat - sums.reshape(each).T @ solved.reshape(each)
    return [whole[:size, :size], whole[:size, size], inverse, -solved[:, :, :size], solved[:, :, size]]


def _window_views(feed: Feed, all_count: bool) -> tuple[Slopes, np.ndarray, np.ndarray]:
    """Linearised, and weighed: all, or those behind the camera with no weight."""
    landmarks, own = feed["estimate"][feed["owner"]], feed["covariance"][feed["owner"]]
    linear = linearise(feed, feed["poses"], feed["calibration"], feed["spread"], landmarks, own)
    linear.mean[:] += (feed["common"] @ landmarks[:, MODELLED:, None])[..., 0]
    noise = feed["noise"] + linear.nonlinearity
    if not all_count:
        noise[~linear.in_front] = UNKNOWN_VARIANCE * np.eye(3)
    return linear, *weigh(feed["measurement"], linear, noise)


def condition(feed: Feed) -> list[np.ndarray]:
    """As `window_solution.Condition`."""
    factor, information, common = feed["factor"], feed["information"], feed["common"]
    whole = np.eye(factor.shape[1]) + factor.T @ information @ factor
    covariance = factor @ invert((whole + whole.T) / 2.0) @ factor.T
    return [covariance @ feed["vector"], covariance, common - covariance @ (information @ common)]


def _prior_precision(departure: np.ndarray, variance: np.ndarray, freedom: float) -> np.ndarray:
    """(L, 6) precisions of landmarks as measured, as of `window_solution`."""
    precision = 1.0 / variance
    squared = departure * departure * precision
    precision[:, 3] *= student_weight(squared[:, 3], 1.0, freedom)
    precision[:, 4:] *= student_weight(squared[:, 4:].sum(axis=1), 2.0, freedom)[:, None]
    return precision
