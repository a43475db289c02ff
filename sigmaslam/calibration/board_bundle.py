"""Bundle adjustment of one camera or a stereo pair over images of a board, by Levenberg and Marquardt.

The poses of the board are eliminated image by image (Schur complement), so that every image leaves an information
matrix and a gradient of the rig alone: the sum of these is what is solved, and their scatter says how far the corners
of one image are wrong together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.camera import CameraModel
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, skew, transform_points
from sigmaslam.table import Table

INTRINSICS = ("fx", "fy", "cx", "cy")
EXTRINSICS = ("x", "y", "z", "turn_x", "turn_y", "turn_z")

_MAX_STEPS = 60
_CONVERGED = 1e-12
# Of the central differences by which lens models are differentiated, relative to the size of what is varied.
_STEP = 1e-6


@dataclass(frozen=True, slots=True)
class Corners(Table):
    """Corners seen, a row each; rows are ordered by image.

    Attributes:
        image: (N,) number of the image pair.
        eye: (N,) 0 for left, 1 for right.
        points: (N, 3) on the board, metres.
        pixels: (N, 2) where they are seen.
    """

    image: np.ndarray
    eye: np.ndarray
    points: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True, slots=True)
class Rig:
    """One or two cameras.

    Attributes:
        eyes: the cameras, left first.
        T_left_right: (4, 4) takes points of the right camera into the left one, metres; identity for one camera.
    """

    eyes: tuple[CameraModel, ...]
    T_left_right: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters: intrinsics and distortion of each camera, then place and turn of the right camera.

        Place and turn are perturbations of `T_left_right` from the left: metres, and radians.
        """
        names = []
        for name, eye in zip(("left", "right"), self.eyes, strict=False):
            lens = [f"d{k}" for k in range(len(eye.distortion))]
            names += [f"{name}.{each}" for each in (*INTRINSICS, *lens)]
        return (*names, *(f"T_left_right.{each}" for each in EXTRINSICS if len(self.eyes) > 1))

    def moved(self, step: np.ndarray) -> Self:
        """With the parameters changed by (P,)."""
        eyes, used = [], 0
        for eye in self.eyes:
            count = len(INTRINSICS) + len(eye.distortion)
            eyes.append(_changed(eye, step[used : used + count]))
            used += count
        if len(eyes) == 1:
            return replace(self, eyes=tuple(eyes))
        return replace(self, eyes=tuple(eyes), T_left_right=nearest_rigid(se3_exp(step[used:]) @ self.T_left_right))


@dataclass(frozen=True, slots=True)
class BoardBundle:
    """Rig and boards with what the corners say of the rig when all poses of the board are free.

    Attributes:
        poses: (n, 4, 4) T_left_board.
        residuals: (N, 2) seen minus projected, pixels.
        information: (n, P, P) of each image about the rig, for corners with a sigma of 1 px.
        gradient: (n, P) of each image; they sum to zero in the end.
    """

    rig: Rig
    poses: np.ndarray
    residuals: np.ndarray
    information: np.ndarray
    gradient: np.ndarray


def solve_bundle(rig: Rig, poses: np.ndarray, corners: Corners, weights: np.ndarray | None = None) -> BoardBundle:
    """Least squares over rig and poses.

    Args:
        rig: start.
        poses: (n, 4, 4) T_left_board to start from, of images 0 to n - 1, each of which has corners.
        weights: (n,) how often each image counts; once by default.

    Raises:
        CalibrationError: the images leave a parameter open.
    """
    weights = np.ones(len(poses)) if weights is None else weights
    each = weights[corners.image]
    damping = 1e-3
    residuals = _residuals(rig, poses, corners)
    cost = float(each @ np.sum(residuals**2, axis=1))
    for _ in range(_MAX_STEPS):
        step, steps = _step(_linearise(rig, poses, corners, residuals), weights, damping)
        try:
            trial = rig.moved(step), nearest_rigid(se3_exp(steps) @ poses)
        except CalibrationError:
            # A focal length of less than zero.
            damping *= 10.0
            continue
        trial_residuals = _residuals(*trial, corners)
        trial_cost = float(each @ np.sum(trial_residuals**2, axis=1))
        settled = abs(cost - trial_cost) <= _CONVERGED * cost
        if trial_cost <= cost:
            (rig, poses), residuals, cost = trial, trial_residuals, trial_cost
        damping *= 0.1 if trial_cost <= cost else 10.0
        if settled:
            break
    _, _, _, information, gradient = _linearise(rig, poses, corners, residuals)
    return BoardBundle(rig, poses, residuals, information, gradient)


def project_corners(rig: Rig, poses: np.ndarray, corners: Corners) -> np.ndarray:
    """(N, 2) pixels of the corners' points."""
    return corners.pixels - _residuals(rig, poses, corners)


def pose_errors(bundle: BoardBundle, corners: Corners) -> tuple[np.ndarray, np.ndarray]:
    """Of the bundle's T_board_left, from the right: covariances for a known rig, (n, 6, 6) for a sigma of 1 px, and
    by what the rig's parameters move them, (n, 6, P).
    """
    inverse, across, *_ = _linearise(bundle.rig, bundle.poses, corners, bundle.residuals)
    return inverse, across


def _residuals(rig: Rig, poses: np.ndarray, corners: Corners) -> np.ndarray:
    pixels = np.empty((len(corners), 2))
    for k, (_, at) in enumerate(_in_eyes(rig, poses, corners)):
        mine = corners.eye == k
        pixels[mine] = np.where(at[mine, 2:] > 0.0, rig.eyes[k].project(at[mine]), np.inf)
    # A board behind a camera is infinitely wrong, and a step there is not taken.
    return np.nan_to_num(corners.pixels - pixels, nan=1e6, posinf=1e6, neginf=-1e6)


def _in_eyes(rig: Rig, poses: np.ndarray, corners: Corners) -> list[tuple[np.ndarray, np.ndarray]]:
    """For each eye its rotation from the left one, and all points (N, 3) in its frame."""
    T = poses[corners.image]
    left = np.einsum("nij,nj->ni", T[:, :3, :3], corners.points) + T[:, :3, 3]
    frames = [(np.eye(3), left)]
    if len(rig.eyes) > 1:
        T_right_left = se3_inverse(rig.T_left_right)
        frames.append((T_right_left[:3, :3], transform_points(T_right_left, left)))
    return frames


def _linearise(
    rig: Rig, poses: np.ndarray, corners: Corners, residuals: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """By image: C^-1 (n, 6, 6), C^-1 B^T (n, 6, P), C^-1 c (n, 6), and reduced information and gradient of the rig."""
    by_rig, by_pose = np.zeros((len(corners), 2, len(rig.names))), np.zeros((len(corners), 2, 6))
    frames, used = _in_eyes(rig, poses, corners), 0
    left = frames[0][1]
    for k, eye in enumerate(rig.eyes):
        mine = corners.eye == k
        turn, at = frames[k][0], frames[k][1][mine]
        count = len(INTRINSICS) + len(eye.distortion)
        by_rig[mine, :, used : used + count] = _by_intrinsics(eye, at)
        by_left_point = _by_point(eye, at) @ turn
        moves = np.concatenate([np.broadcast_to(np.eye(3), (len(at), 3, 3)), -skew(left[mine])], axis=-1)
        by_pose[mine] = by_left_point @ moves
        if k == 1:
            by_rig[mine, :, -6:] = -by_pose[mine]
        used += count
    starts = np.flatnonzero(np.diff(corners.image, prepend=-1))

    def summed(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.add.reduceat(np.swapaxes(a, -1, -2) @ b, starts, axis=0))

    column = residuals[:, :, None]
    inverse = np.linalg.inv(summed(by_pose, by_pose) + 1e-12 * np.eye(6))
    across, pull = summed(by_pose, by_rig), summed(by_pose, column)
    information = summed(by_rig, by_rig) - np.swapaxes(across, -1, -2) @ inverse @ across
    gradient = summed(by_rig, column) - np.swapaxes(across, -1, -2) @ inverse @ pull
    return inverse, inverse @ across, (inverse @ pull)[..., 0], information, gradient[..., 0]


def _step(system: tuple[np.ndarray, ...], weights: np.ndarray, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Steps of the rig (P,) and of the poses (n, 6)."""
    _, across, pull, information, gradient = system
    matrix, vector = np.tensordot(weights, information, 1), weights @ gradient
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not np.all(scale > 0.0):
        raise CalibrationError("a camera parameter is open: is --board another one? Else take more, the board tilted")
    normal = matrix / np.outer(scale, scale) + damping * np.eye(len(scale))
    step = np.linalg.solve(normal, vector / scale) / scale
    return step, pull - across @ step


def _by_point(eye: CameraModel, points: np.ndarray) -> np.ndarray:
    """(M, 2, 3) derivatives of the pixels by the points."""
    columns = []
    for axis in range(3):
        shift = _STEP * np.eye(3)[axis] * points[:, 2:]
        columns.append((eye.project(points + shift) - eye.project(points - shift)) / (2.0 * _STEP * points[:, 2:]))
    return np.stack(columns, axis=-1)


def _by_intrinsics(eye: CameraModel, points: np.ndarray) -> np.ndarray:
    """(M, 2, 4 + coefficients) derivatives of the pixels by intrinsics and distortion."""
    count = len(INTRINSICS) + len(eye.distortion)
    sizes = _STEP * np.r_[np.full(4, eye.fx), np.ones(len(eye.distortion))]
    columns = []
    for k in range(count):
        step = sizes[k] * np.eye(count)[k]
        difference = _changed(eye, step).project(points) - _changed(eye, -step).project(points)
        columns.append(difference / (2.0 * sizes[k]))
    return np.stack(columns, axis=-1)


def _changed(eye: CameraModel, step: Sequence[float] | np.ndarray) -> CameraModel:
    intrinsics = {name: getattr(eye, name) + float(change) for name, change in zip(INTRINSICS, step, strict=False)}
    distortion = tuple(float(value) for value in np.add(eye.distortion, step[len(INTRINSICS) :]))
    return replace(eye, **intrinsics, distortion=distortion)
