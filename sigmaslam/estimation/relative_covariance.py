"""Poses relative to earlier keyframes of a window or its past, as the joint Gaussian has them.

Differences of perturbations from the left do not know where the world is. They are formed before anything is
conditioned on a frame's views, which see nothing else: what poses have in common may be known a million times worse.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sigmaslam.estimation.frame_fit import FramePosterior
from sigmaslam.estimation.marginalised_poses import PastPoses, past_slice
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, pose_slice
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import se3_adjoint, se3_exp, se3_inverse


def last_relative_to(state: WindowState, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Earlier poses, and how well the window's last pose is known relative to them.

    Args:
        state: of a window with poses.
        index: (M,) of earlier poses, M > 0, those of the past before those of the window.
    Returns:
        (M, 4, 4) T_world_earlier, and (M, 6, 6) covariance of the last pose relative to each, perturbed from the left
        in the world.
    """
    earlier = _Earlier.of(state, index)
    apart = earlier.common_apart(state)
    return earlier.poses, earlier.covariance_of_last(state) + apart @ apart.transpose(0, 2, 1)


def frame_relative_to(state: WindowState, frame: FramePosterior, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Earlier poses, and how well a frame's pose is known relative to them; both follow what the frame's views say.

    Args:
        state: of the window that the frame has been fitted to.
        index: as of `last_relative_to`.
    Returns:
        (M, 4, 4) T_world_earlier, and (M, 6, 6) covariance of the frame's pose relative to each, perturbed from the
        left in the world.
    """
    earlier = _Earlier.of(state, index)
    size, last = len(state.covariance), pose_slice(len(state) - 1)
    # The error state with all poses relative to the window's last one.
    relative = np.eye(size + 6)
    relative[CALIBRATION_SIZE:, last] -= np.tile(np.eye(6), (len(state) + 1, 1))
    spread = relative @ frame.covariance @ relative.T
    prior = np.zeros((len(index), 6, size + 6))
    prior[:, :, :size] = (earlier.cross - state.covariance[last]) @ relative[:size, :size].T
    gain = prior @ frame.information
    posterior = prior - gain @ spread
    apart = frame.common[size:] - frame.common[last] - earlier.common_apart(state) + gain @ frame.common
    own = earlier.covariance_of_last(state) - gain @ posterior.transpose(0, 2, 1)
    across = posterior[:, :, size:]
    poses = se3_exp(frame.step[last] + prior @ frame.score) @ earlier.poses
    return poses, own + spread[size:, size:] - across - across.transpose(0, 2, 1) + apart @ apart.transpose(0, 2, 1)


def relative_to_first(poses: PastPoses, indices: list[int]) -> np.ndarray:
    """(6 M, 6 M) covariance of M poses relative to the first of M + 1 indices, perturbed from the left in it.

    As far as it comes from matches and motion.
    """
    rows = np.concatenate([np.arange(6 * index, 6 * index + 6) for index in indices])
    adjoint = se3_adjoint(se3_inverse(poses.poses[indices[0]]))
    by_first = np.tile(-adjoint, (len(indices) - 1, 1))
    slope = np.concatenate([by_first, np.kron(np.eye(len(indices) - 1), adjoint)], axis=1)
    return np.asarray(slope @ poses.covariance[np.ix_(rows, rows)] @ slope.T)


@dataclass(frozen=True, slots=True)
class _Earlier:
    """Poses (M, 4, 4) of keyframes: their `own` covariances (M, 6, 6), and those with the window's state (M, 6, n).

    `common` (M, 6, 15) is how considered errors of the calibration enter their errors.
    """

    poses: np.ndarray
    own: np.ndarray
    cross: np.ndarray
    common: np.ndarray

    @classmethod
    def of(cls, state: WindowState, index: np.ndarray) -> Self:
        """Those of the past and of the window, in this order."""
        past, poses, own, cross, common = state.past, [], [], [], []
        for k in index:
            if k < len(past):
                place = past_slice(k)
                poses.append(past.poses[k])
                own.append(past.covariance[place, place])
                cross.append(past.cross[place])
                common.append(past.common[place])
            else:
                place = pose_slice(k - len(past))
                poses.append(state.poses[k - len(past)])
                own.append(state.covariance[place, place])
                cross.append(state.covariance[place])
                common.append(state.common[place])
        return cls(np.array(poses), np.array(own), np.array(cross), np.array(common))

    def common_apart(self, state: WindowState) -> np.ndarray:
        """(M, 6, 15) how considered errors enter these poses relative to the window's last one."""
        return np.asarray(self.common - state.common[pose_slice(len(state) - 1)])

    def covariance_of_last(self, state: WindowState) -> np.ndarray:
        """(M, 6, 6) of the window's last pose relative to each, as far as it comes from matches and motion."""
        last = pose_slice(len(state) - 1)
        across = self.cross[:, :, last]
        return np.asarray(self.own + state.covariance[last, last] - across - across.transpose(0, 2, 1))
