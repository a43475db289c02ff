"""How sharp images are, and smoothed ones, kept as long as their originals: keyframes are matched again and again."""

from __future__ import annotations

import weakref

import cv2
import numpy as np

_BLUR = 0.7
# Reach of the kernel in standard deviations.
_REACH = 4.0
# What was asked for last is kept.
_MOST_KEPT = 16
_kept: dict[tuple[int, float], tuple[weakref.ref[np.ndarray], np.ndarray]] = {}


def smoothed(image: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """An image smoothed by a Gaussian of 0.7 pixels times `factor`, at twice its resolution.

    Bilinear samples of the pixels themselves are off by up to 0.015 px, as their places lie between pixels: alike
    where all move alike. Of half pixels, which the Gaussian knows exactly, they are off by a sixteenth of that.

    Args:
        image: (H, W) uint8.
        factor: for the width of the Gaussian.
    Returns:
        (2 H, 2 W) float32, pixel (u, v) of the image at (2 u, 2 v); not to be written to.
    """
    key = id(image), factor
    known = _kept.pop(key, None)
    if known is None or known[0]() is not image:
        known = weakref.ref(image), _double(image.astype(np.float32), _BLUR * factor)
    _kept[key] = known
    while len(_kept) > _MOST_KEPT or _kept[next(iter(_kept))][0]() is None:
        del _kept[next(iter(_kept))]
    return known[1]


def sharpness(image: np.ndarray) -> float:
    """Mean squared second derivative of an (H, W) uint8 image over that of the first, 1 / pixels squared.

    It falls with blur of any kind, and depends on neither contrast nor brightness.
    """
    smooth = smoothed(image)[::2, ::2]
    first = sum(cv2.norm(cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=1)) ** 2 for axes in ((1, 0), (0, 1)))
    return float(cv2.norm(cv2.Laplacian(smooth, cv2.CV_32F)) ** 2 / max(first, 1.0))


def _double(image: np.ndarray, sigma: float) -> np.ndarray:
    """Smoothed, on pixels and halfway between them."""
    height, width = image.shape
    reach = int(np.ceil(_REACH * sigma))
    one = np.ones(1, np.float32)
    kernels = []
    for half in (0, 1):
        kernel = np.exp(-0.5 * ((np.arange(half - reach, reach + 1) - 0.5 * half) / sigma) ** 2)
        kernels.append(((kernel / kernel.sum()).astype(np.float32), reach - half))
    wide = cv2.merge([cv2.sepFilter2D(image, cv2.CV_32F, kernel, one, anchor=(at, 0)) for kernel, at in kernels])
    wide = wide.reshape(height, 2 * width)
    rows = [cv2.sepFilter2D(wide, cv2.CV_32F, one, kernel, anchor=(0, at)) for kernel, at in kernels]
    return np.stack(rows, axis=1).reshape(2 * height, 2 * width)
