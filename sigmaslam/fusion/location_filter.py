"""A location sensor fused with the tracker's poses, loosely: the sensor's world and its mount are states.

The error of the tracker's pose has three parts. The drift is a random walk in the tracker's world, whose steps have the
covariance by which that of the pose grows: errors of successive poses are correlated, and one reading corrects all
later poses. The frame error is a share of the covariance that each frame's matches add, and a reading corrects it for
that frame alone. Errors of the tracker's calibration are constant and enter each pose as the tracker says: a wrong
scale is undone on the way back. The pose at the time of a reading is interpolated with constant velocity between two
frames; the error of this interpolation is not modelled.

Fusion begins when readings and poses determine the transformation between the two worlds (`find_worlds`). The solution
uses all readings and is repeated with each new one until the rotation is accurate enough to be linear. From then on
each reading is one unscented update of 39 error states: drift, the sensor's world, its mount, the calibration, the
frame error.
"""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.gaussian import matrix_root
from sigmaslam.fusion.readings import Locations
from sigmaslam.fusion.sensor_model import (
    CALIBRATION,
    DRIFT,
    FRAME_ERROR,
    SENSOR_WORLD,
    STATE_SIZE,
    WORLDS,
    FusionState,
    PosedReadings,
    find_worlds,
    reading_jacobian,
    residuals,
)
from sigmaslam.geometry.se3 import nearest_rigid, se3_adjoint, se3_body, se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.slam.estimate import Estimate

# This share of a frame's covariance is independent of the next frame's, as both match mostly the same landmarks. At 0 a
# precise sensor turns errors of single frames into drift (a rendered room, 4.1 mm alone: 6.5 mm, NEES 3.9; at 0.5
# 3.8 mm and 1.4, at 1 4.0 mm and 1.5).
_INDEPENDENT_SHARE = 0.5
# A loop or a map has corrected the tracker if the variance of position or rotation falls below this share.
_CORRECTED_SHARE = 0.5
# One solution uses all readings until the rotation between the worlds has this standard deviation, radians. At 0.15 the
# square of the error times a lever of a metre is a centimetre, which a linear update misses.
_LINEAR_ROTATION_SIGMA = 0.03
# The solution for all readings uses at most so many of them.
_MAX_READINGS = 60
_TRANSLATION_AND_ROTATION = (slice(0, 3), slice(3, 6))


@dataclass(slots=True)
class LocationSummary:
    """Counts of the readings by their use.

    Attributes:
        used: readings that were fused, or served to solve for the sensor's world.
        weakened: used readings beyond the 99.9 % quantile, which count less.
        unused: readings before the first frame, after a loss, or while the tracker had no pose.
        ready: time stamp from which poses are fused; None if the motion never determined the sensor's world.
    """

    used: int = 0
    weakened: int = 0
    unused: int = 0
    ready: float | None = None


@dataclass(frozen=True, slots=True)
class _Belief:
    """State of the filter, None before the worlds are solved for, and covariance (6, 6) of the tracker's drift."""

    state: FusionState | None
    drift_covariance: np.ndarray


class LocationFilter:
    """Improves the tracker's estimates frame by frame with the readings until then.

    Poses stay in the tracker's world. They are returned unchanged before the sensor's world is solved for.

    Example:
        location = LocationFilter(read_locations(path))
        estimate = location.fuse(tracker.step(left, right, timestamp))

    Args:
        on_object: the sensor is on the body that a camera at rest follows.
    """

    def __init__(self, readings: Locations, on_object: bool = False) -> None:
        self.summary = LocationSummary()
        # Positions are relative to the first reading: coordinates of a national grid would cost digits.
        self._origin = readings.positions[0]
        self._readings = replace(readings, positions=readings.positions - self._origin)
        self._on_object = on_object
        self._next = 0
        self._belief = self._belief_when_tracked = _Belief(None, np.zeros((6, 6)))
        self._last: Estimate | None = None
        self._was_tracked = True
        # Readings for the solution of the worlds, each a table of one row.
        self._unsolved: list[PosedReadings] = []
        self._trajectory: list[tuple[float, np.ndarray]] = []

    @property
    def T_sensor_world(self) -> np.ndarray | None:  # noqa: N802
        """(4, 4) takes the tracker's world, the first left camera, into the sensor's; None before it is solved for."""
        if self._belief.state is None:
            return None
        T = self._belief.state.model.A.copy()
        T[:3, 3] += self._origin
        return T

    @property
    def T_sensor_world_covariance(self) -> np.ndarray | None:  # noqa: N802
        """(6, 6) of T_sensor_world, perturbed from the right (in the tracker's world), translation before rotation."""
        return None if self._belief.state is None else self._belief.state.covariance[SENSOR_WORLD, SENSOR_WORLD]

    def trajectory(self) -> Trajectory | None:
        """All poses until now in the sensor's world, by its last estimate; None before it is solved for."""
        if self.T_sensor_world is None:
            return None
        poses = np.stack([pose for _, pose in self._trajectory])
        times = np.array([time for time, _ in self._trajectory])
        return Trajectory(times, self.T_sensor_world @ (se3_inverse(poses) if self._on_object else poses))

    def fuse(self, estimate: Estimate) -> Estimate:
        """The estimate, corrected by the readings until its time stamp; one without a pose comes back as it is.

        Raises:
            InputError: at the first frame, if all readings are earlier.
        """
        if self._last is None and not self._next:
            self._check_times(estimate.timestamp)
        if not estimate.has_pose:
            self.summary.unused += len(self._due_readings(estimate.timestamp))
            return estimate
        # Before its first pose the tracker counts as tracked: its world has no error yet.
        tracked = estimate.status not in ("lost", "skipped")
        relocalised = tracked and not self._was_tracked
        if relocalised:
            # The tracker's error is that of before the loss; the drift since then does not count.
            self._belief = self._belief_when_tracked
        self._reset_corrected_drift(estimate)
        # Of the covariance of the tracker's drift, in the world, perturbed from the left.
        values, vectors = np.linalg.eigh(_world_drift_covariance(estimate) - self._belief.drift_covariance)
        growth = (vectors * np.maximum(values, 0.0)) @ vectors.T
        frame_covariance = turn_covariance(estimate.T_world_camera, _INDEPENDENT_SHARE * estimate.frame_covariance)
        self._renew_frame_error(frame_covariance)
        before, done = self._last, 0.0
        for row in self._due_readings(estimate.timestamp):
            usable = tracked or self._belief.state is not None
            if before is None or relocalised or not usable or self._readings.timestamps[row] < before.timestamp:
                self.summary.unused += 1
                continue
            share = (self._readings.timestamps[row] - before.timestamp) / (estimate.timestamp - before.timestamp)
            self._grow_drift((share - done) * growth)
            done = share
            step = se3_log(se3_inverse(before.T_world_camera) @ estimate.T_world_camera)
            pose = before.T_world_camera @ se3_exp(share * step)
            by_calibration = (1.0 - share) * _world_by_calibration(before) + share * _world_by_calibration(estimate)
            frame_error = (share**2 + (1.0 - share) ** 2) * frame_covariance
            errors = np.array([self._belief.drift_covariance]), frame_error[None], by_calibration[None]
            reading = PosedReadings(pose[None], *errors, *self._readings.row(row))
            self._fuse_reading(reading, share, frame_covariance, float(estimate.timestamp))
        self._grow_drift((1.0 - done) * growth)
        if tracked:
            self._belief_when_tracked = self._belief
        self._last, self._was_tracked = estimate, tracked
        result = self._correct(estimate)
        self._trajectory.append((result.timestamp, result.T_world_camera))
        return result

    # ---- the tracker's error

    def _renew_frame_error(self, frame_covariance: np.ndarray) -> None:
        """A new frame: its frame error, of covariance (6, 6), is independent of the one before."""
        state = self._belief.state
        if state is not None:
            self._belief = replace(self._belief, state=state.renewed(FRAME_ERROR, frame_covariance))

    def _grow_drift(self, growth: np.ndarray) -> None:
        state = self._belief.state
        if state is not None:
            covariance = state.covariance.copy()
            covariance[DRIFT, DRIFT] += growth
            state = replace(state, covariance=covariance)
        self._belief = _Belief(state, self._belief.drift_covariance + growth)

    def _reset_corrected_drift(self, estimate: Estimate) -> None:
        """After a correction by the tracker itself, the drift is a new error with the covariance that it claims."""
        before = se3_body(estimate.T_world_camera, self._belief.drift_covariance)
        now = _drift_covariance(estimate)
        ratios = [
            np.trace(now[part, part]) / max(np.trace(before[part, part]), 1e-300) for part in _TRANSLATION_AND_ROTATION
        ]
        if estimate.status != "relocalised" and min(ratios) > _CORRECTED_SHARE:
            return
        # The drift of these readings is not a part of the drift from now on.
        self._unsolved.clear()
        drift_covariance, state = _world_drift_covariance(estimate), self._belief.state
        self._belief = _Belief(None if state is None else state.renewed(DRIFT, drift_covariance), drift_covariance)

    def _correct(self, estimate: Estimate) -> Estimate:
        """The estimate with drift, frame error and what the calibration does to it taken out."""
        state = self._belief.state
        if state is None:
            return estimate
        whole = np.eye(STATE_SIZE)[DRIFT] + np.eye(STATE_SIZE)[FRAME_ERROR]
        whole[:, CALIBRATION] = _world_by_calibration(estimate)
        pose = nearest_rigid(se3_exp(whole @ state.error) @ estimate.T_world_camera)
        return replace(
            estimate,
            T_world_camera=pose,
            covariance=se3_body(pose, whole @ state.covariance @ whole.T),
            frame_covariance=se3_body(pose, state.covariance[FRAME_ERROR, FRAME_ERROR]),
        )

    # ---- readings

    def _check_times(self, first: float) -> None:
        times = self._readings.timestamps
        if times[-1] < first:
            raise InputError(
                f"{self._readings.source}: its readings end at {times[-1]:.6f} s, before the first frame at "
                f"{first:.6f} s; give both in the same clock"
            )

    def _due_readings(self, until: float) -> range:
        """Rows of the readings since the last call, up to that time."""
        begin, self._next = self._next, int(np.searchsorted(self._readings.timestamps, until, side="right"))
        return range(begin, self._next)

    def _fuse_reading(
        self, reading: PosedReadings, share: float, frame_covariance: np.ndarray, timestamp: float
    ) -> None:
        """Updates the state by a reading, or solves for the worlds while their rotation is not linear.

        It was made after this share of the time from the frame before to this one.
        """
        self.summary.used += 1
        if self._belief.state is not None and not self._unsolved:
            self._update(self._belief.state, reading, share, frame_covariance)
            return
        self._unsolved.append(reading)
        model = None if self._belief.state is None else self._belief.state.model
        readings = PosedReadings.concatenate(self._unsolved)
        state = find_worlds(readings, self._belief.drift_covariance, self._on_object, model)
        self._belief = replace(self._belief, state=state)
        self._renew_frame_error(frame_covariance)
        full = len(self._unsolved) >= _MAX_READINGS
        if state is not None:
            self.summary.ready = timestamp if self.summary.ready is None else self.summary.ready
            if full or state.rotation_sigma < _LINEAR_ROTATION_SIGMA:
                self._unsolved.clear()
        elif full:
            self._unsolved = self._unsolved[::2]

    def _update(self, state: FusionState, reading: PosedReadings, share: float, frame_covariance: np.ndarray) -> None:
        """Unscented update by a reading."""
        measured = reading.positions, reading.rotations
        root = np.sqrt(STATE_SIZE) * matrix_root(state.covariance)
        points = np.concatenate([root.T, -root.T])
        errors = points + state.error
        errors[:, DRIFT] += share * errors[:, FRAME_ERROR] + errors[:, CALIBRATION] @ reading.by_calibration[0].T
        residual = residuals(state.model.expect(reading.poses, errors), *measured)
        innovation = residual.mean(axis=0)
        deviation = (innovation - residual) / np.sqrt(len(points))
        cross = points.T @ deviation / np.sqrt(len(points))
        by_drift = reading_jacobian(state.model, reading.poses, *measured)[0, :, DRIFT]
        predicted = deviation.T @ deviation
        # The error of the earlier frame is not a state: it counts as noise.
        noise = reading.covariances[0] + (1.0 - share) ** 2 * by_drift @ frame_covariance @ by_drift.T
        squared = float(innovation @ np.linalg.solve(predicted + noise, innovation))
        # A reading beyond the gate is weakened until it lies on the gate.
        gate = CHI_SQUARE_999[len(innovation)]
        if squared > gate:
            self.summary.weakened += 1
            noise = noise + (squared / gate - 1.0) * (predicted + noise)
        gain = np.linalg.solve(predicted + noise, cross.T).T
        step = gain @ innovation
        covariance = state.covariance - gain @ cross.T
        error = state.error + step
        error[WORLDS] = 0.0  # which the model takes
        state = FusionState(state.model.corrected(step), error, 0.5 * (covariance + covariance.T))
        self._belief = replace(self._belief, state=state)


def _world_drift_covariance(estimate: Estimate) -> np.ndarray:
    """(6, 6) covariance of the tracker's drift, perturbed from the left in the world."""
    covariance = turn_covariance(estimate.T_world_camera, _drift_covariance(estimate))
    return np.asarray(0.5 * (covariance + covariance.T))


def _drift_covariance(estimate: Estimate) -> np.ndarray:
    """(6, 6) covariance of the tracker's drift in the camera's frame; errors of its calibration are no random walk."""
    return estimate.matching_covariance - _INDEPENDENT_SHARE * estimate.frame_covariance


def _world_by_calibration(estimate: Estimate) -> np.ndarray:
    """(6, 15) how errors of the calibration enter the pose's error, perturbed from the left in the world."""
    return np.asarray(se3_adjoint(estimate.T_world_camera) @ estimate.by_calibration)
