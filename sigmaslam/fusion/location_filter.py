"""A location sensor fused with the tracker's poses, loosely: the sensor's world and its mount are states.

The tracker's error is taken as a random walk in its world whose steps are what its covariance grows by, so that errors
of successive poses are correlated as drift is, and one reading says something of all poses that follow; and, besides, a
part of what each frame's matches add, of which a reading says something for that frame alone. What is not modelled: how
far the motion between two frames is from the constant velocity that gives the pose at the time of a reading.

Nothing can be fused until readings and poses show how the two worlds lie to each other (`find_worlds`). That is solved
anew with each reading, by all of them, until the rotation is known well enough to be linear; from there a reading is
one unscented update of 24 error states: drift, the sensor's world, its mount, the frame's own error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.gaussian import matrix_root, renew_part
from sigmaslam.fusion.readings import Locations
from sigmaslam.fusion.sensor_model import (
    OFFSET,
    OWN,
    SENSOR_WORLD,
    SIZE,
    WHOLE,
    Pairs,
    State,
    find_worlds,
    residuals,
    slopes,
)
from sigmaslam.geometry.se3 import nearest_rigid, se3_body, se3_exp, se3_inverse, se3_log, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.slam.estimate import Estimate

# Share of a frame's own covariance that the next one does not share: their matches are mostly of the same landmarks.
# At 0 a precise sensor turns single frames' errors into drift (a rendered room, 4.1 mm alone: 6.5 mm, NEES 3.9; at 0.5
# 3.8 mm and 1.4, at 1 4.0 mm and 1.5).
_FRESH = 0.5
# Where the variance of the tracker's position or rotation falls below this share, a loop or a map has corrected it.
_CORRECTED = 0.5
# All readings are solved for at once until the rotation between the worlds is known to so many radians, one sigma: at
# 0.15 the square of the error times a lever of a metre is a centimetre that no linear update knows of.
_LINEAR_TURN = 0.03
# And until there are so many of them.
_MOST_KEPT = 60


@dataclass(slots=True)
class LocationSummary:
    """What became of the readings.

    Attributes:
        used: readings that were fused, or served to find the sensor's world.
        weakened: of these, those that disagreed by more than 99.9 % of right ones do; they count less.
        unused: readings before the first frame, after a loss, or while the tracker had no pose.
        ready: time stamp from which poses are fused; None: the motion never showed how the worlds lie to each other.
    """

    used: int = 0
    weakened: int = 0
    unused: int = 0
    ready: float | None = None


@dataclass(frozen=True, slots=True)
class _Known:
    """The filter: its state, None before the worlds are known; and (6, 6) how far the tracker's error has walked."""

    state: State | None
    walked: np.ndarray


class LocationFilter:
    """Improves the tracker's estimates, frame by frame, by the readings until then.

    Poses stay in the tracker's world. Before the worlds are known to each other they are returned as they are.

    Example:
        location = LocationFilter(read_locations(path))
        estimate = location.fuse(tracker.step(left, right, timestamp))

    Args:
        readings: of the sensor.
        on_object: the sensor is on the body that a camera at rest follows.
    """

    def __init__(self, readings: Locations, on_object: bool = False) -> None:
        self.summary = LocationSummary()
        # About the first reading: coordinates of a country's grid would cost digits.
        self._origin = readings.positions[0]
        self._readings = replace(readings, positions=readings.positions - self._origin)
        self._on_object = on_object
        self._next = 0
        self._known = self._sure = _Known(None, np.zeros((6, 6)))
        self._last: Estimate | None = None
        self._was_tracked = True
        self._pairs: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]] = []
        self._trajectory: list[tuple[float, np.ndarray]] = []

    @property
    def T_sensor_world(self) -> np.ndarray | None:  # noqa: N802
        """(4, 4) takes our world, the first left camera, into the sensor's; None: not known yet."""
        return None if self._known.state is None else self._moved_back(self._known.state.model.A)

    @property
    def T_sensor_world_covariance(self) -> np.ndarray | None:  # noqa: N802
        """(6, 6) of that, perturbed from the right (in our world), translation before rotation."""
        return None if self._known.state is None else self._known.state.covariance[SENSOR_WORLD, SENSOR_WORLD]

    def trajectory(self) -> Trajectory | None:
        """All poses until now in the sensor's world, by the last estimate of it; None: it is not known."""
        if self.T_sensor_world is None:
            return None
        poses = np.stack([pose for _, pose in self._trajectory])
        times = np.array([time for time, _ in self._trajectory])
        return Trajectory(times, self.T_sensor_world @ (se3_inverse(poses) if self._on_object else poses))

    def fuse(self, estimate: Estimate) -> Estimate:
        """The estimate with what readings until its time stamp say.

        Raises:
            InputError: at the first frame, where all readings are of an earlier time.
        """
        if self._last is None:
            self._check_times(estimate.timestamp)
        # Without a first pose the tracker's world is where it is: no error.
        tracked = estimate.status != "lost"
        found_again = tracked and not self._was_tracked
        if found_again:
            # The tracker's error is that of before the loss, and not what it walked off to meanwhile.
            self._known = self._sure
        self._allow_correction(estimate)
        growth = self._growth(estimate)
        own = turn_covariance(estimate.T_world_camera, _FRESH * estimate.frame_covariance)
        self._begin(own)
        before, done = self._last, 0.0
        for row in self._due(estimate.timestamp):
            usable = tracked or self._known.state is not None
            if before is None or found_again or not usable or self._readings.timestamps[row] < before.timestamp:
                self.summary.unused += 1
                continue
            share = (self._readings.timestamps[row] - before.timestamp) / (estimate.timestamp - before.timestamp)
            self._walk((share - done) * growth)
            done = share
            step = se3_log(se3_inverse(before.T_world_camera) @ estimate.T_world_camera)
            pose = before.T_world_camera @ se3_exp(share * step)
            self._take(row, pose, own, share, float(estimate.timestamp))
        self._walk((1.0 - done) * growth)
        if tracked:
            self._sure = self._known
        self._last, self._was_tracked = estimate, tracked
        result = self._fused(estimate)
        self._trajectory.append((result.timestamp, result.T_world_camera))
        return result

    # ---- the tracker's error

    def _growth(self, estimate: Estimate) -> np.ndarray:
        """(6, 6) what the covariance of the tracker's drift has grown by, in the world, perturbed from the left."""
        values, vectors = np.linalg.eigh(_drift(estimate) - self._known.walked)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    def _begin(self, own: np.ndarray) -> None:
        """Another frame, whose own error, of covariance (6, 6), has nothing to do with that of the one before."""
        state = self._known.state
        if state is not None:
            covariance = renew_part(state.covariance, OWN, own)
            self._known = replace(self._known, state=replace(state, own=np.zeros(6), covariance=covariance))

    def _walk(self, growth: np.ndarray) -> None:
        state = self._known.state
        if state is not None:
            covariance = state.covariance.copy()
            covariance[OFFSET, OFFSET] += growth
            state = replace(state, covariance=covariance)
        self._known = _Known(state, self._known.walked + growth)

    def _allow_correction(self, estimate: Estimate) -> None:
        """Where the tracker has corrected itself, its error is another one, as large as it says."""
        now = se3_body(estimate.T_world_camera, self._known.walked), _drifted(estimate)
        ratios = [np.trace(now[1][part, part]) / max(np.trace(now[0][part, part]), 1e-300) for part in _PARTS]
        if estimate.status != "relocalised" and min(ratios) > _CORRECTED:
            return
        self._pairs.clear()  # their errors no longer have in common what earlier ones had
        walked, state = _drift(estimate), self._known.state
        if state is not None:
            covariance = renew_part(state.covariance, OFFSET, walked)
            state = replace(state, offset=np.zeros(6), covariance=covariance)
        self._known = _Known(state, walked)

    def _fused(self, estimate: Estimate) -> Estimate:
        state = self._known.state
        if state is None:
            return estimate
        pose = nearest_rigid(se3_exp(state.offset + state.own) @ estimate.T_world_camera)
        both = np.eye(WHOLE)[OFFSET] + np.eye(WHOLE)[OWN]
        return replace(
            estimate,
            T_world_camera=pose,
            covariance=se3_body(pose, both @ state.covariance @ both.T),
            frame_covariance=se3_body(pose, state.covariance[OWN, OWN]),
        )

    # ---- readings

    def _check_times(self, first: float) -> None:
        times = self._readings.timestamps
        if times[-1] < first:
            raise InputError(
                f"{self._readings.source}: its readings end at {times[-1]:.6f} s, before the first frame at "
                f"{first:.6f} s; give both in the same clock"
            )

    def _due(self, until: float) -> range:
        """Rows of the readings up to that time that were not asked for yet."""
        begin, self._next = self._next, int(np.searchsorted(self._readings.timestamps, until, side="right"))
        return range(begin, self._next)

    def _take(self, row: int, pose: np.ndarray, own: np.ndarray, share: float, timestamp: float) -> None:
        """A reading of a pose that is, to a share, the last frame's and else the one's before."""
        self.summary.used += 1
        if self._known.state is not None and not self._pairs:
            self._update(self._known.state, row, pose, own, share)
            return
        self._pairs.append((row, pose, self._known.walked, (share**2 + (1.0 - share) ** 2) * own))
        rows = [kept for kept, *_ in self._pairs]
        readings = self._readings
        _, poses, walked, fresh = zip(*self._pairs, strict=True)
        pairs = Pairs(
            np.stack(poses),
            np.stack(walked),
            np.stack(fresh),
            readings.positions[rows],
            None if readings.rotations is None else readings.rotations[rows],
            readings.covariances[rows],
        )
        before = self._known.state
        known = None if before is None else before.model
        state = find_worlds(pairs, self._known.walked, self._on_object, known)
        self._known = _Known(state, self._known.walked)
        self._begin(own)
        full = len(self._pairs) >= _MOST_KEPT
        if state is not None:
            self.summary.ready = timestamp if self.summary.ready is None else self.summary.ready
            if full or state.turn_sigma < _LINEAR_TURN:
                self._pairs.clear()
        elif full:
            self._pairs = self._pairs[::2]

    def _update(self, state: State, row: int, pose: np.ndarray, own: np.ndarray, share: float) -> None:
        """Unscented update by a reading of the tracker's pose at its time."""
        readings = self._readings
        rotation = None if readings.rotations is None else readings.rotations[row]
        root = np.sqrt(WHOLE) * matrix_root(state.covariance)
        points = np.concatenate([root.T, -root.T])
        shifted = points[:, :SIZE].copy()
        shifted[:, OFFSET] += state.offset + share * (points[:, OWN] + state.own)
        rest = residuals(state.model.expect(pose, shifted), readings.positions[row], rotation)
        innovation = rest.mean(axis=0)
        apart = (innovation - rest) / np.sqrt(len(points))
        cross = points.T @ apart / np.sqrt(len(points))
        by_offset = slopes(state.model, pose, readings.positions[row], rotation)[:, OFFSET]
        predicted = apart.T @ apart
        noise = readings.covariances[row] + (1.0 - share) ** 2 * by_offset @ own @ by_offset.T
        squared = float(innovation @ np.linalg.solve(predicted + noise, innovation))
        gate = CHI_SQUARE_999[len(innovation)]  # a reading beyond is weakened until it is there
        if squared > gate:
            self.summary.weakened += 1
            noise = noise + (squared / gate - 1.0) * (predicted + noise)
        gain = np.linalg.solve(predicted + noise, cross.T).T
        step = gain @ innovation
        covariance = state.covariance - gain @ cross.T
        self._known = replace(
            self._known,
            state=State(
                state.model.moved(step[:SIZE]),
                state.offset + step[OFFSET],
                state.own + step[OWN],
                0.5 * (covariance + covariance.T),
            ),
        )

    def _moved_back(self, A: np.ndarray) -> np.ndarray:
        moved = A.copy()
        moved[:3, 3] += self._origin
        return moved


_PARTS = (slice(0, 3), slice(3, 6))


def _drift(estimate: Estimate) -> np.ndarray:
    """(6, 6) covariance of what the tracker has drifted by, perturbed from the left in the world."""
    covariance = turn_covariance(estimate.T_world_camera, _drifted(estimate))
    return np.asarray(0.5 * (covariance + covariance.T))


def _drifted(estimate: Estimate) -> np.ndarray:
    """The same in the camera's frame."""
    return estimate.covariance - _FRESH * estimate.frame_covariance
