"""GTSAM as this package uses it: an optional extra, imported where it is needed, with its rotation-first tangents."""

from __future__ import annotations

from typing import Any

import numpy as np

from sigmaslam.errors import InputError

# Ours is (translation, rotation), GTSAM's (rotation, translation): the same swap leads there and back.
_SWAP = np.array([3, 4, 5, 0, 1, 2])


def load_gtsam() -> Any:
    """The module gtsam.

    Raises:
        InputError: it is not installed.
    """
    try:
        import gtsam
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[graph]'") from error
    return gtsam


def swap_tangent(covariances: np.ndarray) -> np.ndarray:
    """Covariances (..., 6, 6) from (translation, rotation) to (rotation, translation), or back."""
    return np.asarray(covariances)[..., _SWAP[:, None], _SWAP]
