"""The Gaussian of a window: stereo calibration, keyframe poses, and the poses that left the window."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.estimation.marginalised_poses import PastPoses, past_slice
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, pose_slice
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, se3_log
from sigmaslam.inference.onnx_graph import Step


@dataclass(frozen=True, slots=True)
class WindowState:
    """Mean and covariance of calibration and poses, which are perturbed from the left in the world.

    Attributes:
        calibration: (15,) errors of the calibration, see `calibration_errors.ERRORS`.
        poses: (K, 4, 4) T_world_keyframe, the oldest first.
        covariance: (15 + 6 K, 15 + 6 K) of both, as far as it comes from matches and motion.
        common: (15 + 6 K, 15) how considered errors of the calibration, of variance one, enter the errors of both.
        past: marginalised poses, jointly Gaussian with the state.
    """

    calibration: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    past: PastPoses

    @classmethod
    def initial(cls, calibration: CalibrationPrior) -> Self:
        """No poses; calibration errors of mean zero."""
        covariance, common = calibration.estimated_covariance, calibration.considered_factor
        return cls(np.zeros(CALIBRATION_SIZE), np.zeros((0, 4, 4)), covariance, common, PastPoses.empty())

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def whole_covariance(self) -> np.ndarray:
        """(n, n) covariance with the part of the considered errors."""
        return np.asarray(self.covariance + self.common @ self.common.T)

    @property
    def all_poses(self) -> PastPoses:
        """The marginalised poses, and behind them those of the window."""
        past, own = self.past, self.covariance[CALIBRATION_SIZE:]
        across = past.cross[:, CALIBRATION_SIZE:]
        return PastPoses(
            np.concatenate([past.poses, self.poses]),
            np.block([[past.covariance, across], [across.T, own[:, CALIBRATION_SIZE:]]]),
            np.concatenate([past.cross, own]),
            np.concatenate([past.common, self.common[CALIBRATION_SIZE:]]),
        )

    def minus(self, other: Self) -> np.ndarray:
        """(n,) error-state difference of two means."""
        poses = se3_log(self.poses @ se3_inverse(other.poses)).ravel()
        return np.r_[self.calibration - other.calibration, poses]

    def moved(self, step: np.ndarray, covariance: np.ndarray, common: np.ndarray) -> Self:
        """The means moved by an error-state step (n,), with other errors; marginalised poses stay."""
        poses = nearest_rigid(se3_exp(step[CALIBRATION_SIZE:].reshape(-1, 6)) @ self.poses)
        calibration = self.calibration + step[CALIBRATION]
        return replace(self, calibration=calibration, poses=poses, covariance=covariance, common=common)

    def given(self, information: np.ndarray, vector: np.ndarray, condition: Step) -> Self:
        """Posterior when exp(-x^T information x / 2 + vector^T x) is learned about the error state x.

        Args:
            information, vector: (n, n), (n,).
            condition: `sigmaslam_models.estimator.window_solution.Condition`.
        """
        factor = matrix_root(self.covariance)
        past = self.past.given(factor, self.common, information, vector)
        learned = {"factor": factor, "information": information, "vector": vector, "common": self.common}
        step, covariance, common = condition(learned)
        return replace(self.moved(step, covariance, common), past=past)

    def with_errors(
        self, index: np.ndarray, value: np.ndarray, by_error: np.ndarray, to_factor: np.ndarray
    ) -> tuple[Self, np.ndarray]:
        """As if considered errors of the calibration had other means, and all of them another covariance.

        Args:
            index: (K,) in `calibration_errors.ERRORS`.
            value: (K,) their means.
            by_error: (15, 15) inverse of the factor of their covariance, `considered_factor`.
            to_factor: (15, 15) that by the factor of the other covariance.
        Returns:
            The state, and its step (n,).
        """
        slope, past_slope = self.common @ by_error[:, index], self.past.common @ by_error[:, index]
        change = value - self.calibration[index]
        past_step, past_common = past_slope @ change, self.past.common @ to_factor
        past = self.past.moved(past_step, self.past.covariance, self.past.cross, past_common)
        step = slope @ change
        return replace(self.moved(step, self.covariance, self.common @ to_factor), past=past), step

    def grow(self, pose: np.ndarray, step_covariance: np.ndarray, walk: np.ndarray, origin: int | None = None) -> Self:
        """Appends a pose.

        Args:
            pose: (4, 4) mean of T_world_keyframe.
            step_covariance: (6, 6) of it relative to the last keyframe, perturbed from the left in the world.
            walk: (15,) variances by which the calibration may have moved since.
            origin: in an empty window, the marginalised pose that takes the place of the last keyframe; the world by
                default.
        """
        covariance, past = self.past.grow(self.covariance, step_covariance, walk, origin)
        poses = np.concatenate([self.poses, nearest_rigid(pose)[None]])
        common = np.zeros((6, CALIBRATION_SIZE))
        if len(self):
            common = self.common[-6:]
        elif origin is not None:
            common = self.past.common[past_slice(origin)]
        return replace(
            self, poses=poses, covariance=covariance, common=np.concatenate([self.common, common]), past=past
        )

    def marginalise_oldest(self) -> Self:
        """Moves the oldest pose to the past."""
        oldest = pose_slice(0)
        remaining = np.r_[0:CALIBRATION_SIZE, oldest.stop : len(self.covariance)]
        past = self.past.append(self.poses[0], self.covariance, self.common, oldest)
        return replace(
            self,
            poses=self.poses[1:],
            covariance=self.covariance[np.ix_(remaining, remaining)],
            common=self.common[remaining],
            past=replace(past, cross=past.cross[:, remaining]),
        )

    def add_loop_constraint(self, index: int, T_past_last: np.ndarray, covariance: np.ndarray) -> Self:
        """Posterior when the last pose has been measured relative to a marginalised one: a loop is closed.

        Args:
            index: of the marginalised pose.
            T_past_last: (4, 4) the last pose relative to it, as measured.
            covariance: (6, 6) of that, perturbed from the left in the world.
        """
        difference = loop_difference(self, index, T_past_last)
        step, posterior, common, past = self.past.add_loop_constraint(
            self.covariance, self.common, index, difference, covariance
        )
        return replace(self.moved(step, posterior, common), past=past)

    def without_poses(self) -> Self:
        """What is known of the calibration alone."""
        covariance, common = self.covariance[CALIBRATION, CALIBRATION], self.common[CALIBRATION]
        return type(self)(self.calibration, np.zeros((0, 4, 4)), covariance, common, PastPoses.empty())


def loop_difference(state: WindowState, index: int, T_past_last: np.ndarray) -> np.ndarray:
    """(6,) by which the last pose must move in the world to agree with a measurement from a marginalised one."""
    return np.asarray(se3_log(state.past.poses[index] @ T_past_last @ se3_inverse(state.poses[-1])))


def scale_considered(state: WindowState, growth: np.ndarray) -> WindowState:
    """The same where considered errors of the calibration are larger by factors (15,)."""
    return replace(state, common=state.common * growth, past=replace(state.past, common=state.past.common * growth))


def scale_variances(state: WindowState, factor: float) -> WindowState:
    """The same means with so many times the variance, but for considered errors."""
    past = replace(state.past, covariance=factor * state.past.covariance, cross=factor * state.past.cross)
    return replace(state, covariance=factor * state.covariance, past=past)
