"""Noise of linear models by expectation maximisation; for any other model maximise the track's likelihood."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters.bayes import KalmanFilter
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.models import LinearMeasurement, LinearMotion


@dataclass(frozen=True, slots=True, eq=False)
class FittedNoise:
    """What `fit_noise` returns.

    Attributes:
        motion: with the process noise found.
        measurement: with the measurement noise found.
        log_likelihood: (K,) of the values before each step; it never falls.
    """

    motion: LinearMotion
    measurement: LinearMeasurement
    log_likelihood: Tensor


def fit_noise(
    belief: Gaussian, motion: LinearMotion, measurement: LinearMeasurement, values: Tensor, steps: int = 50
) -> FittedNoise:
    """Q and R, dense, that make measured sequences likelier (Shumway & Stoffer 1982), all other parts kept.

    Args:
        belief: at the time of the first measurement, before it; batch (...,).
        motion: without input, and with noise that is not B2 w; its noise is the start.
        measurement: its noise is the start.
        values: (T, ..., m) with T > 1, sequences (...,) of one noise; NaN where nothing was measured at a time.
        steps: of expectation maximisation.
    Raises:
        ValueError: a time is measured in part, or the motion has a noise matrix.
    """
    if motion.noise_matrix is not None or motion.control_matrix is not None:
        raise ValueError("noise is fitted to a LinearMotion without noise_matrix and control_matrix")
    missing = torch.isnan(values)
    measured = ~missing.any(dim=-1)
    if bool((missing.any(dim=-1) & ~missing.all(dim=-1)).any()):
        raise ValueError("a value with some components missing: fit_noise takes times that are measured or not at all")
    likelihood, kalman = [], KalmanFilter()
    for _ in range(steps):
        track = kalman.filter(belief, motion, measurement, values)
        likelihood.append(track.log_likelihood.sum().detach())
        smoothed = kalman.smooth(track)
        filtered, A, H = track.filtered.covariance[:-1], motion.matrix, measurement.matrix
        predicted = track.predicted.covariance[1:]
        gain = torch.linalg.solve(predicted, A @ filtered).mT
        later, earlier = smoothed.covariance[1:], smoothed.covariance[:-1]
        cross = later @ gain.mT @ A.mT  # of x' and A x
        move = (smoothed.mean[1:] - smoothed.mean[:-1] @ A.mT).unsqueeze(-1)
        Q = move @ move.mT + later - cross - cross.mT + A @ earlier @ A.mT
        left = torch.where(measured.unsqueeze(-1), values - smoothed.mean @ H.mT, 0.0).unsqueeze(-1)
        R = left @ left.mT + H @ smoothed.covariance @ H.mT
        R = torch.where(measured[..., None, None], R, 0.0)
        Q, R = Q.flatten(0, -3).mean(dim=0), R.flatten(0, -3).sum(dim=0) / measured.sum()
        motion = replace(motion, noise=0.5 * (Q + Q.mT))
        measurement = replace(measurement, noise=0.5 * (R + R.mT))
    return FittedNoise(motion, measurement, torch.stack(likelihood))
