"""Loops: the newest keyframe sees a place that was left long ago."""

import logging
from dataclasses import dataclass
from typing import Self

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.published_state import with_shown_errors
from sigmaslam.estimation.state_layout import pose_slice
from sigmaslam.estimation.window_state import loop_difference
from sigmaslam.geometry.se3 import se3_body, se3_inverse, turn_covariance
from sigmaslam.slam.keyframe import Keyframe, KnownKeyframe, from_origin
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.place_recognition import VOTING, count_votes, most_alike
from sigmaslam.slam.unguided_matching import UnguidedMatcher

_LOGGER = logging.getLogger(__name__)

# A loop is looked for beyond so many keyframes that left the window last, among those that look less than 60 degrees
# away.
_RECENT, _LOOP_COSINE = 10, 0.5
# Seconds from one look to the next, which teaches hardly more, unless the place is as uncertain as the scene is deep.
_PAUSE = 1.0
# And are nearer than the scene is deep and so many standard deviations of where they are, or such a share of the way
# since, whatever the covariance says: four times what KITTI's drives are off by.
_REACH_SIGMAS, _DRIFT = 3.0, 0.03
# A place that the covariance excludes has more votes than most, by so many standard deviations of a Poisson count.
_STANDS_OUT = 5.0


@dataclass(frozen=True, slots=True)
class _Contradiction:
    """A loop that the covariance excludes: by what a pose (4, 4) should move (6,), and the covariance of that."""

    pose: np.ndarray
    difference: np.ndarray
    covariance: np.ndarray

    def agrees_with(self, earlier: Self, depth: float) -> bool:
        """Whether both say the same (99.99 %), if odometry has been off since by as much as it may be."""
        apart = self.difference - earlier.difference
        since = _DRIFT * np.linalg.norm(self.pose[:3, 3] - earlier.pose[:3, 3])
        drift = turn_covariance(self.pose, np.diag(np.repeat([since, since / depth], 3) ** 2))
        squared = apart @ np.linalg.lstsq(self.covariance + earlier.covariance + drift, apart, rcond=1e-12)[0]
        return bool(squared < CHI_SQUARE_9999_OF_6)


@dataclass(slots=True)
class LoopCloser:
    """Constrains the newest keyframe to one that left the window long ago.

    Attributes:
        window: owns the poses.
        keyframes: of the window and its past.
        matcher: finds keyframes in views.
        looked: when a keyframe was last held against others, time stamp in seconds.
        refused: the last loop that was not used. A second one that agrees with it outweighs the covariance.
    """

    window: KeyframeWindow
    keyframes: Keyframes
    matcher: UnguidedMatcher
    looked: float = -np.inf
    refused: _Contradiction | None = None

    def close(self) -> float | None:
        """Closes a loop where the newest keyframe sees what one of long ago saw.

        Returns:
            The time stamp of that one, seconds; None where there is no loop.
        """
        newest, state = self.keyframes.active[-1], self.window.posterior
        keyframe, drift = self._revisited(newest)
        if keyframe is None:
            return None
        self.looked = newest.timestamp
        relative = self.matcher.confirmed_pose_to(keyframe.view, newest.view)
        # Farther away errors of the calibration move it by more than the matches tell, and the scene hides the place.
        if relative is None or np.linalg.norm(relative.T_key_camera[:3, 3]) > self.window.depth:
            return None
        index, relative = self.keyframes.index(keyframe.origin), from_origin(keyframe, relative)
        pose, measured = state.past.poses[index], relative.T_key_camera
        covariance = turn_covariance(pose @ measured, relative.covariance)
        loop = _Contradiction(state.poses[-1], loop_difference(state, index, measured), covariance)
        departure = np.linalg.norm((se3_inverse(pose) @ state.poses[-1] - measured)[:3, 3])
        confirmed = self.refused is not None and loop.agrees_with(self.refused, self.window.depth)
        confirmed = confirmed and bool(departure < drift) and self.matcher.is_beyond_chance(relative)
        used = self.window.add_loop_constraint(index, measured, covariance, confirmed)
        self.refused = None if used else loop
        if not used:
            return None
        _LOGGER.info("loop closed with the keyframe of %.3f s", keyframe.timestamp)
        return keyframe.timestamp

    def _revisited(self, newest: Keyframe) -> tuple[KnownKeyframe | None, float]:
        """The keyframe of long ago that looks most like the newest, or is nearest; metres of drift since."""
        state = with_shown_errors(self.window)  # where the rig is bad, the place is less certain
        pose, place = state.poses[-1], pose_slice(len(state) - 1)
        sigma = np.sqrt(np.trace(se3_body(pose, state.whole_covariance[place, place])[:3, :3]))
        reach = self.window.depth + _REACH_SIGMAS * sigma
        if newest.timestamp < self.looked + _PAUSE and reach < 2.0 * self.window.depth:
            return None, 0.0
        left = self.keyframes.left_long_ago(_RECENT)
        poses = self.keyframes.poses(self.keyframes.left_long_ago())
        places = np.concatenate([poses[:, :3, 3], pose[None, :3, 3]])
        drift = _DRIFT * np.linalg.norm(np.diff(places, axis=0), axis=1)[::-1].cumsum()[::-1][: len(left)]
        between = se3_inverse(pose) @ poses[: len(left)]
        away, ahead = np.linalg.norm(between[:, :3, 3], axis=1), between[:, 2, 2] > _LOOP_COSINE
        near, possible = ahead & (away < reach), ahead & (away < self.window.depth + drift)
        if not (near | possible).any():
            return None, 0.0
        # Of thousands of keyframes a sample tells what is usual, and those that look most like the newest are asked.
        usual = np.median(count_votes(newest.view, left[:: -(-len(left) // VOTING)]))
        asked = [keyframe for keyframe, is_asked in zip(left, near | possible, strict=True) if is_asked]
        asked = most_alike(newest.view, asked, self.keyframes.appearance)
        votes = dict(zip((each.id for each in asked), count_votes(newest.view, asked), strict=True))
        stands_out = usual + _STANDS_OUT * np.sqrt(usual)
        rows = [k for k, each in enumerate(left) if each.id in votes and (near[k] or votes[each.id] >= stands_out)]
        chosen = max(rows, key=lambda k: (votes[left[k].id], -away[k]), default=None)
        return (None, 0.0) if chosen is None else (left[chosen], float(drift[chosen]))
