"""How far matched places and disparities are believed, and how the innovations correct that."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS, CalibrationPrior, measured_errors
from sigmaslam.frontend import StereoView, TemporalMatches
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.config import TrackerConfig

# The noise of matches follows the NIS: bounds of its scale, and the exponent of one frame's part in it.
_SCALES, _ADAPTATION = (0.25, 4.0), 0.1
# Errors between the eyes: they differ from disparity to disparity. What both eyes share scales all disparities alike.
_BETWEEN_EYES = tuple(ERRORS.index(name) for name in ("yaw", "pitch", "roll", "zoom", "bend", "lenses"))


class MeasurementNoise:
    """Covariances of what is measured in images; owns their common scale.

    A disparity is as uncertain as its match and as the considered errors between the eyes make it at its place: a
    patch is aligned to hundredths of a pixel where the calibration is off by tenths, and would outweigh all others.

    Args:
        config: settings.
        camera: the rectified pair.
        calibration: prior of its errors.
    """

    def __init__(self, config: TrackerConfig, camera: RectifiedStereo, calibration: CalibrationPrior) -> None:
        self._config = config
        self._camera = camera
        self._considered = calibration.considered_factor[list(_BETWEEN_EYES)]
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
            noise[:, 2, 2] += self._of_calibration(np.nan_to_num(matches.measured))
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
        # The symmetric root: the errors keep to the image's axes from view to view.
        values, vectors = np.linalg.eigh(noise[:, :2, :2])
        common[:, :2] = (vectors * np.sqrt(place * values)[:, None, :]) @ vectors.transpose(0, 2, 1)
        alone = noise.copy()
        alone[:, :2, :2] *= 1.0 - place
        alone[:, 2, 2] *= 1.0 - disparity
        return alone, common

    def of_keypoints(self, view: StereoView, index: np.ndarray) -> np.ndarray:
        """(K, 4) variances of (u, v, disparity) of a keyframe's features, and of what all their disparities share."""
        constant = self._config.constant_sigma
        if constant is None:
            disparity = view.disparity_sigma[index] ** 2 + self._of_calibration(view.measured(index))
        else:
            disparity = np.full(len(index), constant[1] ** 2)
        place = np.full(len(index), self._config.keyframe_sigma**2)
        shared = self._config.shared_disparity
        return self._scale * np.column_stack([place, place, (1.0 - shared) * disparity, shared * disparity])

    def _of_calibration(self, measured: np.ndarray) -> np.ndarray:
        """(M,) variances of disparities by considered errors between the eyes; measured (M, 3) (u, v, disparity)."""
        by_error = measured_errors(self._camera, measured)[:, 2, list(_BETWEEN_EYES)]
        return np.asarray(((by_error @ self._considered) ** 2).sum(axis=1))
