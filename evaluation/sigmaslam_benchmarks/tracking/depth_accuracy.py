"""Depths of a keyframe against the exact ones of its render."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.reconstruction.reconstruct import KeyframeDepth
from sigmaslam.table import Table

# 95 % of a normal distribution, in standard deviations.
_SIGMAS_95 = 1.959964


@dataclass(frozen=True, slots=True)
class JudgedPixels(Table):
    """Pixels of keyframes that both eyes see.

    Attributes:
        fused_error, single_error: (N,) of the depth after fusion and of the single view's, as a share of the true one;
            NaN where there is none.
        sigmas, sigmas_alone: (N,) error of the fused inverse depth, in its standard deviations, with and without that
            of the disparity offset; NaN where there is none.
        error_mm, sigma_mm: (N,) of the fused depth along the optical axis, millimetres; the sigma holds that of the
            disparity offset. NaN where there is none.
        is_point: (N,) bool, the pixel became a point of the cloud.
        moves: (N,) bool, it shows a body that moves.
    """

    fused_error: np.ndarray
    single_error: np.ndarray
    sigmas: np.ndarray
    sigmas_alone: np.ndarray
    error_mm: np.ndarray
    sigma_mm: np.ndarray
    is_point: np.ndarray
    moves: np.ndarray


@dataclass(frozen=True, slots=True)
class DepthFigures:
    """What pixels of a sequence amount to.

    Attributes:
        fused_error, single_error: medians of the absolute errors as shares of the depth, over the same pixels: those
            that became points.
        inside: share of the points inside their 95 % interval.
        completeness: share of the pixels at rest seen by both eyes that became points.
        gross: share of the points whose depth is off by more than a tenth.
        ghosts: share of the pixels on moving bodies that became points; NaN where nothing moves.
        error_mm, error95_mm: median and 95th percentile of the absolute errors of the points' depths, millimetres.
        sigma_mm: median of the sigmas of the points' depths, millimetres.
        within, within_alone: shares of the points inside one and two sigma, and inside those without the part of the
            disparity offset.
        keyframes: that were judged.
    """

    fused_error: float
    single_error: float
    inside: float
    completeness: float
    gross: float
    ghosts: float
    error_mm: float
    error95_mm: float
    sigma_mm: float
    within: tuple[float, float]
    within_alone: tuple[float, float]
    keyframes: int


def judge_pixels(
    depth: KeyframeDepth,
    single: np.ndarray,
    truth: np.ndarray,
    visible: np.ndarray,
    moves: np.ndarray,
    camera: RectifiedStereo,
) -> JudgedPixels:
    """Holds a keyframe's depths against the truth.

    Args:
        depth: of the keyframe.
        single: (H, W) disparities of a single view, the disparity offset taken off, pixels; NaN where there are none.
        truth: (H, W) true depths, metres; inf for the sky.
        visible: (H, W) bool, what both eyes see.
        moves: (H, W) bool, pixels on bodies that move.
        camera: the rectified pair.
    """
    rows = visible & np.isfinite(truth)
    true = camera.focal_baseline / truth[rows]
    fused, alone = depth.fused.disparity[rows], single[rows]
    with np.errstate(divide="ignore", invalid="ignore"):
        return JudgedPixels(
            true / fused - 1.0,
            true / alone - 1.0,
            (fused - true) / np.sqrt(depth.variance[rows]),
            (fused - true) / np.sqrt(depth.fused.variance[rows]),
            1e3 * truth[rows] * (true / fused - 1.0),
            1e3 * truth[rows] * np.sqrt(depth.variance[rows]) / fused,
            depth.is_point[rows],
            moves[rows],
        )


def summarise(pixels: JudgedPixels, keyframes: int) -> DepthFigures:
    """Figures of the pixels of so many keyframes."""
    points = pixels.select(pixels.is_point & ~pixels.moves)
    both = points.select(np.isfinite(points.single_error))
    none = float("nan")
    return DepthFigures(
        float(np.median(np.abs(both.fused_error))) if len(both) else none,
        float(np.median(np.abs(both.single_error))) if len(both) else none,
        float(np.mean(np.abs(points.sigmas) < _SIGMAS_95)) if len(points) else none,
        float(pixels.is_point[~pixels.moves].mean()) if (~pixels.moves).any() else none,
        float(np.mean(np.abs(points.fused_error) > 0.1)) if len(points) else none,
        float(pixels.is_point[pixels.moves].mean()) if pixels.moves.any() else none,
        float(np.median(np.abs(points.error_mm))) if len(points) else none,
        float(np.percentile(np.abs(points.error_mm), 95)) if len(points) else none,
        float(np.median(points.sigma_mm)) if len(points) else none,
        _within(points.sigmas),
        _within(points.sigmas_alone),
        keyframes,
    )


def _within(sigmas: np.ndarray) -> tuple[float, float]:
    """Shares inside one and two sigma."""
    one, two = (float(np.mean(np.abs(sigmas) < many)) if len(sigmas) else float("nan") for many in (1, 2))
    return one, two
