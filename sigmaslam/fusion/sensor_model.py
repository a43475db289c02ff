"""Measurement model of a location sensor, and the solution for its world and its mount without a first guess.

T_sensor_mark = A G B. A takes the tracker's world, the first left camera, into the sensor's world. G is the pose of the
carrier of the sensor: the camera's pose in the tracker's world, or the pose T_camera_object of a followed body. B is
the mount, the pose of the sensor on its carrier.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.gaussian import project_covariance, renew_part
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.geometry.se3 import nearest_rotation, rigid_motion, rotation_log, se3_exp, se3_inverse
from sigmaslam.table import Table

# Slices of the error states. The tracker's drift and the error of the last frame perturb from the left in the tracker's
# world; A and B are perturbed from the right. Errors of the tracker's calibration have variance one at first.
DRIFT, SENSOR_WORLD, MOUNT = slice(0, 6), slice(6, 12), slice(12, 18)
CALIBRATION, FRAME_ERROR = slice(18, 18 + CALIBRATION_SIZE), slice(18 + CALIBRATION_SIZE, 24 + CALIBRATION_SIZE)
# A reading depends on the first 18 states: the tracker's error, of which only the drift is one of them, A and B.
MODEL_SIZE, STATE_SIZE = 18, FRAME_ERROR.stop
WORLDS, _SOLVED = slice(6, 18), slice(0, CALIBRATION.stop)
# A solution for A and B is accepted if the standard deviation of A's rotation, radians, and the squared residuals per
# component are at most these. Drift beyond the tracker's covariance may raise the residuals.
_MAX_ROTATION_SIGMA, _MAX_MISFIT = 0.15, 9.0
_MIN_READINGS = 4
# The prior of the mount's translation has this standard deviation, metres.
_MOUNT_SIGMA = 1.0
# Gauss-Newton stops after so many steps, or when no component of a step is larger than the second number.
_STEPS, _CONVERGED = 10, 1e-5
_DIFFERENCE_STEP = 1e-4


@dataclass(frozen=True, slots=True)
class SensorModel:
    """The sensor's world and mount.

    Attributes:
        A, B: (4, 4), see the module.
        on_object: the tracker's poses are those of a camera in the frame of a body that carries the sensor.
    """

    A: np.ndarray
    B: np.ndarray
    on_object: bool

    def expect(self, pose: np.ndarray, error: np.ndarray) -> np.ndarray:
        """T_sensor_mark (..., 4, 4) for poses (..., 4, 4) of the tracker and errors (..., 18) of drift, A and B."""
        corrected = se3_exp(error[..., DRIFT]) @ pose
        G = se3_inverse(corrected) if self.on_object else corrected
        return np.asarray(self.A @ se3_exp(error[..., SENSOR_WORLD]) @ G @ self.B @ se3_exp(error[..., MOUNT]))

    def corrected(self, error: np.ndarray) -> Self:
        """The model with the errors (18,) of drift, A and B applied."""
        return replace(self, A=self.A @ se3_exp(error[SENSOR_WORLD]), B=self.B @ se3_exp(error[MOUNT]))


def residuals(expected: np.ndarray, position: np.ndarray, rotation: np.ndarray | None) -> np.ndarray:
    """Readings minus expected poses (..., 4, 4): (..., 3) metres, or (..., 6) with the rotation, radians."""
    translation = position - expected[..., :3, 3]
    if rotation is None:
        return np.asarray(translation)
    angle = rotation_log(np.swapaxes(expected[..., :3, :3], -1, -2) @ rotation)
    return np.concatenate([np.broadcast_to(translation, angle.shape), angle], axis=-1)


@dataclass(frozen=True, slots=True)
class PosedReadings(Table):
    """Readings with the tracker's poses at their times.

    Attributes:
        poses: (N, 4, 4) of the camera in the tracker's world.
        drift: (N, 6, 6) covariance of the drift of the poses, perturbed from the left, growing from one to the next.
        frame_error: (N, 6, 6) covariance of the error of each frame alone, perturbed from the left.
        by_calibration: (N, 6, 15) how the calibration's errors, of variance one, enter the poses', likewise.
        positions, rotations: (N, 3), (N, 3, 3) or None.
        covariances: (N, m, m) of the readings.
    """

    poses: np.ndarray
    drift: np.ndarray
    frame_error: np.ndarray
    by_calibration: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray | None
    covariances: np.ndarray


@dataclass(frozen=True, slots=True)
class FusionState:
    """Estimated sensor model and errors of the tracker.

    Attributes:
        model: the sensor's world and mount.
        error: (39,) means of the error states; zero of the sensor's world and mount, which are in the model.
        covariance: (39, 39) of all error states.
    """

    model: SensorModel
    error: np.ndarray
    covariance: np.ndarray

    @property
    def rotation_sigma(self) -> float:
        """Largest standard deviation of the rotation between the worlds, radians."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[9:12, 9:12])[-1], 0.0)))

    def renewed(self, part: slice, covariance: np.ndarray) -> Self:
        """With a part of the errors anew, of that covariance and independent of the others."""
        error = self.error.copy()
        error[part] = 0.0
        return replace(self, error=error, covariance=renew_part(self.covariance, part, covariance))


def find_worlds(
    readings: PosedReadings, drift: np.ndarray, on_object: bool, start: SensorModel | None = None
) -> FusionState | None:
    """A and B by Gauss-Newton on all readings at once.

    The priors are wide: any rotation, ten times the extent of the readings, a mount within about a metre.

    Args:
        readings: with the poses at their times.
        drift: (6, 6) covariance of the tracker's drift now.
        on_object: as in `SensorModel`.
        start: an earlier solution.
    Returns:
        None while the readings do not determine the rotation between the worlds.
    """
    if len(readings) < _MIN_READINGS:
        return None
    G = se3_inverse(readings.poses) if on_object else readings.poses
    pose_extent = float(np.sqrt(G[:, :3, 3].var(axis=0).sum()))
    reading_extent = float(np.sqrt(readings.positions.var(axis=0).sum()))
    if min(pose_extent, reading_extent) <= 0:
        return None
    mount_angle = 0.0 if readings.rotations is None else np.pi
    prior = np.diag(np.repeat([10.0 * (reading_extent + _MOUNT_SIGMA), np.pi, _MOUNT_SIGMA, mount_angle], 3) ** 2)
    guesses = _guesses(readings, G) if start is None else [(start.A, start.B)]
    solutions = [_solve(readings, drift, SensorModel(A, B, on_object), prior) for A, B in guesses]
    best, misfit = min(solutions, key=lambda solution: solution[1])
    components = readings.covariances.shape[0] * readings.covariances.shape[1]
    return best if misfit <= _MAX_MISFIT * components and best.rotation_sigma < _MAX_ROTATION_SIGMA else None


def _guesses(readings: PosedReadings, G: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """First guesses of A and B: from positions with the sensor at the origin, and from the rotations of both."""
    places, positions = G[:, :3, 3], readings.positions
    # Of vectors the nearest rotation to the products is that of least squares.
    rotations = [nearest_rotation((positions - positions.mean(axis=0)).T @ (places - places.mean(axis=0)))]
    if readings.rotations is not None:
        of_carrier = rotation_log(G[:, :3, :3] @ G[0, :3, :3].T)
        of_sensor = rotation_log(readings.rotations @ readings.rotations[0].T)
        rotations.append(nearest_rotation(of_sensor.T @ of_carrier))
    guesses = []
    for R in rotations:
        A, B = rigid_motion(R, positions.mean(axis=0) - R @ places.mean(axis=0)), np.eye(4)
        if readings.rotations is not None:
            mounts = np.swapaxes(R @ G[:, :3, :3], 1, 2) @ readings.rotations
            B[:3, :3] = nearest_rotation(mounts.mean(axis=0))
        guesses.append((A, B))
    return guesses


def _solve(
    readings: PosedReadings, drift: np.ndarray, start: SensorModel, prior: np.ndarray
) -> tuple[FusionState, float]:
    """Posterior of the tracker's drift, calibration, A and B, and the misfit, the sum of squared whitened residuals."""
    count, width = readings.covariances.shape[:2]
    # The drift is a random walk: the covariance of two drifts is that of the earlier one.
    shared = readings.drift[np.minimum(np.arange(count)[:, None], np.arange(count)[None])]
    by_calibration = readings.by_calibration
    shared = shared + by_calibration[:, None] @ by_calibration.swapaxes(1, 2)[None]
    worlds = np.zeros(MODEL_SIZE - 6)
    for _ in range(_STEPS):
        model = start.corrected(np.concatenate([np.zeros(6), worlds]))
        residual = _residuals_without_drift(model, readings)
        jacobian = reading_jacobian(model, readings.poses, readings.positions, readings.rotations)
        by_drift, by_worlds = jacobian[..., DRIFT], jacobian[..., WORLDS].reshape(count * width, -1)
        noise = (by_drift[:, None] @ shared @ by_drift.swapaxes(1, 2)[None]).swapaxes(1, 2)
        of_frames = project_covariance(by_drift, readings.frame_error)
        noise[np.arange(count), :, np.arange(count), :] += readings.covariances + of_frames
        noise = noise.reshape(count * width, -1)
        # The linear model extrapolates the residual to the prior's mean.
        residual_at_prior = residual.ravel() + by_worlds @ worlds
        S = noise + by_worlds @ prior @ by_worlds.T
        before, worlds = worlds, prior @ by_worlds.T @ np.linalg.solve(S, residual_at_prior)
        if np.abs(worlds - before).max() < _CONVERGED:
            break
    with_drift = np.einsum("ibc,iac->bia", readings.drift, by_drift).reshape(6, -1)
    with_calibration = (by_drift @ by_calibration).reshape(-1, CALIBRATION_SIZE).T
    cross = np.concatenate([with_drift, prior @ by_worlds.T, with_calibration])
    gain = np.linalg.solve(S, cross.T).T
    covariance = np.zeros((STATE_SIZE, STATE_SIZE))
    covariance[DRIFT, DRIFT], covariance[WORLDS, WORLDS] = drift, prior
    covariance[CALIBRATION, CALIBRATION] = np.eye(CALIBRATION_SIZE)
    covariance[_SOLVED, _SOLVED] -= gain @ cross.T
    model = start.corrected(np.concatenate([np.zeros(6), worlds]))
    residual = _residuals_without_drift(model, readings)
    misfit = float(residual.ravel() @ np.linalg.solve(noise, residual.ravel()))
    covariance = 0.5 * (covariance + covariance.T)
    error = np.zeros(STATE_SIZE)
    error[_SOLVED] = gain @ residual_at_prior
    error[WORLDS] = 0.0
    return FusionState(model, error, covariance), misfit


def _residuals_without_drift(model: SensorModel, readings: PosedReadings) -> np.ndarray:
    """Residuals (N, m) at the tracker's poses, uncorrected."""
    return residuals(model.expect(readings.poses, np.zeros(MODEL_SIZE)), readings.positions, readings.rotations)


def reading_jacobian(
    model: SensorModel, poses: np.ndarray, positions: np.ndarray, rotations: np.ndarray | None
) -> np.ndarray:
    """Derivative (..., m, 18) of the expected readings by drift, A and B, by central differences.

    Args:
        poses: (..., 4, 4) of the tracker.
        positions, rotations: (..., 3), (..., 3, 3) or None of the readings.
    """
    size, batch = MODEL_SIZE, np.asarray(poses).ndim - 2
    steps = (_DIFFERENCE_STEP * np.concatenate([np.eye(size), -np.eye(size)])).reshape(2 * size, *[1] * batch, size)
    shifted = residuals(model.expect(poses, steps), positions, rotations)
    return np.moveaxis((shifted[size:] - shifted[:size]) / (2.0 * _DIFFERENCE_STEP), 0, -1)
