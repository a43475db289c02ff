"""Curves and rigid motions."""

from collections.abc import Sequence

import numpy as np


def rigid_motion(rotation: np.ndarray, translation: np.ndarray | Sequence[float]) -> np.ndarray:
    """Matrices (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    translation = np.asarray(translation)
    T = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = rotation, translation, 1.0
    return T


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
