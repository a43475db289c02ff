"""Constant velocity: pose since the last keyframe and twist, the chapter's twelve states (9.37) on SE(3)."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.estimator_graphs import open_step
from sigmaslam.estimation.sample_buffer import SampleBuffer
from sigmaslam.geometry.se3 import nearest_rigid, se3_adjoint, se3_inverse, se3_log

# Order of the graph's error state, see sigmaslam_models.estimator.pose_prediction.
_POSE, _TWIST, _STATE_SIZE = slice(0, 6), slice(6, 12), 12


@dataclass(frozen=True, slots=True)
class MotionState:
    """Pose since the last keyframe, and twist, at one moment.

    Attributes:
        step: (4, 4) T_keyframe_camera.
        twist: (6,) velocity of the camera in its own frame, m/s and rad/s.
        covariance: (12, 12) of both; the step is perturbed from the left in the keyframe.
        carried: (12, 12) covariance of the state before the prediction with the one after it; None: that of constant
            velocity. By an inertial sensor there are 19 numbers in place of the twist.
    """

    step: np.ndarray
    twist: np.ndarray
    covariance: np.ndarray
    carried: np.ndarray | None = None


class MotionFilter:
    """Predicts the pose relative to the last keyframe, and learns the velocity from poses that images give.

    Attributes:
        step: (4, 4) T_keyframe_camera.
        twist: (6,) velocity of the camera in its own frame, m/s and rad/s.
        widened: by which factor since the last prediction.
        turn: (3, 3) rotation R_last_current that a sensor has measured; None: none has.
        is_inertial, is_odometric: an inertial sensor or odometry predicts, which knows the velocity without images.
        sensors: what takes their samples, by "imu" and "odometry".

    Args:
        backend: "onnx" or "torch".
    """

    reckoning = "inertial"
    """Status of frames that a sensor carries, while one predicts."""

    def __init__(self, backend: str = "onnx") -> None:
        self._predict = open_step("pose_predict", backend)
        self.step = np.eye(4)
        self.twist = np.zeros(6)
        self._covariance = np.zeros((_STATE_SIZE, _STATE_SIZE))
        self.widened = 1.0
        self.turn: np.ndarray | None = None
        self.is_inertial = self.is_odometric = False
        self.sensors: dict[str, SampleBuffer] = {}

    @property
    def state(self) -> MotionState:
        """What is known now."""
        return MotionState(self.step.copy(), self.twist.copy(), self._covariance.copy())

    @property
    def step_covariance(self) -> np.ndarray:
        """(6, 6) of `step`, perturbed from the left in the keyframe."""
        return self._covariance[_POSE, _POSE]

    @property
    def predicted_covariance(self) -> np.ndarray:
        """(6, 6) of `step` by the motion alone, before it was widened."""
        return self.step_covariance / self.widened

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Replaces the velocity by one that is independent of the pose; both (6,), m/s and rad/s."""
        self.twist = twist
        self._covariance[_TWIST, :] = 0.0
        self._covariance[:, _TWIST] = 0.0
        self._covariance[_TWIST, _TWIST] = np.diag(sigma**2)

    def predict(
        self, seconds: float, densities: np.ndarray, sigma: float = 0.0, timestamp: float | None = None
    ) -> None:
        """Moves on.

        Args:
            seconds: since the last frame.
            densities: (2,) power spectra of the accelerations, m^2/s^3 and rad^2/s^3.
            sigma: standard deviation of the seconds; along the velocity the pose is that much less certain.
            timestamp: of the frame, seconds; for a sensor.
        """
        self.step, covariance = self._predict(
            {
                "pose": self.step,
                "twist": self.twist,
                "covariance": self._covariance,
                "step": np.array(seconds),
                "densities": densities,
            }
        )
        self._covariance, self.widened = 0.5 * (covariance + covariance.T), 1.0
        if sigma > 0.0:
            self.doubt_time(sigma)

    def widen(self, factor: float) -> None:
        """The prediction is off by more than it claims: all its variances are so many times as large."""
        self._covariance, self.widened = factor * self._covariance, factor * self.widened

    def doubt_time(self, seconds: float) -> None:
        """The image is of another moment, by so much: that, and no error of the velocity, makes the prediction wide."""
        error = self.way(seconds)
        self.widen(1.0 / self.widened)
        self._covariance[_POSE, _POSE] += np.outer(error, error)

    def restore(self, state: MotionState, widened: float) -> None:
        """Takes an earlier state of constant velocity back, to the bit."""
        self.step, self.twist, self._covariance, self.widened = state.step, state.twist, state.covariance, widened

    def way(self, seconds: float) -> np.ndarray:
        """(6,) what the velocity makes of the pose in that time, perturbed from the left in the keyframe."""
        return np.asarray(seconds * (se3_adjoint(self.step) @ self.twist))

    def correct(self, step: np.ndarray, covariance: np.ndarray) -> None:
        """Takes over the posterior of the pose, perturbed from the left in the keyframe, which knew the prediction."""
        P = self._covariance
        gain = np.linalg.lstsq(P[_POSE, _POSE], P[_POSE, _TWIST], rcond=1e-14)[0].T
        self.twist = self.twist + gain @ se3_log(step @ se3_inverse(self.step))
        twist = P[_TWIST, _TWIST] - gain @ (P[_POSE, _POSE] - covariance) @ gain.T
        self.step = nearest_rigid(step)
        self._covariance = np.block([[covariance, covariance @ gain.T], [gain @ covariance, 0.5 * (twist + twist.T)]])

    def start_keyframe(self) -> None:
        """The current pose is the keyframe's from now on."""
        self.step = np.eye(4)
        self._covariance[_POSE, :] = 0.0
        self._covariance[:, _POSE] = 0.0


def dead_reckoning(motion: MotionFilter) -> str | None:
    """Status of frames that a sensor alone carries; None where none predicts."""
    return motion.reckoning if motion.is_inertial or motion.is_odometric else None
