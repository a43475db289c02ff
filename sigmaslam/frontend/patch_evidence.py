"""What the patches of a match say of it: how well they agree, and how sharply that fixes the place."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.frontend.image_smoothing import smoothed

_RADIUS = 5
_MOST_ZOOM = 5.0
# OpenCV samples at fewer than 2^15 rows at once.
_MOST_ROWS = 30_000
# Variance of grey values that a flat patch is taken to have.
_LEAST_VARIANCE = 1.0


@dataclass(frozen=True, slots=True)
class Evidence:
    """Of each match, from patches of 11 x 11 samples, a pixel of the coarser image apart.

    Attributes:
        correlation: (M,) in [-1, 1], normalised, window-weighted.
        contrast0, contrast1: (M,) standard deviation of the patches' grey values.
        sharpness: (M, 2) mean squared gradient of the patches along `axes` over their variance, the larger first,
            1 / pixels squared of image 1.
        axes: (M, 2, 2) unit vectors in image 1 as columns: the first across the strongest edge, the second along it.
        spacing: (M,) of the samples in pixels of image 1.
        zoom: (M,) scale of image 1 over image 0 around the match.
    """

    correlation: np.ndarray
    contrast0: np.ndarray
    contrast1: np.ndarray
    sharpness: np.ndarray
    axes: np.ndarray
    spacing: np.ndarray
    zoom: np.ndarray


def examine_patches(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, A: np.ndarray | None = None
) -> Evidence:
    """Compares the patches around matched points.

    Args:
        image0, image1: (H, W) uint8.
        points0, points1: (M, 2) pixels.
        A: (M, 2, 2), the affine map of image 0 to image 1 around each match; None, or entries that no surface shows
            (mirrored, or a zoom beyond 5), stand for the identity.
    """
    count = len(points0)
    spacing, zoom = np.ones(count), np.ones(count)
    groups: list[tuple[np.ndarray, float]] = [(np.arange(count), 1.0)]
    back = np.broadcast_to(np.eye(2), (count, 2, 2))
    if A is not None:
        A = np.where(np.isfinite(A).all(axis=(1, 2))[:, None, None], A, np.eye(2))
        determinant = np.linalg.det(A)
        sane = (determinant > _MOST_ZOOM**-2) & (determinant < _MOST_ZOOM**2)
        back = np.linalg.inv(np.where(sane[:, None, None], A, np.eye(2)))
        zoom = np.sqrt(np.where(sane, determinant, 1.0))
        half_octaves = np.round(2.0 * np.log2(zoom)).astype(int)
        groups = [(np.flatnonzero(half_octaves == step), 2.0 ** (0.5 * step)) for step in np.unique(half_octaves)]
    patches0 = np.empty((count, (2 * _RADIUS + 1) ** 2), np.float32)
    patches1 = np.empty_like(patches0)
    for rows, factor in groups:
        spacing[rows] = max(1.0, factor)
        # The finer image is smoothed as the coarser one's pixels do it.
        smooth0, smooth1 = smoothed(image0, max(1.0, 1.0 / factor)), smoothed(image1, max(1.0, factor))
        grid = max(1.0, factor) * _GRID
        offsets = grid if A is None else grid @ back[rows].transpose(0, 2, 1)
        patches0[rows] = sample_patches(smooth0, points0[rows, None] + offsets)
        patches1[rows] = sample_patches(smooth1, points1[rows, None] + grid)
    centred0, variance0 = _centred(patches0)
    centred1, variance1 = _centred(patches1)
    both = np.sqrt(variance0 * variance1)
    correlation = ((centred0 * centred1) @ _WINDOW) / both
    # Gradients of the mean of both normalised patches: their noise is the smaller for it.
    mean = 0.5 * (centred0 / np.sqrt(variance0)[:, None] + centred1 / np.sqrt(variance1)[:, None])
    square = mean.reshape(count, 2 * _RADIUS + 1, 2 * _RADIUS + 1)
    along_v, along_u = (each.reshape(patches0.shape) for each in np.gradient(square, axis=(1, 2)))
    uu, uv, vv = (
        (a * b) @ _WINDOW / spacing**2 for a, b in ((along_u, along_u), (along_u, along_v), (along_v, along_v))
    )
    middle, half = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
    cosine, sine = np.cos(angle), np.sin(angle)
    axes = np.stack([np.stack([cosine, -sine], axis=1), np.stack([sine, cosine], axis=1)], axis=1)
    sharpness = np.stack([middle + half, np.maximum(middle - half, 0.0)], axis=1)
    return Evidence(correlation, np.sqrt(variance0), np.sqrt(variance1), sharpness, axes, spacing, zoom)


def _window() -> tuple[np.ndarray, np.ndarray]:
    side = np.arange(-_RADIUS, _RADIUS + 1, dtype=np.float64)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    window = np.exp(-0.5 * (grid**2).sum(axis=1) / (0.6 * _RADIUS) ** 2)
    return grid, (window / window.sum()).astype(np.float32)


_GRID, _WINDOW = _window()


def sample_patches(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Samples (M, K) as float32 of an image that `smoothed` has made, at places (M, K, 2) of the original."""
    samples = np.empty(places.shape[:2], np.float32)
    for begin in range(0, len(places), _MOST_ROWS):
        some = slice(begin, begin + _MOST_ROWS)
        u, v = (np.ascontiguousarray(2.0 * places[some, :, axis], np.float32) for axis in (0, 1))
        samples[some] = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return samples


def _centred(patches: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patches (M, K) of weighted mean 0, and their variance (M,)."""
    centred = patches - (patches @ _WINDOW)[:, None]
    return centred, (centred * centred) @ _WINDOW + _LEAST_VARIANCE
