"""Which features may become landmarks: all of a static scene, or those of one body."""

from typing import Protocol

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.frontend import StereoView
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.moving_region import MovingRegion
from sigmaslam.slam.unguided_matching import UnguidedMatcher


class LandmarkAdmission(Protocol):
    """Decides what a tracker's map is made of.

    Attributes:
        min_points: a view with fewer admitted stereo points is no keyframe.
        restarts_anywhere: a tracker that has lost its way may go on from whatever it sees.
    """

    min_points: int
    restarts_anywhere: bool

    @property
    def moving(self) -> MovingRegion | None:
        """Where the scene moves on its own; None: all of it may, but for one body."""

    def admit(self, view: StereoView, pose: np.ndarray, window: KeyframeWindow) -> np.ndarray:
        """(N,) bool: which features of a view from `pose` (4, 4), T_world_camera, may become landmarks."""
        ...

    def confirm(self, views: LandmarkViews, window: KeyframeWindow) -> None:
        """Takes note of the views that agree with a frame's pose."""
        ...

    def begin_again(self, frame: Frame, matcher: UnguidedMatcher) -> StereoView | None:
        """The first view with what has been admitted wrongly left out, to start from it again; None: go on."""
        ...


class AdmitAll:
    """The scene is static: every stereo point may become a landmark, but for those on what has been seen to move.

    Args:
        min_inliers: fewer are no pose; a keyframe has twice as many.
        spacing: of landmarks, pixels.
    """

    restarts_anywhere = True

    def __init__(self, min_inliers: int, spacing: float) -> None:
        self.min_points = ACCEPTANCE.keyframe_points * min_inliers
        # Neighbours among landmarks are up to twice the spacing apart.
        self.moving = MovingRegion(2.0 * spacing, patience=5)

    def admit(self, view: StereoView, pose: np.ndarray, window: KeyframeWindow) -> np.ndarray:
        """All that rest."""
        return ~self.moving.covers(view.features.keypoints)

    def confirm(self, views: LandmarkViews, window: KeyframeWindow) -> None:
        """Nothing to note."""

    def begin_again(self, frame: Frame, matcher: UnguidedMatcher) -> StereoView | None:
        """Never."""
        return None
