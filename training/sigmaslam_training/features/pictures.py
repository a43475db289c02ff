"""What a network matches in a held-out pair, as a picture."""

import cv2
import numpy as np

from sigmaslam.frontend.image_pair import draw_lines
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features.stream import Pair
from sigmaslam_training.features.validation import match_pair

RIGHT_WITHIN = 3.0
"""Pixels from the truth."""
_RIGHT_COLOUR, _WRONG_COLOUR = (80, 200, 60), (60, 60, 230)  # blue, green, red
_ENLARGED = 2


def draw_sample(network: FeatureNetwork, pair: Pair) -> np.ndarray:
    """The mutual matches of a pair: (2 H, 4 W, 3) uint8 in OpenCV's order of colours."""
    matches = match_pair(network, pair)
    right = (matches.error < RIGHT_WITHIN).numpy()
    # Right ones last: they lie above.
    order = np.argsort(right, kind="stable")
    image0, image1 = (
        cv2.resize(np.round(255 * image.clip(0, 1)).astype(np.uint8), None, fx=_ENLARGED, fy=_ENLARGED)
        for image in (pair.image0, pair.image1)
    )
    points0, points1 = (_ENLARGED * (each[order].numpy() + 0.5) - 0.5 for each in (matches.points0, matches.points1))
    colours = [_RIGHT_COLOUR if each else _WRONG_COLOUR for each in right[order]]
    return draw_lines(image0, image1, points0, points1, colours)
