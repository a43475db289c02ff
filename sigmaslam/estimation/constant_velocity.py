"""Constant velocity: pose since the last keyframe and twist, the chapter's twelve states (9.37) on SE(3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_999, CHI_SQUARE_9999_OF_6
from sigmaslam.geometry.se3 import nearest_rigid, se3_adjoint, se3_inverse, se3_log
from sigmaslam.inference.backends import load_step

# Order of the graph's error state, see sigmaslam_models.estimator.pose_prediction.
_POSE, _TWIST, _STATE_SIZE = slice(0, 6), slice(6, 12), 12


@dataclass(frozen=True, slots=True)
class MotionState:
    """Pose since the last keyframe, and twist, at one moment.

    Attributes:
        step: (4, 4) T_keyframe_camera.
        twist: (6,) velocity of the camera in its own frame, m/s and rad/s.
        covariance: (12, 12) of both; the step is perturbed from the left in the keyframe.
    """

    step: np.ndarray
    twist: np.ndarray
    covariance: np.ndarray


class MotionFilter:
    """Predicts the pose relative to the last keyframe, and learns the velocity from poses that images give.

    Attributes:
        step: (4, 4) T_keyframe_camera.
        twist: (6,) velocity of the camera in its own frame, m/s and rad/s.

    Args:
        backend: "onnx" or "torch".
    """

    def __init__(self, backend: str = "onnx") -> None:
        self._predict = load_step("pose_predict", backend)
        self.step = np.eye(4)
        self.twist = np.zeros(6)
        self._covariance = np.zeros((_STATE_SIZE, _STATE_SIZE))
        self._widened = 1.0  # by which factor since the last prediction

    @property
    def state(self) -> MotionState:
        """What is known now."""
        return MotionState(self.step.copy(), self.twist.copy(), self._covariance.copy())

    @property
    def step_covariance(self) -> np.ndarray:
        """(6, 6) of `step`, perturbed from the left in the keyframe."""
        return self._covariance[_POSE, _POSE]

    def forget_twist(self, sigma: np.ndarray) -> None:
        """No velocity is known but that it is about zero; sigma (6,) m/s and rad/s."""
        self.set_twist(np.zeros(6), sigma)

    def set_twist(self, twist: np.ndarray, sigma: np.ndarray) -> None:
        """Replaces the velocity by one that is independent of the pose."""
        self.twist = twist
        self._covariance[_TWIST, :] = 0.0
        self._covariance[:, _TWIST] = 0.0
        self._covariance[_TWIST, _TWIST] = np.diag(sigma**2)

    def predict(self, seconds: float, densities: np.ndarray, sigma: float = 0.0) -> None:
        """Moves on.

        Args:
            seconds: since the last frame.
            densities: (2,) power spectra of the accelerations, m^2/s^3 and rad^2/s^3.
            sigma: standard deviation of the seconds; along the velocity the pose is that much less certain.
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
        self._covariance, self._widened = 0.5 * (covariance + covariance.T), 1.0
        if sigma > 0.0:
            self.doubt_time(sigma)

    def widen(self, factor: float) -> None:
        """The prediction is off by more than it claims: all its variances are so many times as large."""
        self._covariance, self._widened = factor * self._covariance, factor * self._widened

    def time_error(self, step: np.ndarray, interval: float) -> float:
        """By how many frames an image seems to be later than its stamp; 0 where the motion's noise explains its pose.

        A pose that departs from the prediction as the velocity goes, by half a frame's way or more, is of another
        moment: a real acceleration does not do that within a frame.

        Args:
            step: (4, 4) T_keyframe_camera as the image shows it.
            interval: of the frames, seconds.
        """
        departure, along = se3_log(step @ se3_inverse(self.step)), self._way(interval)
        P = self.step_covariance / self._widened
        weighted = np.linalg.lstsq(P, np.column_stack([departure, along]), rcond=1e-14)[0]
        (whole, across), (_, visible) = np.stack([departure, along]) @ weighted
        if visible <= CHI_SQUARE_999[1]:
            return 0.0
        frames, explained = float(across / visible), across**2 / visible
        seen = explained > CHI_SQUARE_999[1] and explained > ACCEPTANCE.time_share * whole
        return frames if seen and abs(frames) >= ACCEPTANCE.time_error else 0.0

    def surprise(self, step: np.ndarray) -> float:
        """By what the prediction's variances are too small where a pose (4, 4) T_keyframe_camera is right; 1 or more.

        A prediction that the images contradict drags the pose along, and says nothing of it.
        """
        departure = se3_log(step @ se3_inverse(self.step))
        squared = float(departure @ np.linalg.lstsq(self.step_covariance, departure, rcond=1e-14)[0])
        return squared / len(departure) if squared > CHI_SQUARE_9999_OF_6 else 1.0

    def doubt_time(self, seconds: float) -> np.ndarray:
        """The image is of another moment, by so much: that, and no error of the velocity, makes the prediction wide.

        Returns:
            (6,) the way in that time, perturbed from the left in the keyframe.
        """
        error = self._way(seconds)
        self.widen(1.0 / self._widened)
        self._covariance[_POSE, _POSE] += np.outer(error, error)
        return error

    def _way(self, seconds: float) -> np.ndarray:
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
