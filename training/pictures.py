"""What a network matches in a held-out pair, as a picture."""

from __future__ import annotations

import cv2
import numpy as np

from sigmaslam.models.network import FeatureNetwork
from sigmaslam.training.stream import Pair
from sigmaslam.training.validation import match_pair

RIGHT_WITHIN = 3.0
"""Pixels from the truth."""
_RIGHT_COLOUR, _WRONG_COLOUR = (80, 200, 60), (60, 60, 230)  # blue, green, red
_ENLARGED = 2


def draw_sample(network: FeatureNetwork, pair: Pair) -> np.ndarray:
    """The mutual matches of a pair: (2 H, 4 W, 3) uint8 in OpenCV's order of colours."""
    matches = match_pair(network, pair)
    right = (matches.error < RIGHT_WITHIN).numpy()
    return draw_matches(pair.image0, pair.image1, matches.points0.numpy(), matches.points1.numpy(), right)


def draw_matches(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, right: np.ndarray
) -> np.ndarray:
    """Two images side by side, twice as large, with lines between their matches: right ones green, wrong ones red.

    Args:
        image0, image1: (H, W) in [0, 1].
        points0, points1: (M, 2) pixels (u, v).
        right: (M,) bool.
    Returns:
        (2 H, 4 W, 3) uint8 in OpenCV's order of colours.
    """
    grey = np.round(255 * np.concatenate([image0, image1], axis=1).clip(0, 1)).astype(np.uint8)
    large = cv2.resize(grey, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_LINEAR)
    picture = cv2.cvtColor(large, cv2.COLOR_GRAY2BGR)
    aside = np.array([image0.shape[1], 0])
    ends = np.round(_ENLARGED * (np.stack([points0, points1 + aside], axis=1) + 0.5) - 0.5).astype(int)
    # Right ones last: they lie above.
    for index in np.argsort(right, kind="stable"):
        colour = _RIGHT_COLOUR if right[index] else _WRONG_COLOUR
        cv2.line(picture, ends[index, 0].tolist(), ends[index, 1].tolist(), colour, 1, cv2.LINE_AA)
    return np.asarray(picture)
