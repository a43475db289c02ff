"""Poses of keyframes that left the window, correlated with it and with each other: what a loop corrects beside it.

A chain of relative poses would not do. What happened from keyframe to keyframe is measured by landmarks that several of
them share, so that the errors of successive steps nearly cancel: on a simulated lap of 180 m the covariances of the
steps add up to four to eight times what they make together. So the covariance of all of them is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.gaussian import matrix_root
from sigmaslam.rotation import nearest_rigid, se3_exp, skew
from sigmaslam.tables import CALIBRATION_SIZE


@dataclass(frozen=True, slots=True)
class PastPoses:
    """Remembered poses, jointly Gaussian with a window's state.

    Attributes:
        poses: (K, 4, 4) T_world_keyframe.
        covariance: (6 K, 6 K) of them, perturbed from the left in the world.
        cross: (6 K, n) covariance with the window's state.
    """

    poses: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray

    @classmethod
    def empty(cls) -> PastPoses:
        """None, beside a window without keyframes."""
        return cls(np.zeros((0, 4, 4)), np.zeros((0, 0)), np.zeros((0, CALIBRATION_SIZE)))

    def __len__(self) -> int:
        return len(self.poses)

    def relative(self, index: int) -> np.ndarray:
        """(K, 6, 6) covariance of the pose `index` relative to each."""
        own = past_slice(index)
        blocks = self.covariance.reshape(len(self), 6, len(self), 6)
        each = blocks[np.arange(len(self)), :, np.arange(len(self))]
        across = blocks[:, :, index]
        return np.asarray(each + self.covariance[own, own] - across - across.transpose(0, 2, 1))

    def closest(self, index: int) -> int:
        """The other pose relative to which the place of this one is known best."""
        lever = point_lever(self.poses[index, :3, 3][None])[0]
        doubt = np.trace(lever @ self.relative(index) @ lever.T, axis1=1, axis2=2)
        doubt[index] = np.inf
        return int(doubt.argmin())

    def drop(self, index: int) -> PastPoses:
        """Those but one."""
        rest = np.delete(np.arange(6 * len(self)), past_slice(index))
        return PastPoses(np.delete(self.poses, index, axis=0), self.covariance[np.ix_(rest, rest)], self.cross[rest])

    def append(self, pose: np.ndarray, window: np.ndarray, place: slice) -> PastPoses:
        """These and a pose of the window, which stays there; window (n, n) is its covariance."""
        across = self.cross[:, place]
        covariance = np.block([[self.covariance, across], [across.T, window[place, place]]])
        return PastPoses(
            np.concatenate([self.poses, pose[None]]), covariance, np.concatenate([self.cross, window[place]])
        )

    def moved(self, step: np.ndarray, covariance: np.ndarray, cross: np.ndarray) -> PastPoses:
        """The poses moved by (6 K,), with another covariance."""
        poses = nearest_rigid(se3_exp(step.reshape(-1, 6)) @ self.poses)
        return PastPoses(poses, 0.5 * (covariance + covariance.T), cross)

    def given(self, window: np.ndarray, information: np.ndarray, vector: np.ndarray) -> PastPoses:
        """Their posterior when something is learned about the window.

        Args:
            window: (n, n) covariance of its state before.
            information, vector: (n, n), (n,) of what is learned: a factor exp(-x^T information x / 2 + vector^T x).
        """
        if not len(self):
            return self
        factor = matrix_root(window)
        lower = np.linalg.cholesky(np.eye(len(factor.T)) + factor.T @ information @ factor)
        reduced = np.linalg.solve(lower, factor.T)
        half = np.linalg.solve(lower, factor.T @ information @ self.cross.T)
        return self.moved(
            self.cross @ vector - half.T @ (reduced @ vector),
            self.covariance - self.cross @ information @ self.cross.T + half.T @ half,
            self.cross - half.T @ reduced,
        )


def past_slice(index: int) -> slice:
    """Where a pose stands."""
    return slice(6 * index, 6 * index + 6)


def point_lever(points: np.ndarray) -> np.ndarray:
    """(M, 3, 6) how points (M, 3) of the world move with a perturbation from the left."""
    return np.asarray(np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -skew(points)], axis=2))
