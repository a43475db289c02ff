"""The fundamental matrix of two views, epipoles and epipolar lines (9.31)-(9.33)."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.frontend.epipolar_search import normalised
from sigmaslam.geometry.se3 import rotation_exp, skew
from sigmaslam.two_view.epipolar import MatchedRays, neighbours_factor, robust_weight

# Degrees of freedom of F, and matches that the 8-point method takes.
_SEVEN, _EIGHT = 7, 8
# What is more likely wrong than right has no vote.
_MIN_PROBABILITY = 0.5
# The sampling consensus accepts this epipolar distance, pixels, and draws as many samples as it needs, up to what 63 %
# of wrong matches take.
_THRESHOLD, _SAMPLES = 1.0, 10_000
# Gauss-Newton stops after so many steps, or at one below this, radians: far less than matches can tell.
_ITERATIONS, _CONVERGED = 20, 1e-9
# An inlier is nearer than so many standard deviations.
_INLIER = 3.0
# F has rank 2: its third singular value is rounding, relative to the first.
_RANK = 1e-9
# Beyond this condition number the matches leave something free.
_MAX_CONDITION = 1e14


@dataclass(frozen=True, slots=True)
class FundamentalMatrix:
    """F with p1^T F p0 = 0 for homogeneous pixels of the same point.

    Attributes:
        F: (3, 3) of rank 2 and norm 1.
        covariance: (9, 9) of its entries row by row, from the inliers' noise and what neighbours' errors have in
            common, of rank 7; infinite where they leave it free.
        inliers: (M,) bool, probable matches within three standard deviations of their epipolar lines.
    """

    F: np.ndarray
    covariance: np.ndarray
    inliers: np.ndarray


def estimate_fundamental(
    points0: np.ndarray, points1: np.ndarray, probability: np.ndarray, covariance: np.ndarray, sigma0: float = 0.1
) -> FundamentalMatrix | None:
    """F that matches agree on, each weighted by its probability and covariance.

    A sampling consensus (OpenCV's USAC_ACCURATE) starts Gauss-Newton on the seven degrees of freedom, turns of U and V
    and the ratio of the singular values (Bartoli and Sturm 2004), with Sampson's error over its standard deviation:
    first with Geman and McClure's loss, then by the inliers alone.

    Args:
        points0, points1, probability, covariance: as of `estimate_epipolar_pose`.
        sigma0: standard deviation of points0, each coordinate, pixels.
    Returns:
        None with fewer than eight probable matches, or where the consensus fails.
    """
    probable = np.flatnonzero(probability >= _MIN_PROBABILITY)
    if len(probable) < _EIGHT:
        return None
    points0, points1 = points0.astype(np.float64), points1.astype(np.float64)
    both = points0[probable], points1[probable]
    try:
        start, _ = cv2.findFundamentalMat(*both, cv2.USAC_ACCURATE, _THRESHOLD, 0.999, _SAMPLES)
    except cv2.error:  # an assertion of OpenCV 5.0, for few sets of points
        return None
    # OpenCV returns None on failure, although its type hints exclude None.
    if np.shape(start) != (3, 3):
        return None
    # Pixels are scaled alike in both images, so that F is well conditioned and residuals keep their meaning.
    (to0, scaled0), (to1, scaled1) = normalised(points0), normalised(points1)
    spread0 = (sigma0 * to0[0, 0]) ** 2 * np.eye(2)
    matches = MatchedRays(scaled0, scaled1, spread0, to1[0, 0] ** 2 * covariance.astype(np.float64))
    u, values, vt = np.linalg.svd(np.linalg.inv(to1).T @ start @ np.linalg.inv(to0))
    v, angle = vt.T, float(np.arctan2(values[1], values[0]))
    u, angle, v = _refine(matches, u, angle, v, lambda residual: probability * robust_weight(residual))
    # The robust loss wastes a part of good matches: the inliers alone, equally weighted, are used in full.
    near = (np.abs(_slopes(matches, u, angle, v)[0]) < _INLIER) & (probability >= _MIN_PROBABILITY)
    u, angle, v = _refine(matches, u, angle, v, lambda residual: near.astype(float))
    residual, J = _slopes(matches, u, angle, v)
    inliers = (np.abs(residual) < _INLIER) & (probability >= _MIN_PROBABILITY)
    by_step = np.stack([each.ravel() for each in _directions(u, angle, v)], axis=1)
    information = J[inliers].T @ J[inliers]
    if inliers.sum() <= _SEVEN or np.linalg.cond(information) > _MAX_CONDITION:
        spread = np.full((7, 7), np.inf)
    else:
        # Matches are not taken to be better than they say, and may err as their neighbours do.
        scale = max(1.0, float((residual[inliers] ** 2).sum()) / (inliers.sum() - _SEVEN))
        factor = neighbours_factor(points0, np.where(inliers[:, None], J * residual[:, None], 0.0), information)
        spread = scale * factor * np.linalg.inv(information)
    return _in_pixels(_compose(u, angle, v), by_step, spread, to0, to1, inliers)


def epipoles(F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each image sees the other camera's centre: homogeneous pixels (3,) of norm 1, F e0 = 0 and F^T e1 = 0."""
    u, _, vt = np.linalg.svd(F)
    return vt[2], u[:, 2]


def uncertain_epipoles(fundamental: FundamentalMatrix) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """The epipoles of both images as of `epipoles`, each with its covariance (3, 3) of rank 2.

    To first order, F e = 0 gives de = -F^+ dF e (Papadopoulo and Lourakis 2000 propagate it likewise).
    """
    found = []
    for F, epipole, transposed in zip(
        (fundamental.F, fundamental.F.T), epipoles(fundamental.F), (False, True), strict=True
    ):
        entries = fundamental.covariance.reshape(3, 3, 3, 3)
        entries = entries.transpose(1, 0, 3, 2) if transposed else entries
        finite = bool(np.isfinite(entries).all())
        spread = np.einsum("ijkl,j,l->ik", entries, epipole, epipole) if finite else np.full((3, 3), np.inf)
        inverse = np.linalg.pinv(F, rcond=_RANK)
        found.append((epipole, inverse @ spread @ inverse.T if finite else spread))
    return tuple(found)


def describe_epipole(epipole: np.ndarray, covariance: np.ndarray, size: tuple[int, int]) -> str:
    """Where an epipole (3,) with that covariance (3, 3) is: a place if it is finite by far, else a direction.

    Args:
        epipole, covariance: as of `uncertain_epipoles`.
        size: of the image, width and height, pixels.
    """
    if not np.isfinite(covariance).all():
        return "at an unknown place"
    if abs(epipole[2]) > _INLIER * np.sqrt(covariance[2, 2]):
        place = epipole[:2] / epipole[2]
        J = np.column_stack([np.eye(2), -place]) / epipole[2]
        small, large = np.sqrt(np.maximum(np.linalg.eigvalsh(J @ covariance @ J.T), 0.0))
        return f"at ({place[0]:.0f}, {place[1]:.0f}) px, sigma {large:.2g} and {small:.2g} px across"
    # The line through the middle of the image to a place that may be at infinity.
    middle = 0.5 * np.array(size)
    x, y = epipole[:2] - middle * epipole[2]
    J = np.array([-y, x]) @ np.column_stack([np.eye(2), -middle]) / (x * x + y * y)
    angle = np.degrees(np.arctan2(y, x)) % 180.0
    sigma = np.degrees(np.sqrt(J @ covariance @ J))
    return f"far away along {angle:.1f} deg from the u axis to the v axis, sigma {sigma:.2g} deg"


def epipolar_lines(F: np.ndarray, points0: np.ndarray) -> np.ndarray:
    """Lines (M, 3) a u + b v + c = 0 in image 1 on which points (M, 2) of image 0 lie; a^2 + b^2 = 1.

    F transposed takes points of image 1 to lines in image 0.
    """
    lines = np.column_stack([points0, np.ones(len(points0))]) @ F.T
    return np.asarray(lines / np.linalg.norm(lines[:, :2], axis=1, keepdims=True))


def _refine(
    matches: MatchedRays, u: np.ndarray, angle: float, v: np.ndarray, weigh: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, float, np.ndarray]:
    """Gauss-Newton from F = U diag(cos, sin, 0) V^T; `weigh` gives weights of whitened residuals (M,)."""
    for _ in range(_ITERATIONS):
        residual, J = _slopes(matches, u, angle, v)
        weighted = J * weigh(residual)[:, None]
        normal = weighted.T @ J
        step = -np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(7), weighted.T @ residual)
        u, v, angle = u @ rotation_exp(step[:3]), v @ rotation_exp(step[3:6]), angle + float(step[6])
        if np.abs(step).max() < _CONVERGED:
            break
    return u, angle, v


def _compose(u: np.ndarray, angle: float, v: np.ndarray) -> np.ndarray:
    return np.asarray((u * [np.cos(angle), np.sin(angle), 0.0]) @ v.T)


def _directions(u: np.ndarray, angle: float, v: np.ndarray) -> np.ndarray:
    """(7, 3, 3) derivatives of F by the turns of U and V and by the angle."""
    S = np.diag([np.cos(angle), np.sin(angle), 0.0])
    turns = skew(np.eye(3))
    by_angle = np.diag([-np.sin(angle), np.cos(angle), 0.0])
    return np.asarray(u @ np.concatenate([turns @ S, -S @ turns, by_angle[None]]) @ v.T)


def _slopes(matches: MatchedRays, u: np.ndarray, angle: float, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whitened residuals (M,) and derivatives (M, 7), also of the deviations that whiten."""
    F = _compose(u, angle, v)
    residual, sigma = matches.whitened(F)
    D = _directions(u, angle, v)
    by1, by0 = matches.rays0 @ D.transpose(0, 2, 1), matches.rays1 @ D
    J = (by1 * matches.rays1).sum(axis=2)
    slope1 = np.einsum("mij,mj->mi", matches.spread1, (matches.rays0 @ F.T)[:, :2])
    slope0 = (matches.rays1 @ F)[:, :2] @ matches.spread0
    by_variance = (by1[..., :2] * slope1).sum(axis=2) + (by0[..., :2] * slope0).sum(axis=2)
    return residual, (J / sigma - residual / sigma**2 * by_variance).T


def _in_pixels(
    F: np.ndarray, by_step: np.ndarray, covariance: np.ndarray, to0: np.ndarray, to1: np.ndarray, inliers: np.ndarray
) -> FundamentalMatrix:
    """From scaled coordinates to pixels and norm 1; by_step (9, 7)."""
    whole = np.kron(to1.T, to0.T)
    entries = whole @ F.ravel()
    norm = float(np.linalg.norm(entries))
    unit = entries / norm
    J = (np.eye(9) - np.outer(unit, unit)) @ whole @ by_step / norm
    spread = J @ covariance @ J.T if np.isfinite(covariance).all() else np.full((9, 9), np.inf)
    return FundamentalMatrix(unit.reshape(3, 3), spread, inliers)
