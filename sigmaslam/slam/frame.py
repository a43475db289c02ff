"""One stereo pair on its way through the tracker."""

from __future__ import annotations

from concurrent.futures import Executor, Future

import numpy as np

from sigmaslam.frontend import Frontend, StereoView
from sigmaslam.frontend.patch_disparity_range import dense_disparity


class Frame:
    """A rectified pair. What only keyframes need is made when it is asked for, or beside the tracking of the frame.

    Args:
        left, right: (H, W) uint8, rectified.
        frontend: detects features.
    """

    def __init__(self, left: np.ndarray, right: np.ndarray, frontend: Frontend) -> None:
        self.left = left
        self.right = right
        self._frontend = frontend
        self._view: StereoView | None = None
        self._dense: np.ndarray | None = None
        self._foreseen: Future[tuple[StereoView, np.ndarray]] | None = None

    def foresee(self, executor: Executor) -> None:
        """Begins to make all that a keyframe needs; the same as without."""
        self._foreseen = executor.submit(self._make)

    def finish(self) -> None:
        """What has been foreseen and not yet begun is not needed."""
        if self._foreseen is not None:
            self._foreseen.cancel()

    @property
    def view(self) -> StereoView:
        """The pair with its features and their disparities."""
        if self._view is None:
            if self._foreseen is not None:
                self._view, self._dense = self._foreseen.result()
            else:
                self._view = self._observe()
        return self._view

    @property
    def dense(self) -> np.ndarray:
        """Disparities of half the left image, as of `dense_disparity`."""
        view = self.view
        if self._dense is None:
            self._dense = dense_disparity(view)
        return self._dense

    def _make(self) -> tuple[StereoView, np.ndarray]:
        view = self._observe()
        return view, dense_disparity(view)

    def _observe(self) -> StereoView:
        return self._frontend.observe(self.left, self.right)
