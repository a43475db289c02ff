"""How far matched places and disparities are believed, and how the innovations correct that."""

import numpy as np

from sigmaslam.frontend import StereoView, TemporalMatches
from sigmaslam.slam.config import TrackerConfig

# The noise of matches follows the NIS: bounds of its scale, and the exponent of one frame's part in it.
_SCALES, _ADAPTATION = (0.25, 4.0), 0.1


class MeasurementNoise:
    """Covariances of what is measured in images; owns their common scale."""

    def __init__(self, config: TrackerConfig) -> None:
        self._config = config
        self._scale = 1.0

    def adapt(self, nis_per_dof: float) -> None:
        """Moves the scale towards what one frame's innovations ask for."""
        if self._config.constant_sigma is None:
            low, high = _SCALES
            self._scale = float(np.clip(self._scale * nis_per_dof**_ADAPTATION, low, high))

    def of_matches(self, matches: TemporalMatches) -> np.ndarray:
        """(M, 3, 3) of (u, v, disparity), whatever other views share of it."""
        noise = np.zeros((len(matches.points), 3, 3))
        if self._config.constant_sigma is None:
            noise[:, :2, :2] = matches.covariance
            noise[:, 2, 2] = np.where(np.isfinite(matches.disparity), matches.disparity_sigma, 1.0) ** 2
        else:
            place, disparity = self._config.constant_sigma
            noise[:] = np.diag([place, place, disparity]) ** 2
        return self._scale * noise

    def split(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Covariances (M, 3, 3) as `of_matches` gives them, taken apart: what is a view's alone, what it shares.

        Returns:
            (M, 3, 3) of the view alone; (M, 3, 2) how errors of place that the landmark's views share, of variance
            one, enter it. Shared errors of disparities are in the landmark.
        """
        place, disparity = self._config.shared_place, self._config.shared_disparity
        common = np.zeros((len(noise), 3, 2))
        # The symmetric root, (A + sqrt(det A) I) / sqrt(tr A + 2 sqrt(det A)): the errors keep to the image's axes from
        # view to view.
        of_place = noise[:, :2, :2]
        area = np.sqrt(np.linalg.det(of_place))[:, None, None]
        length = np.sqrt((of_place[:, 0, 0] + of_place[:, 1, 1])[:, None, None] + 2.0 * area)
        common[:, :2] = np.sqrt(place) * (of_place + area * np.eye(2)) / length
        alone = noise.copy()
        alone[:, :2, :2] *= 1.0 - place
        alone[:, 2, 2] *= 1.0 - disparity
        return alone, common

    def of_keypoints(self, view: StereoView, index: np.ndarray) -> np.ndarray:
        """(K, 4) variances of (u, v, disparity) of a keyframe's features, and of what all their disparities share."""
        constant = self._config.constant_sigma
        disparity = view.disparity_sigma[index] if constant is None else np.full(len(index), constant[1])
        place = np.full(len(index), self._config.keyframe_sigma**2)
        shared = self._config.shared_disparity
        return self._scale * np.column_stack([place, place, (1.0 - shared) * disparity**2, shared * disparity**2])
