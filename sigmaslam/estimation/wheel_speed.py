"""The velocity that wheels measure, beside an inertial sensor that predicts it."""

import logging
from collections import deque

import numpy as np

from sigmaslam.estimation.odometry_motion import COMPARED, DEPARTURE, SLOW
from sigmaslam.estimation.preintegration import interpolate
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse

_LOGGER = logging.getLogger(__name__)

# Seconds to the nearest sample; a vehicle that brakes changes its speed by less than 1 m/s in it.
_NEAR = 0.1
# Comparisons that are remembered. Errors of wheels last for a second, in which ten frames have one of them in common.
_REMEMBERED = 10 * COMPARED


class WheelSpeed:
    """Compares wheels with images, and measures the velocity of the vehicle as well as they have agreed lately.

    Args:
        T_camera_base: (4, 4) takes points of the vehicle's frame into the camera that is tracked.
    """

    def __init__(self, sensor: OdometrySensor, T_camera_base: np.ndarray) -> None:
        self.samples = SampleBuffer(sensor.time_shift)
        self._R_base_camera = T_camera_base[:3, :3].T
        self._of_base = se3_adjoint(se3_inverse(T_camera_base))[:3]
        self._departures: deque[np.ndarray] = deque(maxlen=_REMEMBERED)
        self._speeds: deque[float] = deque(maxlen=_REMEMBERED)
        self._is_refused = False

    def compare(self, timestamp: float, twist: np.ndarray, density: float) -> None:
        """Takes the camera's twist (6,) as images know it, and the density of unknown accelerations, m^2/s^3."""
        measured = self._at(timestamp)
        if measured is None:
            return
        self._departures.append(measured - self._of_base @ twist)
        self._speeds.append(float(measured @ measured))
        if len(self._departures) < COMPARED:
            return
        allowed = DEPARTURE**2 * max(float(np.mean(self._speeds)), 3.0 * density)
        is_refused = float(self._variance.sum()) > allowed
        if is_refused and not self._is_refused:
            _LOGGER.warning(
                "the odometry is not used: its velocities are not those of the images; are unit (m/s), axes (forward, "
                "left, up), T_cam_base and clock right?"
            )
        self._is_refused = is_refused

    def measure(
        self, timestamp: float, seconds: float, twist: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """What wheels say of a predicted velocity; None where they are not known to be right.

        Args:
            timestamp: of the prediction.
            seconds: since the last one; errors of wheels last for a second, so that frames of it share one.
            twist: (6,) of the camera in its own frame, predicted.
        Returns:
            (3,) measured less predicted, (3, 3) rotation into the axes of both, and (3, 3) covariance.
        """
        measured = self._at(timestamp)
        if measured is None or self._is_refused or len(self._departures) < COMPARED:
            return None
        noise = np.diag(self._variance * max(SLOW / seconds, 1.0))
        return measured - self._of_base @ twist, self._R_base_camera, noise

    @property
    def _variance(self) -> np.ndarray:
        """(3,) of the last departures."""
        return np.asarray(np.mean(np.square(self._departures), axis=0))

    def _at(self, timestamp: float) -> np.ndarray | None:
        """(3,) velocity of the vehicle; None without a sample near."""
        table = self.samples.around(timestamp, timestamp)
        t = timestamp + self.samples.time_shift
        if not len(table) or np.abs(table[:, 0] - t).min() > _NEAR:
            return None
        return interpolate(np.array([t]), table[:, 0], table[:, 4:])[0]
