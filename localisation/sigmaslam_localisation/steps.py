"""A recording cut into steps of a filter: a motion, then what was seen at its end; several recordings are a batch."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_localisation.recording import Recording
from sigmaslam_localisation.sighting_noise import CORRELATION_SECONDS

DELAYS = (0.0, 0.1, 0.2, 0.3, 0.4)
"""Seconds by which a robot may follow its commands, sightings its odometry, or gyroscopes their body."""

LONGEST_STEP = 0.2
"""Seconds. Within a step the robot is taken to drive an arc."""


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Steps of several robots side by side; those of one that has fewer end in steps of no time.

    Attributes:
        count: (B,) steps of each robot.
        seconds: (K + 1, B) times: the start, then the end of each step.
        duration: (K, B) seconds.
        path: (K, B, 2) what the controls say: metres driven and radians turned. Of a body: see `StereoRecording.steps`.
        value: (K, B, L, m) what was seen at the end of the step; NaN for none.
        landmark: (K, B, L) index of the landmark that was seen.
        position: (K, B, L, d) where it is, metres.
        since: (K, B, L) seconds since the same landmark was seen before; infinite the first time.
        correlation: seconds after which the errors of a landmark's sightings are no longer alike.
    """

    count: np.ndarray
    seconds: np.ndarray
    duration: np.ndarray
    path: np.ndarray
    value: np.ndarray
    landmark: np.ndarray
    position: np.ndarray
    since: np.ndarray
    correlation: float = CORRELATION_SECONDS


def make_steps(recordings: Sequence[Recording], delays: Sequence[float]) -> Steps:
    """Steps that end where something was seen, and at most `LONGEST_STEP` after the one before.

    Args:
        recordings: of robots that see the same kind of thing.
        delays: of each recording, seconds by which the robot follows its commands, or the sightings its odometry.
    """
    robots = [_steps(recording, delay) for recording, delay in zip(recordings, delays, strict=True)]
    length, width = (max(each.value.shape[axis] for each in robots) for axis in (0, 2))

    def padded(name: str, fill: float | None = 0.0) -> np.ndarray:
        rows = []
        for each in robots:
            column = getattr(each, name)
            after = [(0, length + (name == "seconds") - len(column))] + [(0, 0)] * (column.ndim - 1)
            if column.ndim > 2 and name != "path":
                after[2] = (0, width - column.shape[2])
            if fill is None:
                rows.append(np.pad(column, after, mode="edge"))
            else:
                rows.append(np.pad(column, after, constant_values=fill))
        return np.concatenate(rows, axis=1)

    return Steps(
        np.concatenate([each.count for each in robots]),
        padded("seconds", None),
        padded("duration"),
        padded("path"),
        padded("value", np.nan),
        padded("landmark", 0),
        padded("position", 0.0),
        padded("since", np.inf),
    )


def _steps(recording: Recording, delay: float) -> Steps:
    """Steps of one robot, from its first control, or the first pose of its truth, whichever is later."""
    start = recording.control_seconds[0]
    if recording.truth is not None:
        start = max(start, recording.truth.seconds[0])
    late = delay if recording.odometry else 0.0
    used = recording.seconds - late >= start
    times, landmark, sightings = recording.seconds[used] - late, recording.landmark[used], recording.sightings[used]
    end = max(recording.control_seconds[-1], *times[-1:], start)
    seconds = _subdivided(np.unique(np.concatenate([[start], times, [end]])))
    if len(times) and times[0] == start:
        # What is seen at the start is seen after a step of no time.
        seconds = np.insert(seconds, 0, start)
    path = _integrated(recording, delay - late, seconds)
    step = np.maximum(np.searchsorted(seconds, times, side="right") - 2, 0)
    value, index, since = in_slots(len(path), step, times, landmark, sightings)
    return Steps(
        np.array([len(path)]),
        seconds[:, None],
        np.diff(seconds)[:, None],
        path[:, None],
        value[:, None],
        index[:, None],
        recording.landmarks[index][:, None],
        since[:, None],
    )


def _subdivided(knots: np.ndarray) -> np.ndarray:
    """The knots, and even steps between those that are too far apart."""
    parts = np.maximum(np.ceil(np.diff(knots) / LONGEST_STEP - 1e-9), 1).astype(int)
    # The same as np.linspace within each interval, for all at once.
    first = np.repeat(np.cumsum(parts) - parts, parts)
    share = (np.arange(parts.sum()) - first + 1) / np.repeat(parts, parts)
    ends = np.repeat(knots[:-1], parts) + share * np.repeat(np.diff(knots), parts)
    ends[np.cumsum(parts) - 1] = knots[1:]
    return np.concatenate([knots[:1], ends])


def _integrated(recording: Recording, delay: float, seconds: np.ndarray) -> np.ndarray:
    """Metres and radians (K, 2) between the times, of controls that hold until the next; before the first, none."""
    begins = recording.control_seconds + delay
    edges = np.unique(np.concatenate([begins, seconds]))
    index = np.searchsorted(begins, edges[:-1], side="right") - 1
    controls = np.where(index[:, None] >= 0, recording.controls[np.maximum(index, 0)], 0.0)
    total = np.vstack([np.zeros((1, 2)), np.cumsum(controls * np.diff(edges)[:, None], axis=0)])
    return np.diff(np.stack([np.interp(seconds, edges, column) for column in total.T], axis=1), axis=0)


def in_slots(
    count: int, step: np.ndarray, seconds: np.ndarray, landmark: np.ndarray, sightings: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Value, landmark and since of so many steps, as `Steps` has them, of sightings (S, m) whose steps are in order."""
    slot = np.arange(len(step)) - np.searchsorted(step, step, side="left")
    shape = (count, int(slot.max(initial=0)) + 1)
    value, index, since = np.full((*shape, sightings.shape[1]), np.nan), np.zeros(shape, int), np.full(shape, np.inf)
    value[step, slot], index[step, slot], since[step, slot] = sightings, landmark, since_before(seconds, landmark)
    return value, index, since


def since_before(seconds: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """Seconds (S,) since the sighting before of the same landmark."""
    since = np.full(len(seconds), np.inf)
    order = np.lexsort((np.arange(len(seconds)), landmark))
    same = landmark[order][1:] == landmark[order][:-1]
    since[order[1:][same]] = (seconds[order][1:] - seconds[order][:-1])[same]
    return since
