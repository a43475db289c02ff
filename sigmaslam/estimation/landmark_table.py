"""The landmarks of a window and the views of them, as tables."""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.state_layout import LANDMARK_SIZE
from sigmaslam.table import Table


@dataclass(frozen=True, slots=True)
class LandmarkViews(Table):
    """Landmarks of a window as one view sees them.

    Attributes:
        landmark: (M,) rows of the landmark table, each once.
        measurement: (M, 3) (u, v, disparity); the disparity may be NaN.
        noise: (M, 3, 3) covariance of its errors that no other view of the landmark has.
        common: (M, 3, 2) how errors of place that all views of the landmark share, of variance one, enter it.
    """

    landmark: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray
    common: np.ndarray

    def inflated(self, factor: float) -> Self:
        """The same views with so many times the variance."""
        return replace(self, noise=factor * self.noise, common=np.sqrt(factor) * self.common)

    def renumber(self, new_row: np.ndarray) -> Self:
        """Views of landmarks that stay, by their new rows: new_row (L,) as of `KeyframeWindow.marginalise_oldest`."""
        kept = self.select(new_row[self.landmark] >= 0)
        return replace(kept, landmark=new_row[kept.landmark])

    @classmethod
    def empty(cls) -> Self:
        """No views."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3, 2)))

    @property
    def components(self) -> np.ndarray:
        """(M,) how many numbers each view measures, 2 or 3."""
        return np.isfinite(self.measurement).sum(axis=1)

    @property
    def covariance(self) -> np.ndarray:
        """(M, 3, 3) of the measurement, places relative to those in the landmark's anchor keyframe."""
        return self.noise + self.common @ self.common.transpose(0, 2, 1)


@dataclass(frozen=True, slots=True)
class KeyframeViews(Table):
    """Views by keyframes other than a landmark's anchor.

    Attributes:
        keyframe: (O,) position in the window of the keyframe that sees it.
        views: what it sees.
    """

    keyframe: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    views: LandmarkViews = field(default_factory=LandmarkViews.empty)

    def append(self, keyframe: int, views: LandmarkViews) -> Self:
        """These and what one more keyframe sees."""
        return self.concatenate([self, replace(self, keyframe=np.full(len(views), keyframe), views=views)])

    def without_oldest(self, new_row: np.ndarray) -> Self:
        """Views of landmarks that stay when the oldest keyframe leaves: new_row (L,) as of `LandmarkViews.renumber`."""
        keyframe = self.keyframe[new_row[self.views.landmark] >= 0] - 1
        return replace(self, keyframe=keyframe, views=self.views.renumber(new_row))


@dataclass(slots=True)
class LandmarkTable(Table):
    """The landmarks of a window.

    Attributes:
        anchor: (L,) position in the window of the keyframe that saw them first.
        feature: (L,) index among its features.
        measured, variance: (L, 6), (L, 6) (u, v, disparity) there, zero for what its disparities, pixels, and its
            places, sigmas, are off by in all views alike, and their variances.
        estimate: (L, 6) refined by all views.
        covariance: (L, 6, 6) of that given poses and calibration.
        dependence: (L, 6, n) how it moves with the state (calibration and poses of the window).
        views: (L,) how many keyframes and frames have confirmed it.
        misses: (L,) frames in a row in which it was looked for and not found.
        id: (L,) number that no other landmark of the run has.
        disparity_range: (L,) range of the disparities around them, pixels, as of `patch_disparity_range`; for the map,
            zero until it is made.
    """

    anchor: np.ndarray
    feature: np.ndarray
    measured: np.ndarray
    variance: np.ndarray
    estimate: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    views: np.ndarray
    misses: np.ndarray
    id: np.ndarray
    disparity_range: np.ndarray

    @classmethod
    def empty(cls, size: int) -> Self:
        """No landmark, for a state of that size."""
        whole = np.zeros(0, np.int64)
        flat, square = np.zeros((0, LANDMARK_SIZE)), np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE))
        by_state = np.zeros((0, LANDMARK_SIZE, size))
        return cls(whole, whole, flat, flat, flat, square, by_state, whole, whole, whole, np.zeros(0))

    def anchor_views(self, anchor: int) -> LandmarkViews:
        """Landmarks of one anchor keyframe as it saw them; all that disparities are off by is noise there."""
        rows = np.flatnonzero(self.anchor == anchor)
        variance = self.variance[rows]
        variance = np.column_stack([variance[:, :2], variance[:, 2] + variance[:, 3]])
        noise = np.asarray(np.eye(3) * variance[:, None, :])
        return LandmarkViews(rows, self.measured[rows, :3], noise, np.zeros((len(rows), 3, 2)))
