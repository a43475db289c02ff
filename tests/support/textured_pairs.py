"""Rectified pairs whose disparity is known."""

from __future__ import annotations

import cv2
import numpy as np


def textured_pair(disparity: np.ndarray, noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Left and right image (H, W) uint8 of a texture.

    Args:
        disparity: (H, W) of the left image, smooth.
        noise: standard deviation in both images, grey values.
        seed: of texture and noise.
    """
    rng = np.random.default_rng(seed)
    height, width = disparity.shape
    texture = cv2.GaussianBlur(rng.standard_normal((height, width + 100)), (0, 0), 2.0)
    texture = (128.0 + 40.0 * texture / texture.std()).astype(np.float32)
    right = texture[:, 50 : 50 + width]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    left = cv2.remap(texture, u - disparity.astype(np.float32) + 50.0, v, cv2.INTER_CUBIC)
    noisy = [image + noise * rng.standard_normal(image.shape) for image in (left, right)]
    return noisy[0].clip(0, 255).round().astype(np.uint8), noisy[1].clip(0, 255).round().astype(np.uint8)
