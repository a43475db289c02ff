"""Access to GTSAM, an optional extra that is imported on use, and its order of tangents, rotation first."""

from typing import Any

import numpy as np

from sigmaslam.errors import InputError

# Tangents are (translation, rotation) here and (rotation, translation) in GTSAM. The swap is its own inverse.
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
