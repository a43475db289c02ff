"""Loops: the newest keyframe sees a place that was left long ago."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.state_layout import pose_slice
from sigmaslam.geometry.se3 import se3_body, se3_inverse, turn_covariance
from sigmaslam.slam.keyframe import KnownKeyframe, from_origin
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.place_recognition import retrieve
from sigmaslam.slam.unguided_matching import UnguidedMatcher

_LOGGER = logging.getLogger(__name__)

# A loop is looked for beyond so many keyframes that left the window last, among those that look less than 60 degrees
# away.
_RECENT, _LOOP_COSINE = 10, 0.5
# Seconds from one look to the next, which teaches hardly more, unless the place is as uncertain as the scene is deep.
_PAUSE = 1.0
# And are nearer than the scene is deep and so many standard deviations of where they are.
_REACH_SIGMAS = 3.0


@dataclass(slots=True)
class LoopCloser:
    """Constrains the newest keyframe to one that left the window long ago.

    Attributes:
        window: owns the poses.
        keyframes: of the window and its past.
        matcher: finds keyframes in views.
        looked: when a keyframe was last held against others, time stamp in seconds.
    """

    window: KeyframeWindow
    keyframes: Keyframes
    matcher: UnguidedMatcher
    looked: float = -np.inf

    def close(self) -> float | None:
        """Closes a loop where the newest keyframe sees what one of long ago saw.

        Returns:
            The time stamp of that one, seconds; None where there is no loop.
        """
        closed, newest = None, self.keyframes.active[-1]
        view = newest.view
        for keyframe in retrieve(view, 1, self._revisited(), self.keyframes.appearance):
            self.looked = newest.timestamp
            relative = self.matcher.relative_pose_to(keyframe.view, view)
            if relative is None:
                continue
            index, relative = self.keyframes.index(keyframe.origin), from_origin(keyframe, relative)
            pose = self.window.posterior.past.poses[index] @ relative.T_key_camera
            covariance = turn_covariance(pose, relative.covariance)
            if self.window.add_loop_constraint(index, relative.T_key_camera, covariance):
                _LOGGER.info("loop closed with the keyframe of %.3f s", keyframe.timestamp)
                closed = keyframe.timestamp
        return closed

    def _revisited(self) -> list[KnownKeyframe]:
        """Keyframes that left the window long ago and should see what its newest one sees."""
        state = self.window.posterior
        pose, place = state.poses[-1], pose_slice(len(state) - 1)
        sigma = np.sqrt(np.trace(se3_body(pose, state.whole_covariance[place, place])[:3, :3]))
        reach = self.window.depth + _REACH_SIGMAS * sigma
        if self.keyframes.active[-1].timestamp < self.looked + _PAUSE and reach < 2.0 * self.window.depth:
            return []

        candidates = self.keyframes.left_long_ago(_RECENT)
        between = se3_inverse(pose) @ self.keyframes.poses(candidates)
        is_near = (np.linalg.norm(between[:, :3, 3], axis=1) < reach) & (between[:, 2, 2] > _LOOP_COSINE)
        return [keyframe for keyframe, near in zip(candidates, is_near, strict=True) if near]
