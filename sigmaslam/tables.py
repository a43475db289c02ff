"""The window's tables, landmarks and the views of them, and where things stand in its state."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

CALIBRATION = slice(0, 3)
CALIBRATION_SIZE = 3
LANDMARK_SIZE = 4


def pose_slice(clone: int) -> slice:
    """Where the pose of a keyframe, or behind the last that of the frame, stands in the state."""
    return slice(CALIBRATION_SIZE + 6 * clone, CALIBRATION_SIZE + 6 * clone + 6)


@dataclass(frozen=True, slots=True)
class Views:
    """Landmarks seen by one frame.

    Attributes:
        rows: (M,) which landmarks of the window, each once.
        measurement: (M, 3) (u, v, disparity); the disparity may be NaN.
        noise: (M, 3, 3) its covariance.
    """

    rows: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray

    def select(self, index: np.ndarray) -> Views:
        """The views of that index or mask."""
        return Views(self.rows[index], self.measurement[index], self.noise[index])

    def renumber(self, number: np.ndarray) -> Views:
        """Those of landmarks that stay, under their new rows: number (L,) as of `KeyframeWindow.retire_oldest`."""
        kept = self.select(number[self.rows] >= 0)
        return Views(number[kept.rows], kept.measurement, kept.noise)

    @classmethod
    def empty(cls) -> Views:
        """Nothing is seen."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))

    @property
    def components(self) -> np.ndarray:
        """(M,) how many numbers each view measures, 2 or 3."""
        return np.isfinite(self.measurement).sum(axis=1)


def join_views(parts: list[Views]) -> Views:
    """All views of all parts."""
    names = ("rows", "measurement", "noise")
    return Views(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(slots=True)
class Landmarks:
    """The window's landmarks, a table.

    Attributes:
        host: (L,) position of the keyframe that they were first seen in.
        feature: (L,) index among its features.
        measured, variance: (L, 4), (L, 4) (u, v, disparity) there, zero for what its disparities are off by in all
            views alike, and their variances.
        estimate: (L, 4) refined by all views.
        covariance: (L, 4, 4) of that given poses and calibration.
        dependence: (L, 4, n) how it moves with the state (calibration and poses of the window).
        views: (L,) how many keyframes and frames have confirmed it.
        misses: (L,) frames in a row in which it was looked for and not found.
        serial: (L,) number that stays.
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

    def __len__(self) -> int:
        return len(self.host)

    @classmethod
    def empty(cls, size: int) -> Landmarks:
        """No landmark, for a state of that size."""
        whole = np.zeros(0, np.int64)
        flat, square = np.zeros((0, LANDMARK_SIZE)), np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE))
        return cls(whole, whole, flat, flat, flat, square, np.zeros((0, LANDMARK_SIZE, size)), whole, whole, whole)

    def select(self, index: np.ndarray) -> Landmarks:
        """The landmarks of that index or mask."""
        return Landmarks(*(getattr(self, name)[index] for name in self.__slots__))

    def append(self, new: Landmarks) -> Landmarks:
        """These and new ones."""
        return Landmarks(*(np.concatenate([getattr(self, name), getattr(new, name)]) for name in self.__slots__))

    def first_views(self) -> Views:
        """Them as their hosts see them, by serial numbers; all that disparities are off by is noise there."""
        variance = np.column_stack([self.variance[:, :2], self.variance[:, 2] + self.variance[:, 3]])
        return Views(self.serial, self.measured[:, :3], np.asarray(np.eye(3) * variance[:, None, :]))


@dataclass(slots=True)
class Observations:
    """Views by keyframes other than the host, a table.

    Attributes:
        landmark: (O,) row of the landmark that is seen.
        clone: (O,) position of the keyframe that sees it.
        measurement, noise: (O, 3), (O, 3, 3) as of `Views`.
    """

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    clone: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    measurement: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    noise: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def select(self, index: np.ndarray) -> Observations:
        """The observations of that index or mask."""
        return Observations(self.landmark[index], self.clone[index], self.measurement[index], self.noise[index])

    def append(self, clone: int, views: Views) -> Observations:
        """These and the views of the keyframe `clone`."""
        return Observations(
            np.r_[self.landmark, views.rows],
            np.r_[self.clone, np.full(len(views.rows), clone)],
            np.concatenate([self.measurement, views.measurement]),
            np.concatenate([self.noise, views.noise]),
        )

    def renumber(self, number: np.ndarray) -> Observations:
        """Those of landmarks that stay, under their new rows: number (L,) as of `KeyframeWindow.retire_oldest`."""
        kept = self.select(number[self.landmark] >= 0)
        return Observations(number[kept.landmark], kept.clone, kept.measurement, kept.noise)
