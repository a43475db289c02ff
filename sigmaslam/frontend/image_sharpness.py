"""How sharp images are."""

from __future__ import annotations

import cv2
import numpy as np

# Smoothing before derivatives are taken: standard deviation and reach, pixels.
_BLUR, _REACH = 0.7, 3


def sharpness(image: np.ndarray) -> float:
    """Mean squared second derivative of an (H, W) uint8 image over that of the first, 1 / pixels squared.

    It falls with blur of any kind, and depends on neither contrast nor brightness.
    """
    smooth = cv2.sepFilter2D(image, cv2.CV_32F, _KERNEL, _KERNEL)
    first = sum(cv2.norm(cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=1)) ** 2 for axes in ((1, 0), (0, 1)))
    return float(cv2.norm(cv2.Laplacian(smooth, cv2.CV_32F)) ** 2 / max(first, 1.0))


def _gaussian() -> np.ndarray:
    weights = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _BLUR) ** 2)
    return np.asarray((weights / weights.sum()).astype(np.float32))


_KERNEL = _gaussian()
