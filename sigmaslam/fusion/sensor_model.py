"""What a location sensor reports of our poses, and how its world and its mount are found from nothing.

T_sensor_mark = A G B: A takes our world into the sensor's, G is the pose of what the sensor is on, B where on it. Our
world is the first left camera. G is the camera's pose in it, or, of a followed body, the body's pose T_camera_object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.gaussian import project_covariance
from sigmaslam.geometry.se3 import nearest_rotation, rotation_log, se3_exp, se3_inverse

# Where the error states stand: of the tracker's drift, perturbed from the left in its world, of A and B, from the
# right, and what the last frame's pose is off besides, from the left.
OFFSET, SENSOR_WORLD, MOUNT, OWN = slice(0, 6), slice(6, 12), slice(12, 18), slice(18, 24)
SIZE, WHOLE = 18, 24
_WORLDS = slice(6, 18)
# A way to A and B is taken when A's rotation is known to so many radians, one sigma, and the readings agree with it:
# squared residuals per component, which drift that the tracker does not know of may raise.
_KNOWN_TURN, _WORST_FIT = 0.15, 9.0
_LEAST_READINGS = 4
# Where on the camera or the body the sensor sits, metres, one sigma.
_MOUNT_SIGMA = 1.0
_STEPS, _SETTLED, _SMALL = 10, 1e-5, 1e-4


@dataclass(frozen=True, slots=True)
class SensorModel:
    """The sensor's world and mount.

    Attributes:
        A, B: (4, 4), see above.
        on_object: the tracker's poses are those of a camera in a body's frame; the sensor is on the body.
    """

    A: np.ndarray
    B: np.ndarray
    on_object: bool

    def expect(self, pose: np.ndarray, error: np.ndarray) -> np.ndarray:
        """T_sensor_mark (..., 4, 4) where the tracker has poses (..., 4, 4) and drift, A, B are (..., 18) away."""
        moved = se3_exp(error[..., OFFSET]) @ pose
        G = se3_inverse(moved) if self.on_object else moved
        return np.asarray(self.A @ se3_exp(error[..., SENSOR_WORLD]) @ G @ self.B @ se3_exp(error[..., MOUNT]))

    def moved(self, error: np.ndarray) -> SensorModel:
        """With the error states (18,) taken over."""
        return replace(self, A=self.A @ se3_exp(error[SENSOR_WORLD]), B=self.B @ se3_exp(error[MOUNT]))


def residuals(expected: np.ndarray, position: np.ndarray, rotation: np.ndarray | None) -> np.ndarray:
    """Readings minus what was expected (..., 4, 4): (..., 3) metres, or (..., 6) with the rotation, radians."""
    apart = position - expected[..., :3, 3]
    if rotation is None:
        return np.asarray(apart)
    turn = rotation_log(np.swapaxes(expected[..., :3, :3], -1, -2) @ rotation)
    return np.concatenate([np.broadcast_to(apart, turn.shape), turn], axis=-1)


@dataclass(frozen=True, slots=True)
class Pairs:
    """Readings with the tracker's poses at their times.

    Attributes:
        poses: (N, 4, 4) of the camera in the tracker's world.
        walked: (N, 6, 6) covariance of their drift, perturbed from the left, growing from one to the next.
        own: (N, 6, 6) of what each is off besides, likewise.
        positions, rotations: (N, 3), (N, 3, 3) or None.
        covariances: (N, m, m) of the readings.
    """

    poses: np.ndarray
    walked: np.ndarray
    own: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray | None
    covariances: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)


@dataclass(frozen=True, slots=True)
class State:
    """What is known.

    Attributes:
        model: the sensor's world and mount.
        offset: (6,) the tracker's drift.
        own: (6,) what the last frame's pose is off besides.
        covariance: (24, 24) of all error states.
    """

    model: SensorModel
    offset: np.ndarray
    own: np.ndarray
    covariance: np.ndarray

    @property
    def turn_sigma(self) -> float:
        """How well the rotation between the worlds is known, radians."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[9:12, 9:12])[-1], 0.0)))


def find_worlds(pairs: Pairs, walked: np.ndarray, on_object: bool, known: SensorModel | None = None) -> State | None:
    """A and B by Gauss-Newton on all pairs at once; None while they do not determine the rotation between the worlds.

    The priors are wide: any turn, ten times the readings' extent, a mount within a metre or so.

    Args:
        pairs: readings and poses.
        walked: (6, 6) covariance of the tracker's error now.
        on_object: of `SensorModel`.
        known: a solution to begin with.
    """
    if len(pairs) < _LEAST_READINGS:
        return None
    G = se3_inverse(pairs.poses) if on_object else pairs.poses
    extent = float(np.sqrt(G[:, :3, 3].var(axis=0).sum()))
    reach = float(np.sqrt(pairs.positions.var(axis=0).sum()))
    if min(extent, reach) <= 0:
        return None
    turn = 0.0 if pairs.rotations is None else np.pi
    prior = np.diag(np.repeat([10.0 * (reach + _MOUNT_SIGMA), np.pi, _MOUNT_SIGMA, turn], 3) ** 2)
    best, least = None, np.inf
    for A, B in _guesses(pairs, G) if known is None else [(known.A, known.B)]:
        solved = _solve(pairs, walked, SensorModel(A, B, on_object), prior)
        if solved[1] < least:
            best, least = solved
    components = pairs.covariances.shape[0] * pairs.covariances.shape[1]
    if best is None or least > _WORST_FIT * components:
        return None
    return best if best.turn_sigma < _KNOWN_TURN else None


def _guesses(pairs: Pairs, G: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """A and B to begin with: from positions with the sensor at the origin, and from how both have turned."""
    places = G[:, :3, 3]
    apart, read = places - places.mean(axis=0), pairs.positions - pairs.positions.mean(axis=0)
    rotations = [_turn_between(apart, read)]
    if pairs.rotations is not None:
        own = rotation_log(G[:, :3, :3] @ G[0, :3, :3].T)
        rotations.append(_turn_between(own, rotation_log(pairs.rotations @ pairs.rotations[0].T)))
    guesses = []
    for R in rotations:
        A, B = np.eye(4), np.eye(4)
        A[:3, :3] = R
        A[:3, 3] = pairs.positions.mean(axis=0) - R @ places.mean(axis=0)
        if pairs.rotations is not None:
            mounts = np.swapaxes(R @ G[:, :3, :3], 1, 2) @ pairs.rotations
            B[:3, :3] = nearest_rotation(mounts.mean(axis=0))
        guesses.append((A, B))
    return guesses


def _turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) that takes the first vectors (N, 3) to the second, in least squares."""
    return nearest_rotation(second.T @ first)


def _solve(pairs: Pairs, walked: np.ndarray, start: SensorModel, prior: np.ndarray) -> tuple[State, float]:
    """Posterior of the tracker's error now, A and B, and the least squares it has."""
    count, width = pairs.covariances.shape[:2]
    # Errors of a random walk: two have in common what the earlier one has.
    shared = pairs.walked[np.minimum(np.arange(count)[:, None], np.arange(count)[None])]
    worlds = np.zeros(SIZE - 6)
    for _ in range(_STEPS):
        model = start.moved(np.concatenate([np.zeros(6), worlds]))
        rest = _rest(model, pairs)
        by_errors = slopes(model, pairs.poses, pairs.positions, pairs.rotations)
        by_offset, by_worlds = by_errors[..., OFFSET], by_errors[..., _WORLDS].reshape(count * width, -1)
        noise = (by_offset[:, None] @ shared @ by_offset.swapaxes(1, 2)[None]).swapaxes(1, 2)
        noise[np.arange(count), :, np.arange(count), :] += pairs.covariances + project_covariance(by_offset, pairs.own)
        noise = noise.reshape(count * width, -1)
        # The residual where the prior's mean would be, if all were linear.
        whole = rest.ravel() + by_worlds @ worlds
        S = noise + by_worlds @ prior @ by_worlds.T
        before, worlds = worlds, prior @ by_worlds.T @ np.linalg.solve(S, whole)
        if np.abs(worlds - before).max() < _SETTLED:
            break
    cross = np.concatenate(
        [np.einsum("ibc,iac->bia", pairs.walked, by_offset).reshape(6, -1), prior @ by_worlds.T], axis=0
    )
    gain = np.linalg.solve(S, cross.T).T
    covariance = np.zeros((WHOLE, WHOLE))
    covariance[OFFSET, OFFSET], covariance[_WORLDS, _WORLDS] = walked, prior
    covariance[:SIZE, :SIZE] -= gain @ cross.T
    model = start.moved(np.concatenate([np.zeros(6), worlds]))
    rest = _rest(model, pairs)
    misfit = float(rest.ravel() @ np.linalg.solve(noise, rest.ravel()))
    return State(model, gain[OFFSET] @ whole, np.zeros(6), 0.5 * (covariance + covariance.T)), misfit


def _rest(model: SensorModel, pairs: Pairs) -> np.ndarray:
    """Residuals (N, m) with the tracker's poses as they are."""
    return residuals(model.expect(pairs.poses, np.zeros(SIZE)), pairs.positions, pairs.rotations)


def slopes(model: SensorModel, poses: np.ndarray, positions: np.ndarray, rotations: np.ndarray | None) -> np.ndarray:
    """(..., m, 18) how what is expected of readings moves with drift, A and B, by central differences.

    Args:
        model: of the sensor.
        poses: (..., 4, 4) of the tracker.
        positions, rotations: (..., 3), (..., 3, 3) or None of the readings.
    """
    count = np.asarray(poses).ndim - 2
    steps = (_SMALL * np.concatenate([np.eye(SIZE), -np.eye(SIZE)])).reshape(2 * SIZE, *[1] * count, SIZE)
    moved = residuals(model.expect(poses, steps), positions, rotations)
    return np.moveaxis((moved[SIZE:] - moved[:SIZE]) / (2.0 * _SMALL), 0, -1)
