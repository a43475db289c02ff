"""Landmarks eliminated from the equations of the state, each by its own: Schur's complement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.landmark_table import LandmarkTable
from sigmaslam.estimation.robust import student_weight, whiten
from sigmaslam.estimation.sigma_point_linearisation import Linearisation
from sigmaslam.estimation.small_triangular import solve_lower
from sigmaslam.estimation.state_layout import LANDMARK_SIZE, MODELLED


@dataclass(frozen=True, slots=True)
class Elimination:
    """Landmarks given the state.

    Attributes:
        landmark: (K,) rows of the table.
        covariance: (K, 6, 6).
        dependence: (K, 6, n) how they move with the state.
        step: (K, 6) to their best places if the state stays.
    """

    landmark: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    step: np.ndarray


def eliminate_landmarks(
    landmarks: LandmarkTable,
    landmark: np.ndarray,
    linear: Linearisation,
    residual: np.ndarray,
    noise: np.ndarray,
    components: np.ndarray,
    student_freedom: float,
) -> tuple[np.ndarray, np.ndarray, Elimination]:
    """Information matrix (n, n) and vector (n,) of the state at the estimate, every landmark solved for it.

    Args:
        landmarks: the window's.
        landmark: (O,) row of the landmark that each view sees.
        linear: the views, linearised at the estimate.
        residual, noise: (O, 3), (O, 3, 3) of the views, which are weighted for tails longer than a Gaussian's.
        components: (O,) how many numbers each view measures.
        student_freedom: degrees of freedom of the errors' Student-t.
    """
    seen, owner = np.unique(landmark, return_inverse=True)
    size = linear.by_state.shape[2]
    stacked = np.concatenate([linear.by_state, linear.by_landmark, residual[..., None]], axis=2)
    whitened = whiten(stacked, noise).reshape(stacked.shape)
    weight = student_weight((whitened[:, :, -1] ** 2).sum(axis=1), components, student_freedom)
    whitened *= np.sqrt(weight)[:, None, None]
    by_state, by_landmark, residuals = whitened[:, :, :size], whitened[:, :, size:-1], whitened[:, :, -1:]
    products = by_landmark.transpose(0, 2, 1) @ np.concatenate([by_landmark, by_state, residuals], axis=2)
    order = np.argsort(owner, kind="stable")
    begins = np.searchsorted(owner[order], np.arange(len(seen)))
    sums = (
        np.add.reduceat(products[order], begins, axis=0)
        if len(seen)
        else np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE + size + 1))
    )
    departure = landmarks.measured[seen] - landmarks.estimate[seen]
    precision = _prior_precision(departure, landmarks.variance[seen], student_freedom)
    landmark_information = sums[:, :, :LANDMARK_SIZE] + np.eye(LANDMARK_SIZE) * precision[:, None, :]
    vector = sums[:, :, -1] + departure * precision
    lower = np.linalg.cholesky(landmark_information)
    reduced = solve_lower(lower, np.concatenate([sums[:, :, LANDMARK_SIZE:-1], vector[..., None]], axis=2))
    tall, flat = by_state.reshape(-1, size), reduced[:, :, :size].reshape(-1, size)
    information = tall.T @ tall - flat.T @ flat
    right = tall.T @ residuals.ravel() - flat.T @ reduced[:, :, -1].ravel()
    inverse = np.linalg.inv(landmark_information)
    step = (inverse @ vector[..., None])[..., 0]
    return information, right, Elimination(seen, inverse, -inverse @ sums[:, :, LANDMARK_SIZE:-1], step)


def _prior_precision(departure: np.ndarray, variance: np.ndarray, student_freedom: float) -> np.ndarray:
    """(K, 6) precisions of landmarks as measured, by how far (K, 6) their estimates are from there.

    What their views share has longer tails than a Gaussian's, too: a place where two surfaces meet in the image is
    wrong in all views alike.
    """
    precision = 1.0 / variance
    for shared in (slice(3, MODELLED), slice(MODELLED, LANDMARK_SIZE)):
        squared = (departure[:, shared] ** 2 * precision[:, shared]).sum(axis=1)
        precision[:, shared] *= student_weight(squared, np.array(shared.stop - shared.start), student_freedom)[:, None]
    return precision
