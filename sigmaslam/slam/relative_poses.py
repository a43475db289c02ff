"""The pose of each frame relative to keyframes some way and some time back, as it is known at that frame.

A covariance of absolute poses is relative to the first one, so that errors of the truth's first pose, and everything
since, are in it. What the tracker knows of the way from a keyframe to the frame is sharper, and needs the covariance
between the two, which is forgotten when the next frame comes.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.relative_covariance import frame_relative_to, last_relative_to
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.localisation import Prediction
from sigmaslam.table import Table

# Metres and seconds, from a hand's reach to the length of a street.
DISTANCES, DURATIONS = (1.0, 10.0, 50.0, 100.0), (1.0, 5.0, 20.0)
SPANS = (*(f"{metres:g} m" for metres in DISTANCES), *(f"{seconds:g} s" for seconds in DURATIONS))
"""Names of the distances travelled, and of the times, over which poses are related."""
# A keyframe stands for a span that it misses by less than this factor.
_SLACK = np.sqrt(2.0)


@dataclass(frozen=True, slots=True)
class RelativePoses(Table):
    """Poses of one frame relative to earlier keyframes, a row for each span that has a keyframe.

    Attributes:
        span: (M,) index in `SPANS`.
        timestamp: (M,) of the keyframe, seconds.
        pose: (M, 4, 4) T_keyframe_frame of the left camera; the keyframe's part is what is known of it at the frame.
        covariance: (M, 6, 6) of it in the frame's left camera, translation (metres) before rotation (radians).
    """

    span: np.ndarray
    timestamp: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray

    @classmethod
    def empty(cls) -> Self:
        """No row."""
        return cls(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 4, 4)), np.zeros((0, 6, 6)))


class RelativePoseReporter:
    """Relates frames to the keyframes that the window and its past hold; changes nothing.

    Args:
        T_rectified_left: (4, 4) takes points of the left camera into the rectified one.
    """

    def __init__(
        self, T_rectified_left: np.ndarray, window: KeyframeWindow, keyframes: Keyframes, motion: MotionFilter
    ) -> None:
        self._T_rectified_left = T_rectified_left
        self._window, self._keyframes, self._motion = window, keyframes, motion
        # Path length, metres, at the keyframes of this run by their numbers, and where the last one was.
        self._paths: dict[int, float] = {}
        self._path, self._last_position = 0.0, np.zeros(3)
        # Of the keyframes that poses can be related to: (K,) place behind each other, time stamp, path length.
        self._index, self._times, self._lengths = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)

    def report(self, timestamp: float, state: WindowState, fit: FrameFit | None, spread: np.ndarray) -> RelativePoses:
        """Relates a frame to the keyframes nearest to each span, if they are near.

        Args:
            timestamp: of the frame, seconds.
            state: of the window, with poses, as it is published.
            fit: its fit to that; None: the last keyframe moved on, be it the frame itself or a prediction.
            spread: (6, 6) by which doubts make the frame's pose less certain, which a fit knows already.
        """
        self._note_keyframes()
        prediction = Prediction.of(self._window, self._motion)
        pose = prediction.pose if fit is None else fit.pose
        travelled = self._path + np.linalg.norm(pose[:3, 3] - state.poses[-1, :3, 3])
        spans, chosen = _choose(travelled - self._lengths, timestamp - self._times)
        if not len(spans):
            return RelativePoses.empty()
        index = self._index[chosen]
        if fit is None:
            earlier, covariance = last_relative_to(state, index)
            covariance = covariance + prediction.covariance + spread
        else:
            earlier, covariance = frame_relative_to(state, fit.joint, index)
            # What the fit was inflated by is the frame's alone.
            covariance = covariance + (fit.covariance - fit.joint.covariance[-6:, -6:])
        T_left_rectified = se3_inverse(self._T_rectified_left)
        adjoint = se3_adjoint(T_left_rectified) @ se3_adjoint(se3_inverse(pose))
        covariance = adjoint @ covariance @ adjoint.T
        return RelativePoses(
            spans,
            self._times[chosen],
            T_left_rectified @ se3_inverse(earlier) @ pose @ self._T_rectified_left,
            0.5 * (covariance + covariance.transpose(0, 2, 1)),
        )

    def _note_keyframes(self) -> None:
        """Takes note of new keyframes, and forgets those that the tracker has forgotten; a map's are not noted."""
        active = self._keyframes.active
        if active[-1].id in self._paths:
            return
        for keyframe, pose in zip(active, self._window.posterior.poses, strict=True):
            if keyframe.id not in self._paths:
                if self._paths:
                    self._path += float(np.linalg.norm(pose[:3, 3] - self._last_position))
                self._paths[keyframe.id], self._last_position = self._path, pose[:3, 3]
        known = [*self._keyframes.remembered, *active]
        rows = [(k, each) for k, each in enumerate(known) if each.id in self._paths]
        self._index = np.array([k for k, _ in rows])
        self._times = np.array([each.timestamp for _, each in rows])
        self._lengths = np.array([self._paths[each.id] for _, each in rows])
        self._paths = {each.id: self._paths[each.id] for _, each in rows}


def _choose(metres: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Spans that a keyframe stands for, and that keyframe of each; from how far back (K,) keyframes are."""
    share = np.concatenate([metres / np.reshape(DISTANCES, (-1, 1)), seconds / np.reshape(DURATIONS, (-1, 1))])
    nearest = np.abs(share - 1.0).argmin(axis=1)
    found = share[np.arange(len(share)), nearest]
    spans = np.flatnonzero((found > 1.0 / _SLACK) & (found < _SLACK))
    return spans, nearest[spans]
