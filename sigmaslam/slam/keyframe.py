"""One keyframe: what it saw, and what became of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from sigmaslam.estimation.landmark_table import LandmarkTable
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.patch_disparity_range import patch_disparity_range
from sigmaslam.slam.deferred import Deferred
from sigmaslam.slam.point_map import PointMap


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A view that is kept; its pose is in the window's state, or among the poses that left the window.

    Attributes:
        id: number that no other keyframe of the tracker has.
        timestamp: seconds.
        view: what it saw; the right image is given up with the window.
        energies: (N, 2) of patches as of `patch_energies`, of the features that became landmarks; none once it has left
            the window.
        blur: of its image, as of `Keyframes.blur`.
        dense: disparities as of `dense_disparity`, while it is in the window; None where there are none.
        points: landmarks that it was the anchor of, in its frame, once it has left the window.
    """

    id: int
    timestamp: float
    view: StereoView
    energies: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    blur: float = 1.0
    dense: Deferred[np.ndarray] | None = None
    points: PointMap = field(default_factory=PointMap.empty)

    def leave_window(self, points: PointMap) -> Keyframe:
        """The keyframe as it is remembered, with the points (in its frame) that leave with it."""
        view = replace(self.view, right=np.zeros((0, 0), np.uint8), small=(), usable=None)
        return replace(self, view=view, energies=np.zeros((0, 2)), dense=None, points=points)

    def measure_surfaces(self, landmarks: LandmarkTable, anchor: int) -> None:
        """Notes in the table how much the surfaces around the landmarks of this keyframe vary; `anchor`: its number."""
        if self.dense is None or self.view.slope is None:
            return
        rows = landmarks.anchor == anchor
        index = landmarks.feature[rows]
        measured, slope = self.view.measured(index), self.view.slope[index]
        landmarks.disparity_range[rows] = patch_disparity_range(self.dense.get(), measured, slope)
