"""Nearest points in the plane."""

import cv2
import numpy as np

# FLANN_INDEX_KDTREE_SINGLE, with OpenCV's own size of a leaf.
_TREE: dict[str, bool | int | float | str] = {"algorithm": 4, "leaf_max_size": 10}
# Without a limit: the neighbours are exact.
_SEARCH: dict[str, bool | int | float | str] = {"checks": -1}


def nearest_points(points: np.ndarray, queries: np.ndarray, count: int) -> np.ndarray:
    """Indices (M, count) of the nearest of (N, 2) points to each of (M, 2) queries, the nearest first.

    Args:
        count: at most N.
    """
    if len(queries) == 0:
        return np.zeros((0, count), np.int64)
    index = cv2.flann.Index(np.ascontiguousarray(points, np.float32), _TREE)
    nearest, _ = index.knnSearch(np.ascontiguousarray(queries, np.float32), count, params=_SEARCH)
    return np.asarray(nearest, np.int64)
