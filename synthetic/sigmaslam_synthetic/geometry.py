"""Curves."""

import numpy as np


def arc_length(curve: np.ndarray) -> np.ndarray:
    """(N,) length of a curve (N, d) up to each point."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])


def carried_normals(tangents: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) across unit tangents (N, 3) that turn as little as possible from one to the next.

    Args:
        tangents: of a curve.
        start: (3,) the first one before its part along the tangent is taken off.
    """
    normals = np.empty_like(tangents)
    current = start
    for k, tangent in enumerate(tangents):
        current = current - tangent * (tangent @ current)
        current = current / np.linalg.norm(current)
        normals[k] = current
    return normals
