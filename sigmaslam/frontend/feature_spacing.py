"""Selection of features at a minimum distance, as overlapping patches have correlated errors."""

import cv2
import numpy as np

from sigmaslam.frontend import Features
from sigmaslam.frontend.patch_kernels import compiled


def select_spaced(
    features: Features, occupied_places: np.ndarray, spacing: float, shape: tuple[int, ...]
) -> np.ndarray:
    """Ascending indices of features at least `spacing` from occupied places (K, 2) and from each other, best first."""
    radius, order, kernels = round(spacing), np.argsort(-features.scores, kind="stable"), compiled()
    if kernels is not None:
        disc = cv2.circle(np.zeros((2 * radius + 1, 2 * radius + 1), np.uint8), (radius, radius), radius, 1, -1)
        taken, places = (np.rint(each).astype(np.int32) for each in (occupied_places, features.keypoints))
        return np.asarray(kernels.select_spaced(*shape, disc, taken, places, order))
    occupied = np.zeros(shape, np.uint8)

    def occupy(place: np.ndarray) -> None:
        cv2.circle(occupied, (round(float(place[0])), round(float(place[1]))), radius, 1, -1)

    for place in occupied_places:
        occupy(place)
    height, width = shape
    kept = []
    columns, rows = np.clip(np.rint(features.keypoints), 0, (width - 1, height - 1)).astype(int).T
    for k in order:
        if not occupied[rows[k], columns[k]]:
            kept.append(k)
            occupy(features.keypoints[k])
    return np.sort(np.array(kept, np.int64))
