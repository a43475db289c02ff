"""What a robot recorded: commands or odometry, sightings of landmarks, and the truth if there is one."""

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class PlanarTruth:
    """Where a robot was, from a better instrument; for scores, and the first pose for a start.

    Attributes:
        seconds: (T,) increasing.
        poses: (T, 3) x, y in metres and the heading in radians, unwrapped.
        longest_gap: poses further apart than this, in seconds, are not interpolated between.
    """

    seconds: np.ndarray
    poses: np.ndarray
    longest_gap: float

    def at(self, seconds: np.ndarray) -> np.ndarray:
        """(K, 3) poses at other times, by linear interpolation; NaN in gaps and beyond the ends."""
        poses = np.stack([np.interp(seconds, self.seconds, column) for column in self.poses.T], axis=1)
        after = np.searchsorted(self.seconds, seconds)
        inside = (after > 0) & (after < len(self.seconds))
        after = np.clip(after, 1, len(self.seconds) - 1)
        gap = self.seconds[after] - self.seconds[after - 1]
        exact = np.isin(seconds, self.seconds)
        poses[~(exact | (inside & (gap <= self.longest_gap)))] = np.nan
        return poses


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """One robot's log in a map of known landmarks.

    Attributes:
        name: of the robot.
        control_seconds: (C,) increasing; a control holds until the next.
        controls: (C, 2) speed in m/s and turn rate in rad/s.
        seconds: (S,) of the sightings, increasing; several may share a time.
        landmark: (S,) index of the landmark seen; -1 where that is not known.
        sightings: (S, 2) of the kind's components.
        kind: "range-bearing" (metres, radians, anticlockwise from ahead) or "cartesian" (metres ahead and to the left).
        landmarks: (L, 2) in the world, metres; NaN where that is not known.
        lever: metres by which the sensor stands ahead of the robot's centre.
        truth: None if there is none.
        odometry: whether the controls are measured at the wheels. A command comes before its motion, so the robot is
            late; odometry comes with it, so a delay is that of the sightings.
        names: of the landmarks; None: their indices.
    """

    name: str
    control_seconds: np.ndarray
    controls: np.ndarray
    seconds: np.ndarray
    landmark: np.ndarray
    sightings: np.ndarray
    kind: str
    landmarks: np.ndarray
    lever: float = 0.0
    truth: PlanarTruth | None = None
    odometry: bool = False
    names: tuple[str, ...] | None = None

    @property
    def landmark_names(self) -> tuple[str, ...]:
        """Of the landmarks, in the order of their indices."""
        return tuple(map(str, range(len(self.landmarks)))) if self.names is None else self.names

    def within(self, largest_range: float) -> "Recording":
        """The recording without sightings from further away, metres."""
        distance = self.sightings[:, 0] if self.kind == "range-bearing" else np.hypot(*self.sightings.T)
        near = distance <= largest_range
        return replace(self, seconds=self.seconds[near], landmark=self.landmark[near], sightings=self.sightings[near])
