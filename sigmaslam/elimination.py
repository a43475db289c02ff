"""Landmarks eliminated from the equations of the state, each by its own: Schur's complement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.linearise import Slopes
from sigmaslam.residuals import student_weight, whiten
from sigmaslam.tables import LANDMARK_SIZE, MODELLED, Landmarks


@dataclass(frozen=True, slots=True)
class Elimination:
    """Landmarks given the state.

    Attributes:
        rows: (K,) which.
        covariance: (K, 6, 6).
        dependence: (K, 6, n) how they move with the state.
        step: (K, 6) to their best places if the state stays.
    """

    rows: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    step: np.ndarray


def eliminate_landmarks(
    landmarks: Landmarks,
    landmark: np.ndarray,
    slopes: Slopes,
    residual: np.ndarray,
    noise: np.ndarray,
    components: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, Elimination]:
    """Information matrix (n, n) and vector (n,) of the state at the estimate, every landmark solved for it.

    Args:
        landmarks: the window's.
        landmark: (O,) row of the landmark that each view sees.
        slopes: of the views at the estimate.
        residual, noise: (O, 3), (O, 3, 3) of the views, which are weighted for tails longer than a Gaussian's.
        components: (O,) how many numbers each view measures.
    """
    seen, owner = np.unique(landmark, return_inverse=True)
    size = slopes.by_state.shape[2]
    stacked = np.concatenate([slopes.by_state, slopes.by_landmark, residual[..., None]], axis=2)
    whitened = whiten(stacked, noise).reshape(stacked.shape)
    weight = student_weight((whitened[:, :, -1] ** 2).sum(axis=1), components)
    whitened *= np.sqrt(weight)[:, None, None]
    by_state, by_landmark, rest = whitened[:, :, :size], whitened[:, :, size:-1], whitened[:, :, -1:]
    products = by_landmark.transpose(0, 2, 1) @ np.concatenate([by_landmark, by_state, rest], axis=2)
    order = np.argsort(owner, kind="stable")
    begins = np.searchsorted(owner[order], np.arange(len(seen)))
    sums = (
        np.add.reduceat(products[order], begins, axis=0)
        if len(seen)
        else np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE + size + 1))
    )
    apart = landmarks.measured[seen] - landmarks.estimate[seen]
    precision = _prior_precision(apart, landmarks.variance[seen])
    own = sums[:, :, :LANDMARK_SIZE] + np.eye(LANDMARK_SIZE) * precision[:, None, :]
    vector = sums[:, :, -1] + apart * precision
    lower = np.linalg.cholesky(own)
    reduced = np.linalg.solve(lower, np.concatenate([sums[:, :, LANDMARK_SIZE:-1], vector[..., None]], axis=2))
    tall, flat = by_state.reshape(-1, size), reduced[:, :, :size].reshape(-1, size)
    information = tall.T @ tall - flat.T @ flat
    right = tall.T @ rest.ravel() - flat.T @ reduced[:, :, -1].ravel()
    inverse = np.linalg.inv(own)
    step = (inverse @ vector[..., None])[..., 0]
    return information, right, Elimination(seen, inverse, -inverse @ sums[:, :, LANDMARK_SIZE:-1], step)


def _prior_precision(apart: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """(K, 6) precisions of landmarks as measured, from estimates (K, 6) that far from there.

    What their views share has longer tails than a Gaussian's, too: a place where two surfaces meet in the image is
    wrong in all views alike.
    """
    precision = 1.0 / variance
    for shared in (slice(3, MODELLED), slice(MODELLED, LANDMARK_SIZE)):
        squared = (apart[:, shared] ** 2 * precision[:, shared]).sum(axis=1)
        precision[:, shared] *= student_weight(squared, np.array(shared.stop - shared.start))[:, None]
    return precision
