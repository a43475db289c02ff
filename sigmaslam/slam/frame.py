"""One stereo pair on its way through the tracker."""

from __future__ import annotations

from concurrent.futures import Executor

import numpy as np

from sigmaslam.frontend import Frontend, StereoView
from sigmaslam.slam.deferred import Deferred


class Frame:
    """A rectified pair. Its features, which only keyframes need, are made when they are asked for, or foreseen.

    Args:
        left, right: (H, W) uint8, rectified.
        frontend: detects features.
    """

    def __init__(self, left: np.ndarray, right: np.ndarray, frontend: Frontend) -> None:
        self.left = left
        self.right = right
        self._view = Deferred(lambda: frontend.observe(left, right))

    @property
    def view(self) -> StereoView:
        """The pair with its features and their disparities."""
        return self._view.get()

    def foresee(self, executor: Executor) -> None:
        """Begins to make the view beside the tracking of the frame."""
        self._view.begin(executor)

    def finish(self) -> None:
        """What has been foreseen and not yet begun is not needed."""
        self._view.cancel()
