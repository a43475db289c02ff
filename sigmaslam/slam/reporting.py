"""Estimates in the user's camera, from what the filter knows of the rectified one."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.calibration_errors import ERRORS
from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.held_offset import IN_COMMON
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.published_state import published_fit, published_state
from sigmaslam.estimation.state_layout import CALIBRATION, pose_slice
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse, turn_covariance
from sigmaslam.slam.doubt import Doubts
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.eye_timing import EyeTiming
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.inertial_estimate import describe_inertial
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.mapping import KeyframeTracks
from sigmaslam.slam.relative_poses import RelativePoseReporter

# A cause is named when it is more likely than all others together.
_LIKELY = 0.5


@dataclass(frozen=True, slots=True)
class Reporter:
    """Makes estimates of frames.

    Attributes:
        rectifier: of the images that are tracked.
        relative_poses: relates frames to keyframes.
        timing: of the eyes.
    """

    rectifier: StereoRectifier
    window: KeyframeWindow
    keyframes: Keyframes
    motion: MotionFilter
    relative_poses: RelativePoseReporter
    timing: EyeTiming

    def report(
        self,
        timestamp: float,
        status: str,
        matches: GuidedMatches,
        fit: FrameFit | None,
        tracks: KeyframeTracks | None,
        loop: float | None,
        milliseconds: dict[str, float],
        doubts: Doubts,
    ) -> Estimate:
        """What is known after a frame; without a fit by the prediction, without a keyframe nothing."""
        state = published_state(self.window)
        if not len(state):
            return self._report_nothing(timestamp, status, milliseconds)
        doubted = doubts.spread + doubts.published
        # What is wrong is found by the second keyframe: its own pose knew nothing of it.
        has_learned = tracks is not None and len(state) == 2 and bool(self.window.causes)
        if fit is not None and not has_learned:
            # Published alone: a prediction as wide as that would find nothing.
            fit = published_fit(self.window, fit).spread_by(doubted)
            pose, absolute, relative = fit.pose, fit.covariance, fit.relative
            by_error, offset = fit.joint.common[-6:], float(fit.calibration[0])
            covariance, part = fit.joint.covariance, slice(-6, None)
        else:
            prediction = Prediction.of(self.window, self.motion)
            covariance, part = state.covariance, pose_slice(len(state) - 1)
            pose, relative = prediction.pose, prediction.covariance if fit is None else fit.relative
            absolute = covariance[part, part] + prediction.covariance + doubted + self.keyframes.active[-1].drawn
            by_error = state.common[part]
            offset = float(state.calibration[0])
        pose, shift = self.window.held_offset.place(pose, offset, covariance, part)
        absolute = absolute + shift
        # The filter knows the rectified camera; users know the left camera of their calibration.
        T_rectified_left = self.rectifier.T_rectified_left
        T_left_rectified = se3_inverse(T_rectified_left)
        adjoint = se3_adjoint(T_left_rectified) @ se3_adjoint(se3_inverse(pose))
        belief = 1.0 - np.sqrt(max(np.linalg.eigvalsh(turn_covariance(se3_inverse(pose), relative))[-1], 0.0))
        drift = self.timing.drift * np.repeat([1.0, 1.0 / self.window.depth], 3)
        matching, by_error = adjoint @ absolute @ adjoint.T + np.diag(drift**2), adjoint @ by_error
        covariance = matching + by_error @ by_error.T
        frame_covariance = adjoint @ relative @ adjoint.T if fit is not None else np.zeros((6, 6))
        covariance, matching = _within_half_turn(covariance), _within_half_turn(matching)
        T_world_camera = T_left_rectified @ pose @ T_rectified_left
        return Estimate(
            timestamp=timestamp,
            T_world_camera=T_world_camera,
            covariance=0.5 * (covariance + covariance.T),
            matching_covariance=0.5 * (matching + matching.T),
            status=status,
            belief=float(np.clip(belief, 0.0, 1.0)),
            matches=len(matches.probability),
            inliers=fit.count if fit is not None else 0,
            nis=fit.nis if fit is not None else 0.0,
            dof=fit.dof if fit is not None else 0,
            calibration=self._describe_calibration(state, fit),
            milliseconds=milliseconds,
            frame_covariance=0.5 * (frame_covariance + frame_covariance.T),
            by_calibration=by_error,
            tracks=tracks,
            # A keyframe is the window's by now, which has learned from it.
            relative_poses=self.relative_poses.report(timestamp, state, fit if tracks is None else None, doubted),
            doubts=tuple(doubts.reasons),
            loop=loop,
            inertial=describe_inertial(self.motion, T_rectified_left[:3, :3], T_world_camera),
        )

    def _report_nothing(self, timestamp: float, status: str, milliseconds: dict[str, float]) -> Estimate:
        """A frame before the first keyframe, which has no pose."""
        anywhere = np.diag(np.full(6, np.inf))
        return Estimate(
            timestamp=timestamp,
            T_world_camera=np.full((4, 4), np.nan),
            covariance=anywhere,
            matching_covariance=anywhere.copy(),
            status=status,
            calibration=self._describe_calibration(published_state(self.window), None),
            milliseconds=milliseconds,
        )

    def _describe_calibration(self, state: WindowState, fit: FrameFit | None) -> CalibrationEstimate:
        """As the last keyframe has it, as a frame's own is forgotten; before the second one as the frame has it."""
        errors, covariance, common = state.calibration, state.covariance, state.common
        if fit is not None and self.window.held_offset.value is None:
            errors, covariance = fit.calibration, fit.joint.covariance
            common = fit.joint.common
        common = common[CALIBRATION]
        sigma = np.sqrt(np.maximum(np.diag(covariance[CALIBRATION, CALIBRATION] + common @ common.T), 0.0))
        chosen = [k for k in np.flatnonzero(self.window.calibration.estimated).tolist() if k]
        if self.window.board_disparity is not None:
            chosen.append(ERRORS.index("baseline"))
        causes = {name: each for name, each in self.window.causes.items() if each.probability > _LIKELY}
        chosen += [k for k in map(ERRORS.index, causes) if k and k not in chosen]
        others = {ERRORS[k]: (float(errors[k]), float(sigma[k])) for k in chosen}
        focal = self.window.camera.fx
        shares = {k: (c.probability, c.mean / focal, float(np.sqrt(c.variance)) / focal) for k, c in causes.items()}
        offset = float(errors[0]), float(np.hypot(sigma[0], IN_COMMON))
        return CalibrationEstimate(*offset, others, shares, self.window.worse, self.rectifier.raised)


def _within_half_turn(covariance: np.ndarray) -> np.ndarray:
    """A covariance (6, 6) whose rotation is less certain than half a turn, as one that knows no more than nothing."""
    sigma = np.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0))
    if sigma < np.pi:
        return covariance
    scale = np.repeat([1.0, np.pi / sigma], 3)
    return np.asarray(scale[:, None] * covariance * scale)
