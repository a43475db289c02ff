"""The window's tables, landmarks and the views of them, and where things stand in its state."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

CALIBRATION = slice(0, 3)
CALIBRATION_SIZE = 3
LANDMARK_SIZE = 6
# The first of its numbers are what the measurement model knows; the others are errors of place that its views share.
MODELLED = 4


def pose_slice(clone: int) -> slice:
    """Where the pose of a keyframe, or behind the last that of the frame, stands in the state."""
    return slice(CALIBRATION_SIZE + 6 * clone, CALIBRATION_SIZE + 6 * clone + 6)


@dataclass(frozen=True, slots=True)
class Views:
    """Landmarks seen by one frame.

    Attributes:
        rows: (M,) which landmarks of the window, each once.
        measurement: (M, 3) (u, v, disparity); the disparity may be NaN.
        noise: (M, 3, 3) covariance of its errors that no other view of the landmark has.
        common: (M, 3, 2) how errors of place that all views of the landmark share, of variance one, enter it.
    """

    rows: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray
    common: np.ndarray

    def select(self, index: np.ndarray) -> Views:
        """The views of that index or mask."""
        return Views(*(getattr(self, name)[index] for name in self.__slots__))

    def scaled(self, factor: float) -> Views:
        """The same with so many times the variance."""
        return replace(self, noise=factor * self.noise, common=np.sqrt(factor) * self.common)

    def renumber(self, number: np.ndarray) -> Views:
        """Those of landmarks that stay, under their new rows: number (L,) as of `KeyframeWindow.retire_oldest`."""
        kept = self.select(number[self.rows] >= 0)
        return replace(kept, rows=number[kept.rows])

    @classmethod
    def empty(cls) -> Views:
        """Nothing is seen."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 2)))

    @property
    def components(self) -> np.ndarray:
        """(M,) how many numbers each view measures, 2 or 3."""
        return np.isfinite(self.measurement).sum(axis=1)

    @property
    def covariance(self) -> np.ndarray:
        """(M, 3, 3) of the measurement, places relative to those in the landmark's keyframe."""
        return self.noise + self.common @ self.common.transpose(0, 2, 1)


def join_views(parts: list[Views]) -> Views:
    """All views of all parts."""
    return Views(*(np.concatenate([getattr(part, name) for part in parts]) for name in Views.__slots__))


@dataclass(slots=True)
class Landmarks:
    """The window's landmarks, a table.

    Attributes:
        host: (L,) position of the keyframe that they were first seen in.
        feature: (L,) index among its features.
        measured, variance: (L, 6), (L, 6) (u, v, disparity) there, zero for what its disparities, pixels, and its
            places, sigmas, are off by in all views alike, and their variances.
        estimate: (L, 6) refined by all views.
        covariance: (L, 6, 6) of that given poses and calibration.
        dependence: (L, 6, n) how it moves with the state (calibration and poses of the window).
        views: (L,) how many keyframes and frames have confirmed it.
        misses: (L,) frames in a row in which it was looked for and not found.
        serial: (L,) number that stays.
        relief: (L,) range of the disparities around them, pixels, as of `patch_relief`; for the map.
    """

    host: np.ndarray
    feature: np.ndarray
    measured: np.ndarray
    variance: np.ndarray
    estimate: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    views: np.ndarray
    misses: np.ndarray
    serial: np.ndarray
    relief: np.ndarray

    def __len__(self) -> int:
        return len(self.host)

    @classmethod
    def empty(cls, size: int) -> Landmarks:
        """No landmark, for a state of that size."""
        whole = np.zeros(0, np.int64)
        flat, square = np.zeros((0, LANDMARK_SIZE)), np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE))
        by_state = np.zeros((0, LANDMARK_SIZE, size))
        return cls(whole, whole, flat, flat, flat, square, by_state, whole, whole, whole, np.zeros(0))

    def select(self, index: np.ndarray) -> Landmarks:
        """The landmarks of that index or mask."""
        return Landmarks(*(getattr(self, name)[index] for name in self.__slots__))

    def append(self, new: Landmarks) -> Landmarks:
        """These and new ones."""
        return Landmarks(*(np.concatenate([getattr(self, name), getattr(new, name)]) for name in self.__slots__))

    def first_views(self) -> Views:
        """Them as their hosts see them, by serial numbers; all that disparities are off by is noise there."""
        variance = np.column_stack([self.variance[:, :2], self.variance[:, 2] + self.variance[:, 3]])
        noise = np.asarray(np.eye(3) * variance[:, None, :])
        return Views(self.serial, self.measured[:, :3], noise, np.zeros((len(self), 3, 2)))


@dataclass(slots=True)
class Observations:
    """Views by keyframes other than the host, a table.

    Attributes:
        landmark: (O,) row of the landmark that is seen.
        clone: (O,) position of the keyframe that sees it.
        measurement, noise, common: (O, 3), (O, 3, 3), (O, 3, 2) as of `Views`.
    """

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    clone: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    measurement: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    noise: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))
    common: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 2)))

    def select(self, index: np.ndarray) -> Observations:
        """The observations of that index or mask."""
        return Observations(*(getattr(self, name)[index] for name in self.__slots__))

    def append(self, clone: int, views: Views) -> Observations:
        """These and the views of the keyframe `clone`."""
        return Observations(
            np.r_[self.landmark, views.rows],
            np.r_[self.clone, np.full(len(views.rows), clone)],
            np.concatenate([self.measurement, views.measurement]),
            np.concatenate([self.noise, views.noise]),
            np.concatenate([self.common, views.common]),
        )

    def renumber(self, number: np.ndarray) -> Observations:
        """Those of landmarks that stay, under their new rows: number (L,) as of `KeyframeWindow.retire_oldest`."""
        kept = self.select(number[self.landmark] >= 0)
        return replace(kept, landmark=number[kept.landmark])
