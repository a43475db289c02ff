"""Looks at a pose that images gave for what speaks against it."""

from __future__ import annotations

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.gaussian import step_with
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.prediction_errors import surprise, time_error
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse, se3_log
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.second_motion import SecondMotion, find_second_motion


class Scrutiny:
    """Collects doubts in poses, frame by frame.

    Args:
        window, motion, clock: of the tracker.
        input_is_wrong: a check of the input found that the eyes do not fit.
    """

    def __init__(self, window: KeyframeWindow, motion: MotionFilter, clock: FrameClock, input_is_wrong: bool) -> None:
        self._window, self._motion, self._clock = window, motion, clock
        self._last_error = 0.0
        self._input_is_wrong = input_is_wrong

    def doubt(self, matches: GuidedMatches, fit: FrameFit) -> Doubts:
        """What speaks against a pose, before motion and map learn from it; the prediction becomes less certain by a
        wrong time."""
        doubts = Doubts()
        if self._input_is_wrong:
            doubts.add(Doubt.INPUT)
        for index in np.flatnonzero(self._window.exceeded).tolist():
            doubts.add(Doubt.OFFSET, _without_error(self._window, fit, index))
        self._doubt_prediction(doubts, fit)
        second = find_second_motion(self._window, matches, fit)
        # A body before the scene that never stood still is no rival of it.
        if second is not None and (second.stood_still or not second.stands_before) and not self._is_other(second, fit):
            doubts.add(Doubt.MOTIONS, se3_log(second.pose @ se3_inverse(fit.pose)))
            doubts.is_ambiguous = True
        return doubts

    def _is_other(self, second: SecondMotion, fit: FrameFit) -> bool:
        """Whether a sensor of motion rules the second motion out, and not the pose."""
        if dead_reckoning(self._motion) is None:
            return False
        prediction = Prediction.of(self._window, self._motion)
        return prediction.excludes(second.pose) and not prediction.excludes(fit.pose)

    def _doubt_prediction(self, doubts: Doubts, fit: FrameFit) -> None:
        key = self._window.posterior.poses[-1]
        step = se3_inverse(key) @ fit.pose
        error = time_error(self._motion, step, self._clock.interval)
        # What goes on is an acceleration: images out of order jump to and fro.
        if error * self._last_error < 0.0 or (error != 0.0 and self._last_error == 0.0):
            doubts.add(Doubt.TIME, se3_adjoint(key) @ self._motion.doubt_time(error * self._clock.interval))
            doubts.prediction_is_wrong = True
        elif (excess := surprise(self._motion, step)) > 1.0:
            self._motion.widen(excess)
            doubts.prediction_is_wrong = True
        self._last_error = error


def _without_error(window: KeyframeWindow, fit: FrameFit, index: int) -> np.ndarray:
    """(6,) spread of a pose that stands on an error of the calibration which may as well stand for something else.

    A delay between the eyes, say, makes up an offset. With even odds that there is none the second moment about the
    pose is half of the squared step between the two.
    """
    change = fit.calibration[index] - window.expected[index]
    return np.sqrt(0.5) * step_with(fit.joint.covariance, slice(-6, None), index, change)
