"""Sub-pixel places by one Lucas-Kanade level, and the pyramidal tracker built on the same call."""

import cv2
import numpy as np

from sigmaslam.frontend.types import Refinement

# At most 20 steps, or until one is below 0.01 px, a sixth of what the best matches err by (docs/notebook, noise).
_CRITERIA = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)
# Side of a patch, pixels, that of the flow that gives starts: larger ones straddle depths, smaller ones slide on edges.
_WINDOW = 15
# Likewise, of matches that are refined: they are within pixels of their places.
_REFINED = 11
# Above the image itself: in the smallest one half a patch is 112 pixels, as much as most disparities. The way back
# starts from where it should end.
_LEVELS = 4, 1
# Pixels that the way back may miss by: more keeps corners that slid along an edge, less loses those on slopes.
_FORWARD_BACKWARD = 0.7
# Shares of the contrast by which light may differ: eyes that both see well are compared as they are.
_EQUAL_LIGHT = 0.25


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


def in_light_of(image0: np.ndarray, image1: np.ndarray) -> np.ndarray:
    """Image 1 (H, W) uint8, with mean and contrast of image 0 if its light differs, as patches are compared as is."""
    (mean0, contrast0), (mean1, contrast1) = (np.ravel(cv2.meanStdDev(each[::4])) for each in (image0, image1))
    gain = float(contrast0 / max(contrast1, 1.0))
    if max(abs(gain - 1.0), abs(mean1 - mean0) / max(contrast0, 1.0)) < _EQUAL_LIGHT:
        return image1
    return np.asarray(cv2.addWeighted(image1, gain, image1, 0.0, float(mean0 - gain * mean1)))


def follow_both_ways(
    image0: np.ndarray,
    image1: np.ndarray,
    points0: np.ndarray,
    guess1: np.ndarray,
    window: int = _WINDOW,
    levels: tuple[int, int] = _LEVELS,
    tolerance: float = _FORWARD_BACKWARD,
) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 2) in image 1 from guesses (N, 2), and whether (N,) the way back ends within `tolerance` pixels.

    `levels` are those of the way there and of the way back.
    """
    places, converged = lucas_kanade(image0, image1, points0, guess1, window, levels[0])
    back, returned = lucas_kanade(image1, image0, places, points0, window, levels[1])
    return places, converged & returned & (np.linalg.norm(back - points0, axis=1) <= tolerance)


def refine(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, reach: float = 2.0
) -> Refinement:
    """Matched points moved to where the patches agree, if that is near.

    Where the solver went further than `reach` pixels or failed they stay.
    """
    start = points1.astype(np.float64)
    places, found = lucas_kanade(image0, image1, points0, points1, _REFINED, 0)
    moved = found & (np.linalg.norm(places - start, axis=1) <= reach)
    return Refinement(start, np.where(moved[:, None], places, start), moved)
