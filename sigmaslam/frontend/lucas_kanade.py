"""Sub-pixel places by one Lucas-Kanade level, and the pyramidal tracker built on the same call."""

from __future__ import annotations

import cv2
import numpy as np

from sigmaslam.frontend.types import Refinement

# At most 20 steps, or until one is below 0.01 px, a sixth of what the best matches err by (docs/notebook, noise).
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)


def lucas_kanade(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, guess1: np.ndarray, window: int, levels: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places in image 1 of patches around points of image 0.

    Args:
        image0, image1: (H, W) uint8.
        points0, guess1: (N, 2) pixel coordinates.
        window: side of the patch, odd.
        levels: pyramid levels above the image itself.
    Returns:
        (N, 2) float64 places and (N,) bool whether the solver ended inside the image.
    """
    if len(points0) == 0:
        return np.zeros((0, 2)), np.zeros(0, bool)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        image0,
        image1,
        np.ascontiguousarray(points0, np.float32).reshape(-1, 1, 2),
        np.ascontiguousarray(guess1, np.float32).reshape(-1, 1, 2).copy(),
        winSize=(window, window),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    height, width = image1.shape
    places = found.reshape(-1, 2).astype(np.float64)
    inside = ((places >= 0) & (places <= (width - 1, height - 1))).all(axis=1)
    return places, (status.ravel() > 0) & inside


def refine(
    image0: np.ndarray,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    window: int = 11,
    reach: float = 2.0,
) -> Refinement:
    """Matched points moved to where the patches agree, if that is near.

    Where the solver went further than `reach` pixels or failed they stay.
    """
    start = points1.astype(np.float64)
    places, found = lucas_kanade(image0, image1, points0, points1, window, 0)
    moved = found & (np.linalg.norm(places - start, axis=1) <= reach)
    return Refinement(start, np.where(moved[:, None], places, start), moved)
