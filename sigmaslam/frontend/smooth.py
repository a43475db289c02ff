"""Smoothed images, kept for as long as their originals: a keyframe is matched again and again."""

from __future__ import annotations

import weakref

import cv2
import numpy as np

_BLUR = 0.7
# What was asked for last is kept.
_MOST_KEPT = 48
_kept: dict[tuple[int, float], tuple[weakref.ref[np.ndarray], np.ndarray]] = {}


def smoothed(image: np.ndarray, factor: float = 1.0) -> np.ndarray:
    """An (H, W) uint8 image as float32, smoothed by a Gaussian of 0.7 pixels times `factor`; not to be written to."""
    key = id(image), factor
    known = _kept.pop(key, None)
    if known is None or known[0]() is not image:
        known = weakref.ref(image), cv2.GaussianBlur(image, (0, 0), _BLUR * factor).astype(np.float32)
    _kept[key] = known
    while len(_kept) > _MOST_KEPT or _kept[next(iter(_kept))][0]() is None:
        del _kept[next(iter(_kept))]
    return known[1]
