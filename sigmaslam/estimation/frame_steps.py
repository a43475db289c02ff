"""The update of a frame, step by step, with compiled views: the twin of `sigmaslam_models.estimator.frame_update`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_MEDIAN
from sigmaslam.estimation.linearised_views import (
    UNKNOWN_VARIANCE,
    Feed,
    Slopes,
    chi_square,
    invert,
    linearise,
    student_weight,
    weigh,
)
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, LANDMARK_SIZE, MODELLED
from sigmaslam.geometry.se3 import se3_exp

ROBUST_SCALES = (6.0, 4.0, 3.0)
"""Of the loss by which a frame's pose is first found, standard deviations: it narrows."""
SCALE_RULES = ACCEPTANCE.scaled_agreement, ACCEPTANCE.max_noise_scale
"""By which the scatter of a frame's residuals is believed: `sigmaslam_filters.robust.common_scale`."""


def _linearise_frame(feed: Feed, offset: np.ndarray, spread: np.ndarray, moved: np.ndarray) -> Slopes:
    """As `FrameViews.linearise`; the mean is what the views see of landmarks that did not move."""
    poses = se3_exp(offset[CALIBRATION_SIZE:].reshape(-1, 6)) @ feed["poses"]
    shift = feed["dependence"].reshape(-1, len(offset)) @ offset
    landmarks = feed["estimate"] + shift.reshape(-1, LANDMARK_SIZE) + moved
    calibration = feed["calibration"] + offset[CALIBRATION]
    linear = linearise(feed, poses, calibration, spread, landmarks, feed["covariance"])
    expected = -moved
    expected[:, MODELLED:] += landmarks[:, MODELLED:]
    linear.mean[:] += (linear.by_landmark @ expected[..., None])[..., 0]
    return linear


@dataclass(frozen=True, slots=True)
class _Whitened:
    """As of `frame_update`, with derivatives by the state (M, 3, n), by landmark (M, 3, 6), by the prior (3 M, k)."""

    by_state: np.ndarray
    by_landmark: np.ndarray
    by_prior: np.ndarray
    beyond: np.ndarray
    residual: np.ndarray
    squared: np.ndarray
    components: np.ndarray
    usable: np.ndarray

    def solve(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean (k,) and covariance (k, k) of z ~ N(0, I) given the views, weighted (M,)."""
        weighted = self.by_prior * np.repeat(weight, 3)[:, None]
        inverse = invert(weighted.T @ self.by_prior + np.eye(self.by_prior.shape[1]))
        return inverse @ (weighted.T @ self.beyond), inverse

    def after(self, z: np.ndarray) -> np.ndarray:
        """Residuals (M, 3) after the step."""
        return (self.beyond - self.by_prior @ z).reshape(-1, 3)


def _whitened(feed: Feed) -> _Whitened:
    offset = feed["offset"]
    linear = _linearise_frame(feed, offset, feed["spread"], feed["moved"])
    noise = feed["noise"] + linear.nonlinearity + linear.through
    stacked, components = weigh(feed["measurement"], linear, noise)
    by_landmark, residual = stacked[..., 18:24], stacked[..., 24]
    by_state = linear.by_state(stacked[..., :18], by_landmark, feed["dependence"])
    squared = (residual * residual).sum(axis=1)
    rows = by_state.reshape(-1, len(offset))
    beyond = residual.ravel() + rows @ offset
    usable = linear.in_front & (squared < UNKNOWN_VARIANCE)
    return _Whitened(by_state, by_landmark, rows @ feed["factor"], beyond, residual, squared, components, usable)


def predict_views(feed: Feed) -> list[np.ndarray]:
    """As `frame_update.PredictViews`."""
    factor = feed["factor"]
    linear = _linearise_frame(feed, np.zeros(len(factor)), factor @ factor.T, np.zeros_like(feed["estimate"]))
    by_state = linear.by_state(linear.by_pair, linear.by_landmark, feed["dependence"])
    by_prior = (by_state.reshape(-1, len(factor)) @ factor).reshape(len(by_state), 3, -1)
    covariance = linear.nonlinearity + linear.through + by_prior @ by_prior.transpose(0, 2, 1)
    return [linear.mean, covariance, linear.in_front]


def robust_step(feed: Feed) -> list[np.ndarray]:
    """As `frame_update.RobustStep`."""
    seen, factor, scale = _whitened(feed), feed["factor"], float(feed["scale"])
    squared = seen.squared
    if feed["gated"] > 0.0:
        # About what the prior expects.
        slopes = seen.by_prior.reshape(-1, 3, factor.shape[1])
        innovation = slopes @ slopes.transpose(0, 2, 1) + np.eye(3)
        white = np.linalg.solve(np.linalg.cholesky(innovation), seen.residual[..., None])[..., 0]
        squared = (white * white).sum(axis=1)
    for limit in ROBUST_SCALES:
        loss = 1.0 + squared / (scale * limit**2)
        z, inverse = seen.solve(seen.usable / (loss * loss))
        after = seen.after(z)
        squared = (after * after).sum(axis=1)
    moved = _landmark_step(feed, seen, after)
    return [factor @ z, factor @ inverse @ factor.T, moved, np.array(float(seen.usable.sum()))]


def gated_step(feed: Feed) -> list[np.ndarray]:
    """As `frame_update.GatedStep`."""
    seen, factor, prior = _whitened(feed), feed["factor"], feed["prior"]
    median, largest = (chi_square(table, seen.components) for table in (CHI_SQUARE_MEDIAN, CHI_SQUARE_999))
    noise_scale = float(feed["noise_scale"])
    if noise_scale <= 0.0:
        noise_scale = _common_scale(seen.squared, median, largest, seen.usable)
    squared = seen.squared / noise_scale
    agree = seen.usable & (squared <= float(feed["scale"]) * largest)
    weight = agree * student_weight(squared, seen.components, float(feed["freedom"])) / noise_scale
    z, inverse = seen.solve(weight)
    posterior = factor @ inverse @ factor.T
    after = seen.after(z)
    weighted = (seen.by_state * weight[:, None, None]).reshape(-1, len(factor))
    information = weighted.T @ seen.by_state.reshape(-1, len(factor))
    scores = (weighted[:, -6:].reshape(-1, 3, 6) * after[..., None]).sum(axis=1)
    return [
        agree,
        np.array(float(agree.sum())),
        np.array(float(seen.usable.sum())),
        squared,
        np.array(noise_scale),
        factor @ z,
        posterior,
        _landmark_step(feed, seen, after / noise_scale),
        prior - posterior @ (information @ prior),
        information,
        scores,
        weighted.T @ after.ravel(),
        np.array(z @ z),
    ]


def _landmark_step(feed: Feed, seen: _Whitened, after: np.ndarray) -> np.ndarray:
    """(M, 6) how far the landmarks move for residuals (M, 3) after the state's step."""
    return (feed["covariance"] @ (seen.by_landmark.transpose(0, 2, 1) @ after[..., None]))[..., 0]


def _common_scale(distance: np.ndarray, median: np.ndarray, largest: np.ndarray, usable: np.ndarray) -> float:
    """As `sigmaslam_filters.robust.common_scale`, by the rules of acceptance."""
    if not usable.any():
        return 1.0
    ratio = (distance / median)[usable]
    factor, count = float(np.median(ratio)), len(ratio)
    scattered = (ratio > 1.0).sum() > 0.5 * count + 1.5 * np.sqrt(count)
    agreement, most = SCALE_RULES
    nearly_all = (distance <= factor * largest)[usable].sum() >= agreement * count
    return factor if scattered and factor <= most and nearly_all else 1.0
