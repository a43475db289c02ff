"""Every frame after the fact: frames hang at the keyframes before and after them, and move when these do.

A keyframe's pose is corrected by everything that is seen later, and by loops, as long as it is remembered. What a
frame says of itself is relative to the keyframe before it. It is smoothed with the frames up to the next keyframe, and
takes a share of what that one is corrected by relative to the first.
"""

from array import array
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionState
from sigmaslam.estimation.gaussian import regression
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.marginalised_poses import PastPoses, past_slice
from sigmaslam.estimation.motion_smoothing import MotionLink, SmoothedMotion, smooth_motion
from sigmaslam.estimation.published_state import published_state
from sigmaslam.estimation.relative_covariance import relative_to_first
from sigmaslam.geometry.se3 import nearest_rigid, se3_adjoint, se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.table import Table


@dataclass(frozen=True, slots=True)
class HangingFrames(Table):
    """Frames between two keyframes, in the frame of the first; 420 bytes each.

    Attributes:
        step: (N, 4, 4) T_first_frame, for the step from keyframe to keyframe that was last agreed on.
        spread: (N, 6, 6) float32 covariance of it given the two keyframes, perturbed from the left.
        share: (N, 6, 6) float32, of a correction of the second keyframe relative to the first what the frame takes.
    """

    step: np.ndarray
    spread: np.ndarray
    share: np.ndarray

    @classmethod
    def of(cls, step: np.ndarray, spread: np.ndarray, share: np.ndarray) -> Self:
        """From arrays of any precision."""
        return cls(nearest_rigid(step), spread.astype(np.float32), share.astype(np.float32))

    @classmethod
    def at_first(cls, motion: SmoothedMotion) -> Self:
        """Frames that take no share of what the second keyframe is corrected by."""
        return cls.of(motion.step, motion.covariance, np.zeros_like(motion.covariance))

    def corrected(self, correction: np.ndarray) -> Self:
        """The frames when the second keyframe is moved by (6,), perturbed from the left in the first one."""
        return replace(self, step=nearest_rigid(se3_exp(self.share @ correction) @ self.step))

    def handed_over(self, T_heir_first: np.ndarray, residual: np.ndarray) -> Self:
        """The frames in the frame of another first keyframe, the old one being known relative to it.

        Args:
            T_heir_first: (4, 4) step between the two.
            residual: (6, 6) its covariance, perturbed from the left in the heir.
        """
        adjoint = se3_adjoint(T_heir_first)
        share = adjoint @ self.share @ se3_adjoint(se3_inverse(T_heir_first))
        rest = np.eye(6) - share
        spread = adjoint @ self.spread @ adjoint.T + rest @ residual @ rest.transpose(0, 2, 1)
        return self.of(T_heir_first @ self.step, spread, share)

    def between(self, first: int, last: int, keyframes: PastPoses) -> tuple[np.ndarray, np.ndarray]:
        """Poses (N, 4, 4) in the world and covariances (N, 6, 6), perturbed from the left there.

        Args:
            first, last: indices of the two keyframes, which may be the same.
            keyframes: with both.
        """
        pose, one, other = keyframes.poses[first], past_slice(first), past_slice(last)
        adjoint = se3_adjoint(pose)
        share = adjoint @ self.share @ se3_adjoint(se3_inverse(pose))
        weights = np.concatenate([np.eye(6) - share, share], axis=2)
        rows = np.r_[one, other]
        joint = keyframes.covariance[np.ix_(rows, rows)]
        common = weights @ keyframes.common[rows]
        covariance = weights @ joint @ weights.transpose(0, 2, 1) + adjoint @ self.spread @ adjoint.T
        covariance += common @ common.transpose(0, 2, 1)
        return pose @ self.step, covariance


@dataclass(frozen=True, slots=True)
class _Interval:
    """Frames between a keyframe (included) and the next one, and the step T_first_last (4, 4) that goes with them."""

    frames: HangingFrames
    step: np.ndarray

    def settled(self, step: np.ndarray) -> Self:
        """The frames when the step between the keyframes is this one."""
        return replace(self, frames=self.frames.corrected(se3_log(step @ se3_inverse(self.step))), step=step)


class FrameHistory:
    """Keeps of every frame how it hangs at its keyframes.

    Args:
        T_rectified_left: (4, 4) takes points of the left camera into the rectified one.
    """

    def __init__(self, window: KeyframeWindow, keyframes: Keyframes, T_rectified_left: np.ndarray) -> None:
        self._window, self._keyframes = window, keyframes
        self._T_rectified_left = T_rectified_left
        self._timestamps = array("d")
        # Frames whose keyframes are gone: they stay what they were.
        self._settled: list[tuple[np.ndarray, np.ndarray]] = []
        # Keyframes that frames hang at, by time; interval k lies before keyframe k, the links behind the last one.
        self._chain: list[int] = []
        self._intervals: list[_Interval] = []
        self._links: list[MotionLink] = []
        self._began = 0.0
        # All keyframes and their poses after the last frame, and by what those are drawn.
        self._ids: list[int] = []
        self._drawn: list[np.ndarray] = []
        self._state = window.posterior

    def append(self, estimate: Estimate, predicted: MotionState, filtered: MotionState) -> None:
        """Takes a frame; one without a pose has no row in the trajectory.

        Args:
            predicted: motion since the last keyframe before it, without its images.
            filtered: the same with them, or again without where they gave no pose.
        """
        if not estimate.has_pose:
            return
        active, known = self._keyframes.active, [*self._keyframes.remembered, *self._keyframes.active]
        ids = [keyframe.id for keyframe in known]
        if self._chain and not set(self._ids) & set(ids):
            self._settle()
        if not self._chain:
            self._chain, self._began = [active[0].id], active[0].timestamp
            self._intervals = [_Interval(HangingFrames.at_first(smooth_motion([])), np.eye(4))]
        link = MotionLink(estimate.timestamp, predicted, filtered)
        if active[0].timestamp == estimate.timestamp and active[0].id == self._chain[-1]:
            self._links = [_at_keyframe(estimate.timestamp)]
        elif active[-1].id != self._chain[-1]:
            self._close(link, active[-1].id)
        else:
            self._links.append(link)
        for gone in [each for each in self._chain if each not in ids]:
            self._forget(gone, ids)
        self._ids, self._state, self._drawn = ids, published_state(self._window), [each.drawn for each in known]
        self._timestamps.append(estimate.timestamp)

    def final(self) -> tuple[Trajectory, np.ndarray]:
        """All frames with a pose as they are known now.

        Returns:
            Poses of the left camera; the world is the first one's, or the map's. And their covariances (N, 6, 6) in the
            camera's own frame, translation (metres) before rotation (radians).
        """
        parts = [*self._settled, *self._hanging()]
        poses = np.concatenate([np.zeros((0, 4, 4)), *(part[0] for part in parts)])
        covariances = np.concatenate([np.zeros((0, 6, 6)), *(part[1] for part in parts)])
        return Trajectory(np.array(self._timestamps), poses), covariances

    # ---- keyframes come and go

    def _close(self, link: MotionLink, id: int) -> None:
        """A frame became a keyframe: those since the last one are smoothed, and hang between the two from now on."""
        chain = [*self._links, link]
        motion = smooth_motion(chain)
        # What errors of two frames have in common is that of the landmarks, which grows with the way from the keyframe.
        # An error that is much larger at the end is the end's own.
        elapsed = np.array([each.timestamp for each in chain]) - self._began
        size = np.array([np.trace(each.filtered.covariance[:3, :3]) for each in chain])
        share = np.minimum(elapsed / elapsed[-1], size / max(size[-1], np.finfo(float).tiny))[:, None, None]
        frames = HangingFrames.of(motion.step[:-1], motion.covariance[:-1], share[:-1] * np.eye(6))
        self._chain.append(id)
        self._intervals.append(_Interval(frames, link.filtered.step))
        self._links, self._began = [_at_keyframe(link.timestamp)], link.timestamp

    def _forget(self, id: int, ids: list[int]) -> None:
        """A keyframe is remembered no longer, as `ids` are: its frames hang at those before and after it."""
        place = self._chain.index(id)
        keyframes, index = self._state.all_poses, {each: k for k, each in enumerate(self._ids)}
        own = index[id]
        before, after = self._intervals[place], self._intervals[place + 1]
        following = self._chain[place + 1]
        if place:
            heir = index[self._chain[place - 1]]
        else:
            heir = keyframes.closest(
                own, [index[each] for each in self._ids if each in ids and each not in self._chain[2:]]
            )
        step = se3_inverse(keyframes.poses[heir]) @ keyframes.poses[own]
        next_one = index.get(following)
        if next_one is not None:
            after = after.settled(se3_inverse(keyframes.poses[own]) @ keyframes.poses[next_one])
        residual = relative_to_first(keyframes, [heir, own])
        if not place:
            first = self._ids[heir]
            lead, rest = before.frames.handed_over(step, residual), after.frames.handed_over(step, residual)
            if first == following:
                rest = replace(rest, share=np.zeros_like(rest.share))
                self._intervals[:2] = [_Interval(HangingFrames.concatenate([lead, rest]), np.eye(4))]
                del self._chain[0]
            else:
                self._intervals[:2] = [_Interval(lead, np.eye(4)), _Interval(rest, step @ after.step)]
                self._chain[0] = first
            return
        # What a correction of the next keyframe relative to the heir says of the one that is forgotten.
        by_next = np.zeros((6, 6))
        if next_one is not None:
            joint = relative_to_first(keyframes, [heir, own, next_one])
            by_next = regression(joint[:6, 6:], joint[6:, 6:])
            residual = residual - by_next @ joint[6:, :6]
        frames = before.settled(step).frames
        spread = frames.spread + frames.share @ residual @ frames.share.transpose(0, 2, 1)
        frames = HangingFrames.of(frames.step, spread, frames.share @ by_next)
        rest = after.frames.handed_over(step, residual)
        rest = HangingFrames.of(rest.step, rest.spread, by_next + rest.share @ (np.eye(6) - by_next))
        self._intervals[place : place + 2] = [_Interval(HangingFrames.concatenate([frames, rest]), step @ after.step)]
        del self._chain[place]

    def _settle(self) -> None:
        """All keyframes are gone: what hangs at them stays where it is."""
        self._settled += self._hanging()
        self._chain, self._intervals, self._links = [], [], []

    # ---- poses

    def _hanging(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Poses and covariances of the left camera, of all frames that hang at keyframes, in parts."""
        if not self._chain:
            return []
        keyframes, places = self._state.all_poses, [self._ids.index(id) for id in self._chain]
        parts = []
        for first, last, interval in zip([places[0], *places], places, self._intervals, strict=False):
            step = se3_inverse(keyframes.poses[first]) @ keyframes.poses[last]
            parts.append((interval.settled(step).frames, first, last))
        parts.append((HangingFrames.at_first(smooth_motion(self._links)), places[-1], places[-1]))
        placed = [(frames.between(first, last, keyframes), self._drawn[first]) for frames, first, last in parts]
        return [self._in_left_camera(poses, covariances + spread) for (poses, covariances), spread in placed]

    def _in_left_camera(self, poses: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses of the rectified camera in those of the left one, covariances in the camera's own frame."""
        T_left_rectified = se3_inverse(self._T_rectified_left)
        spread = turn_covariance(T_left_rectified, turn_covariance(se3_inverse(poses), covariances))
        return T_left_rectified @ poses @ self._T_rectified_left, 0.5 * (spread + spread.transpose(0, 2, 1))


def _at_keyframe(timestamp: float) -> MotionLink:
    """The frame that is the keyframe."""
    there = MotionState(np.eye(4), np.zeros(6), np.zeros((12, 12)))
    return MotionLink(timestamp, there, there)
