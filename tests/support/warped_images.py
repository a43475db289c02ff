"""A textured plane seen by two cameras, and what is true of its points."""

from __future__ import annotations

import cv2
import numpy as np

from sigmaslam.frontend.types import PatchMaps
from sigmaslam_synthetic.rendering.textures import dead_leaves

WIDTH, HEIGHT = 640, 480


def textured() -> np.ndarray:
    """The plane, (HEIGHT, WIDTH) float32."""
    return dead_leaves((HEIGHT, WIDTH), np.random.default_rng(0)).astype(np.float32)


def warped(texture: np.ndarray, H: np.ndarray) -> np.ndarray:
    """What a camera sees of it: means of 4 x 4 samples."""
    fine = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]]) @ H
    large = cv2.warpPerspective(texture, fine, (4 * WIDTH, 4 * HEIGHT), flags=cv2.INTER_CUBIC)
    return cv2.resize(large, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)


def digitised(image: np.ndarray, seed: int) -> np.ndarray:
    """In whole grey values, with noise of one of them."""
    noise = np.random.default_rng(seed).normal(0.0, 1.0, image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def corners(image: np.ndarray, H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and where H has them, both well inside."""
    points0 = cv2.goodFeaturesToTrack(image, 600, 0.01, 8)[:, 0].astype(np.float64)
    points1 = cv2.perspectiveTransform(points0[None], H)[0]
    inside = np.all([((p > 25) & (p < (WIDTH - 25, HEIGHT - 25))).all(axis=1) for p in (points0, points1)], axis=0)
    return points0[inside], points1[inside]


def maps_of(H: np.ndarray, points0: np.ndarray) -> PatchMaps:
    """By hand: the homography's own terms about each point."""
    whole = np.column_stack([points0, np.ones(len(points0))]) @ H.T
    tilt = np.broadcast_to(H[2, :2], points0.shape) / whole[:, 2:]
    places = whole[:, :2] / whole[:, 2:]
    return PatchMaps((H[:2, :2] - places[..., None] * H[2, :2]) / whole[:, 2, None, None], tilt)
