"""Selection of features at a minimum distance, as overlapping patches have correlated errors."""

import cv2
import numpy as np

from sigmaslam.frontend import Features


def select_spaced(
    features: Features, occupied_places: np.ndarray, spacing: float, shape: tuple[int, ...]
) -> np.ndarray:
    """Ascending indices of features at least `spacing` from occupied places (K, 2) and from each other, best first."""
    occupied = np.zeros(shape, np.uint8)
    radius = round(spacing)

    def occupy(place: np.ndarray) -> None:
        cv2.circle(occupied, (round(float(place[0])), round(float(place[1]))), radius, 1, -1)

    for place in occupied_places:
        occupy(place)
    height, width = shape
    kept = []
    columns, rows = np.clip(np.rint(features.keypoints), 0, (width - 1, height - 1)).astype(int).T
    for k in np.argsort(-features.scores, kind="stable"):
        if not occupied[rows[k], columns[k]]:
            kept.append(k)
            occupy(features.keypoints[k])
    return np.sort(np.array(kept, np.int64))
