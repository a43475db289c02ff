"""How far matched places and disparities are believed, and how the innovations correct that."""

from __future__ import annotations

import numpy as np

from sigmaslam.config import TrackerConfig
from sigmaslam.frontend import StereoView, TemporalMatches

# The noise of matches follows the NIS: bounds of its scale, and the exponent of one frame's part in it.
_SCALES, _ADAPTATION = (0.25, 4.0), 0.1


class MatchNoise:
    """Covariances of what is measured in images; owns their common scale.

    Args:
        config: settings.
    """

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._scale = 1.0

    def adapt(self, nis_per_dof: float) -> None:
        """Moves the scale towards what one frame's innovations ask for."""
        if self._config.constant_sigma is None:
            low, high = _SCALES
            self._scale = float(np.clip(self._scale * nis_per_dof**_ADAPTATION, low, high))

    def of_matches(self, matches: TemporalMatches, own: float = 1.0) -> np.ndarray:
        """(M, 3, 3) of (u, v, disparity); `own` is the share of a disparity's variance that is this view's alone."""
        noise = np.zeros((len(matches.points), 3, 3))
        if self._config.constant_sigma is None:
            noise[:, :2, :2] = matches.covariance
            noise[:, 2, 2] = own * np.where(np.isfinite(matches.disparity), matches.disparity_sigma, 1.0) ** 2
        else:
            place, disparity = self._config.constant_sigma
            noise[:] = np.diag([place, place, disparity]) ** 2
        return self._scale * noise

    def of_keypoints(self, view: StereoView, index: np.ndarray) -> np.ndarray:
        """(K, 4) variances of (u, v, disparity) of a keyframe's features, and of what all their disparities share."""
        known = self._config.constant_sigma
        disparity = view.disparity_sigma[index] if known is None else np.full(len(index), known[1])
        place = np.full(len(index), self._config.keyframe_sigma**2)
        shared = self._config.shared_disparity
        return self._scale * np.column_stack([place, place, (1.0 - shared) * disparity**2, shared * disparity**2])
