"""The back end: a window of keyframes whose landmarks are marginalised.

Every keyframe of the window keeps the views of its landmarks. The joint posterior of the keyframes' poses and the
stereo calibration follows from what is known of them without these landmarks (the prior) and from all views at once,
each landmark eliminated from its own equations (the MSCKF's null space by Schur's complement). So every measurement
counts once, a landmark's error is shared by all its views as it should be, and a long track connects all the keyframes
that saw it. A keyframe that leaves the window takes its landmarks along: their views become part of the prior.

Poses are perturbed from the left, in the world: views see relative poses alone, for which a common motion of all is the
same vector everywhere, so that no linearisation point can leak information into what cannot be seen.
"""

import logging
from dataclasses import replace

import numpy as np

from sigmaslam.estimation.calibration_correction import judge_calibration
from sigmaslam.estimation.calibration_errors import CalibrationPrior, measured_errors
from sigmaslam.estimation.calibration_evidence import CalibrationEvidence, Cause
from sigmaslam.estimation.chi_square import CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.estimator_graphs import EstimatorGraphs
from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.estimation.held_offset import HeldOffset
from sigmaslam.estimation.landmark_table import KeyframeViews, LandmarkTable, LandmarkViews
from sigmaslam.estimation.marginalised_poses import PastPoses, point_lever
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, LANDMARK_SIZE, MODELLED, pose_slice
from sigmaslam.estimation.window_equations import eliminate_landmarks, gate_views
from sigmaslam.estimation.window_state import WindowState, loop_difference, scale_variances
from sigmaslam.geometry.camera import RectifiedStereo

_LOGGER = logging.getLogger(__name__)

# Errors of right matches have longer tails than a Gaussian's: degrees of freedom of the Student-t that is fitted.
# 4 and 1 are no better on rendered streets.
_STUDENT_FREEDOM = 2.0
NEVER_AGAIN = np.iinfo(np.int64).max // 2
"""Misses of a landmark that is not to be searched for."""


class KeyframeWindow:
    """Poses of the last keyframes, the stereo calibration, and the landmarks that connect them; owns the state.

    Args:
        calibration: prior of its errors.
        student_freedom: degrees of freedom of the errors' Student-t; infinite: Gaussian.
        usual: prior of a calibration with which nothing is wrong; `calibration` by default.

    Attributes:
        prior: what is known without the landmarks of the window.
        posterior: what is known with them.
        landmarks: estimated with the posterior.
        places: of landmarks, as `landmark_places` remembers them, and of which solution.
        depth: of the scene that the last keyframe sees, metres.
        calibration: prior of its errors, as far as it is known.
        expected: (15,) errors of the calibration about which its prior holds: zero until the rig changes, or something
            else than an offset is found to be wrong.
        evidence: weighs what may be wrong.
        causes: of that, what is not hopeless, by its name.
        foreseen: likewise by frames since the last keyframe, which know more.
        corrected: (2, 15) what considered errors are taken to be, and their standard deviations beside the usual ones.
        held_offset: what the disparity offset is taken to be in poses that are published.
        board_disparity: pixels where a calibration that is off by more than most is right; None until one is.
        exceeded: (15,) bool, estimated errors beyond four standard deviations of their prior.
        worse: factor by which errors that images show are larger than their standard deviations, 1 or more.
        clustering: factor by which errors that neighbours share make variances too small, 1 or more: of poses that are
            published.
    """

    def __init__(
        self,
        camera: RectifiedStereo,
        calibration: CalibrationPrior,
        graphs: EstimatorGraphs,
        student_freedom: float = _STUDENT_FREEDOM,
        usual: CalibrationPrior | None = None,
    ) -> None:
        self.camera = camera
        self.graphs = graphs
        self.student_freedom = student_freedom
        self.calibration = calibration
        self.evidence = CalibrationEvidence(usual or calibration, camera.fx, graphs.condition)
        self.causes: dict[str, Cause] = {}
        self.foreseen: dict[str, Cause] = {}
        self.corrected = np.zeros((2, CALIBRATION_SIZE))
        self.expected, self.exceeded = np.zeros(CALIBRATION_SIZE), np.zeros(CALIBRATION_SIZE, bool)
        self.held_offset = HeldOffset()
        self.board_disparity: float | None = None
        self.worse, self.clustering = 1.0, 1.0
        self.published: tuple[WindowState, tuple[float, float], WindowState] | None = None
        self.prior = self.posterior = WindowState.initial(calibration)
        self.landmarks = LandmarkTable.empty(CALIBRATION_SIZE)
        self.places: tuple[WindowState, np.ndarray, np.ndarray, np.ndarray] | None = None
        self.depth = 1.0
        self._observations = KeyframeViews()
        self._next_id = 0

    def __len__(self) -> int:
        return len(self.posterior)

    def restart(self, past: PastPoses | None = None) -> None:
        """Forgets all poses and landmarks, but not the calibration; `past` are poses of another run to begin with."""
        self.posterior = self.posterior.without_poses()
        if past is not None:
            self.posterior = replace(self.posterior, past=past)
        self.prior = self.posterior
        self.evidence.restart()
        self.landmarks = LandmarkTable.empty(CALIBRATION_SIZE)
        self._observations = KeyframeViews()

    def add_keyframe(
        self,
        pose: np.ndarray,
        step: np.ndarray,
        step_covariance: np.ndarray,
        walk: np.ndarray,
        depth: float,
        origin: int | None = None,
    ) -> None:
        """Adds a keyframe to the end of the window.

        Args:
            pose: (4, 4) estimate of T_world_camera.
            step: (4, 4) T_last_new as it was expected without its images; of the first one T_world_camera.
            step_covariance: (6, 6) of that, perturbed from the left in the world.
            walk: (15,) variances by which the calibration may have moved since the last keyframe.
            depth: of the scene that it sees, metres.
            origin: of the first one, the past pose relative to which `step_covariance` is; the world by default.
        """
        walk = np.where(self.calibration.estimated, walk, 0.0)
        expected = self.prior.poses[-1] @ step if len(self.prior) else step
        self.prior = self.prior.grow(expected, step_covariance, walk, origin)
        self.posterior = self.posterior.grow(pose, step_covariance, walk, origin)
        self.evidence.add_keyframe(step, step_covariance)
        self.depth = depth
        self.landmarks.dependence = np.pad(self.landmarks.dependence, ((0, 0), (0, 0), (0, 6)))

    def add_views(self, views: LandmarkViews) -> None:
        """Takes what the last keyframe sees of landmarks of earlier ones."""
        self._observations = self._observations.append(len(self) - 1, views)

    def add_landmarks(self, feature: np.ndarray, measured: np.ndarray, variance: np.ndarray) -> None:
        """Adds landmarks that the last keyframe sees first.

        Args:
            feature: (K,) index among the keyframe's features.
            measured: (K, 3) (u, v, disparity).
            variance: (K, 4) of these, and of what the disparities are off by in all views alike.
        """
        count = len(feature)
        size = len(self.posterior.covariance)
        variance = np.pad(variance, ((0, 0), (0, LANDMARK_SIZE - MODELLED)), constant_values=1.0)
        new = LandmarkTable(
            np.full(count, len(self) - 1),
            feature,
            np.pad(measured, ((0, 0), (0, LANDMARK_SIZE - 3))),
            variance,
            np.pad(measured, ((0, 0), (0, LANDMARK_SIZE - 3))),
            np.eye(LANDMARK_SIZE) * variance[:, None, :],
            np.zeros((count, LANDMARK_SIZE, size)),
            np.ones(count, np.int64),
            np.zeros(count, np.int64),
            self._next_id + np.arange(count),
            np.zeros(count),
        )
        self._next_id += count
        self.landmarks = LandmarkTable.concatenate([self.landmarks, new])

    def count_sightings(self, searched: np.ndarray, seen: np.ndarray, moving: np.ndarray | None = None) -> None:
        """Notes which landmarks a frame searched for and which of them it saw, all by row.

        Those that move on their own are not searched for again, nor in the map, and their views leave the window.
        """
        if moving is not None:
            self.landmarks.misses[moving], self.landmarks.views[moving] = NEVER_AGAIN, 0
            self._observations = self._observations.select(~np.isin(self._observations.views.landmark, moving))
        self.landmarks.misses[searched] += 1
        self.landmarks.misses[seen] = 0
        self.landmarks.views[seen] += 1

    def solve(self, iterations: int = 2) -> None:
        """Posterior of poses, calibration and landmarks from the prior and all views: Gauss-Newton, then a gate."""
        factor = matrix_root(self.prior.covariance)
        for _ in range(iterations):
            information, vector, rows, landmarks = eliminate_landmarks(self, self._observations)
            offset = self.posterior.minus(self.prior)
            vector = vector + information @ offset
            learned = {"factor": factor, "information": information, "vector": vector, "common": self.prior.common}
            state, covariance, common = self.graphs.condition(learned)
            step = state - offset
            self.posterior = self.posterior.moved(step, covariance, common)
            if len(rows):
                self.landmarks.covariance[rows], self.landmarks.dependence[rows], own_step = landmarks
                self.landmarks.estimate[rows] += own_step + self.landmarks.dependence[rows] @ step
        past = self.prior.past.given(factor, self.prior.common, information, vector)
        self.posterior = replace(self.posterior, past=past)
        agree = gate_views(self, self._observations)
        if not agree.all():
            self._observations = self._observations.select(agree)
        self.evidence.learn(self.prior, information, vector)
        judge_calibration(self)

    def add_loop_constraint(
        self, index: int, T_past_last: np.ndarray, covariance: np.ndarray, confirmed: bool = False
    ) -> bool:
        """Closes a loop: the last keyframe sees what a past pose saw, and the past is corrected with the window.

        Args:
            index: of the past pose.
            T_past_last: (4, 4) the last keyframe's pose relative to that one.
            covariance: (6, 6) of that, perturbed from the left in the world.
            confirmed: another loop says the same: where it contradicts what is known, all that is known of poses is
                less certain than it seemed, by the variance of unit weight.
        Returns:
            False, and nothing is changed, where it contradicts what is known, or says less than is known already.
        """
        posterior = self.posterior
        known = posterior.past.relative_to(posterior.covariance, posterior.common, index)
        # What the old keyframe was measured with is the same in all its matches: they must not be counted without end.
        lever = point_lever(posterior.poses[-1:, :3, 3])[0]
        if np.trace(lever @ known @ lever.T) < np.trace(lever @ covariance @ lever.T):
            return False
        difference = loop_difference(posterior, index, T_past_last)
        squared = difference @ np.linalg.lstsq(known + covariance, difference, rcond=1e-12)[0]
        if squared > CHI_SQUARE_9999_OF_6:
            if not confirmed:
                return False
            _LOGGER.warning("two loops contradict the poses by %.1f of their standard deviations", np.sqrt(squared / 6))
            self.prior = scale_variances(self.prior, squared / 6)
        before = self.prior
        self.prior = before.add_loop_constraint(index, T_past_last, covariance)
        self.evidence.move_poses(self.prior.minus(before))
        self.solve()
        return True

    def marginalise_oldest(self) -> np.ndarray:
        """Drops the oldest keyframe to the past; its landmarks' views become part of the prior.

        Returns:
            (L,) new row of each landmark, -1 for those that are gone.
        """
        leaving = self.landmarks.anchor == 0
        observed = leaving[self._observations.views.landmark]
        information, vector, *_ = eliminate_landmarks(self, self._observations.select(observed))
        vector = vector + information @ self.posterior.minus(self.prior)
        self.evidence.marginalise_oldest(self.prior, information, vector)
        self.prior = self.prior.given(information, vector, self.graphs.condition).marginalise_oldest()
        self.posterior = self.posterior.marginalise_oldest()
        new_row = np.where(leaving, -1, np.cumsum(~leaving) - 1)
        self._observations = self._observations.without_oldest(new_row)
        oldest, size = pose_slice(0), self.landmarks.dependence.shape[2]
        remaining = np.r_[0 : oldest.start, oldest.stop : size]
        self.landmarks = self.landmarks.select(~leaving)
        self.landmarks.anchor = self.landmarks.anchor - 1
        self.landmarks.dependence = self.landmarks.dependence[:, :, remaining]
        return new_row

    def forget_past(self, index: int) -> None:
        """Forgets a pose that left the window."""
        self.prior, self.posterior = (
            replace(state, past=state.past.drop(index)) for state in (self.prior, self.posterior)
        )

    def as_calibrated(self, measured: np.ndarray) -> np.ndarray:
        """(u, v, disparity) (K, 3) without errors of the calibration, and of landmarks (K, 6) their own errors."""
        uvd = measured[:, :3] - measured_errors(self.camera, measured[:, :3]) @ self.posterior.calibration
        uvd[:, 2] -= measured[:, 3:MODELLED].sum(axis=1)
        return np.asarray(uvd)
