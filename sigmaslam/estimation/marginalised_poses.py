"""Poses of keyframes that left the window, correlated with it and with each other: what a loop corrects beside it.

A chain of relative poses would not do. What happened from keyframe to keyframe is measured by landmarks that several of
them share, so that the errors of successive steps nearly cancel: on a simulated lap of 180 m the covariances of the
steps add up to four to eight times what they make together. So the covariance of all of them is kept.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, skew, turn_covariance


@dataclass(frozen=True, slots=True)
class PastPoses:
    """Remembered poses, jointly Gaussian with a window's state.

    Attributes:
        poses: (K, 4, 4) T_world_keyframe.
        covariance: (6 K, 6 K) of them, perturbed from the left in the world, as far as it comes from matches and
            motion.
        cross: (6 K, n) covariance with the window's state.
        common: (6 K, 15) how considered errors of the calibration, of variance one, enter their errors.
    """

    poses: np.ndarray
    covariance: np.ndarray
    cross: np.ndarray
    common: np.ndarray

    @classmethod
    def empty(cls) -> Self:
        """None, beside a window without keyframes."""
        none = np.zeros((0, CALIBRATION_SIZE))
        return cls(np.zeros((0, 4, 4)), np.zeros((0, 0)), none, none)

    @property
    def whole_covariance(self) -> np.ndarray:
        """(6 K, 6 K) with the part of the considered errors."""
        return np.asarray(self.covariance + self.common @ self.common.T)

    def __len__(self) -> int:
        return len(self.poses)

    def relative(self, index: int) -> np.ndarray:
        """(K, 6, 6) covariance of the pose `index` relative to each, with the part of the considered errors."""
        place, whole = past_slice(index), self.whole_covariance
        blocks = whole.reshape(len(self), 6, len(self), 6)
        each = blocks[np.arange(len(self)), :, np.arange(len(self))]
        across = blocks[:, :, index]
        return np.asarray(each + whole[place, place] - across - across.transpose(0, 2, 1))

    def closest(self, index: int, others: list[int] | None = None, per_metre: float = 0.0) -> int:
        """Of the other poses (of all by default) the one relative to which the place of this one is known best.

        Where many know it as well, the nearest: a standard deviation of `per_metre` is added by distance.
        """
        lever = point_lever(self.poses[index, :3, 3][None])[0]
        doubt = np.trace(lever @ self.relative(index) @ lever.T, axis1=1, axis2=2)
        doubt = doubt + per_metre**2 * ((self.poses[:, :3, 3] - self.poses[index, :3, 3]) ** 2).sum(axis=1)
        candidates = np.array([k for k in (range(len(self)) if others is None else others) if k != index])
        return int(candidates[doubt[candidates].argmin()])

    def relative_to(self, window: np.ndarray, common: np.ndarray, index: int) -> np.ndarray:
        """(6, 6) covariance of the window's last pose relative to the pose `index`, with the considered errors' part.

        Args:
            window, common: (n, n), (n, 15) of its state.
            index: of the past pose.
        """
        place, last = past_slice(index), slice(len(window) - 6, len(window))
        across, apart = self.cross[place, last], common[last] - self.common[place]
        return np.asarray(window[last, last] + self.covariance[place, place] - across - across.T + apart @ apart.T)

    def grow(
        self, window: np.ndarray, step_covariance: np.ndarray, walk: np.ndarray, origin: int | None
    ) -> tuple[np.ndarray, Self]:
        """Covariance of the window, and these, when a pose is appended there.

        Args:
            window: (n, n) covariance before.
            step_covariance: (6, 6) of the new pose relative to the last one.
            walk: (15,) variances that the calibration gains.
            origin: the pose of these that takes the place of the last one, where the window has none.
        """
        size = len(window)
        grown = np.zeros((size + 6, size + 6))
        grown[:size, :size] = window
        grown[range(CALIBRATION_SIZE), range(CALIBRATION_SIZE)] += walk
        across = np.zeros((len(self.cross), 6))
        if size > CALIBRATION_SIZE:
            last = slice(size - 6, size)
            grown[size:, :size], grown[size:, size:], across = window[last], window[last, last], self.cross[:, last]
        elif origin is not None:
            place = past_slice(origin)
            grown[size:, :size], grown[size:, size:] = self.cross[place], self.covariance[place, place]
            across = self.covariance[:, place]
        grown[:size, size:] = grown[size:, :size].T
        grown[size:, size:] += step_covariance
        return grown, replace(self, cross=np.concatenate([self.cross, across], axis=1))

    def add_loop_constraint(
        self, window: np.ndarray, common: np.ndarray, index: int, difference: np.ndarray, covariance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, Self]:
        """Posterior when the window's last pose has been measured relative to the pose `index`.

        Args:
            window, common: (n, n), (n, 15) of its state before.
            index: of the old pose.
            difference: (6,) by which the two should move against each other.
            covariance: (6, 6) of that.
        Returns:
            (n,) step of the window's state, its covariance (n, n) and `common` (n, 15), and these.
        """
        old, last = past_slice(index), slice(len(window) - 6, len(window))
        # Covariances of the states with the difference that is measured: the last pose less the old one.
        by_window = window[:, last] - self.cross[old].T
        by_past = self.cross[:, last] - self.covariance[:, old]
        innovation = by_window[last] - by_past[old] + covariance
        gain = np.linalg.lstsq(innovation, by_window.T, rcond=1e-12)[0].T
        past_gain = np.linalg.lstsq(innovation, by_past.T, rcond=1e-12)[0].T
        root = matrix_root(window - gain @ by_window.T)
        apart = common[last] - self.common[old]
        past = self.moved(
            past_gain @ difference,
            self.covariance - past_gain @ by_past.T,
            self.cross - past_gain @ by_window.T,
            self.common - past_gain @ apart,
        )
        return gain @ difference, root @ root.T, common - gain @ apart, past

    def drop(self, index: int) -> Self:
        """Those but one."""
        rest = np.delete(np.arange(6 * len(self)), past_slice(index))
        poses = np.delete(self.poses, index, axis=0)
        return type(self)(poses, self.covariance[np.ix_(rest, rest)], self.cross[rest], self.common[rest])

    def append(self, pose: np.ndarray, window: np.ndarray, common: np.ndarray, place: slice) -> Self:
        """These and a pose of the window, which stays there; window (n, n) and common (n, 15) are of its state."""
        across = self.cross[:, place]
        covariance = np.block([[self.covariance, across], [across.T, window[place, place]]])
        return type(self)(
            np.concatenate([self.poses, pose[None]]),
            covariance,
            np.concatenate([self.cross, window[place]]),
            np.concatenate([self.common, common[place]]),
        )

    def moved(self, step: np.ndarray, covariance: np.ndarray, cross: np.ndarray, common: np.ndarray) -> Self:
        """The poses moved by (6 K,), with other errors."""
        poses = nearest_rigid(se3_exp(step.reshape(-1, 6)) @ self.poses)
        if covariance is not self.covariance:
            covariance = 0.5 * (covariance + covariance.T)
        return type(self)(poses, covariance, cross, common)

    def given(self, factor: np.ndarray, common: np.ndarray, information: np.ndarray, vector: np.ndarray) -> Self:
        """Their posterior when something is learned about the window.

        Args:
            factor, common: (n, k), (n, 15) of its state before, whose covariance is factor factor^T.
            information, vector: (n, n), (n,) of what is learned: a factor exp(-x^T information x / 2 + vector^T x).
        """
        if not len(self):
            return self
        lower = np.linalg.cholesky(np.eye(len(factor.T)) + factor.T @ information @ factor)
        reduced = np.linalg.solve(lower, factor.T)
        half = np.linalg.solve(lower, factor.T @ information @ self.cross.T)
        cross = self.cross - half.T @ reduced
        return self.moved(
            cross @ vector,
            self.covariance - self.cross @ information @ self.cross.T + half.T @ half,
            cross,
            self.common - cross @ (information @ common),
        )


def step_between(past: PastPoses, heir: int, leaving: int) -> tuple[np.ndarray, np.ndarray]:
    """(4, 4) T_heir_leaving of two poses, and its covariance (6, 6), perturbed from the left in the heir."""
    back = se3_inverse(past.poses[heir])
    return back @ past.poses[leaving], turn_covariance(back, past.relative(leaving)[heir])


def past_slice(index: int) -> slice:
    """Where a pose stands."""
    return slice(6 * index, 6 * index + 6)


def point_lever(points: np.ndarray) -> np.ndarray:
    """(M, 3, 6) how points (M, 3) of the world move with a perturbation from the left."""
    return np.asarray(np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -skew(points)], axis=2))
