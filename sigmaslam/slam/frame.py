"""One stereo pair on its way through the tracker."""

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.frontend import Frontend, StereoView
from sigmaslam.frontend.motion_blur import is_blurred
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.slam.argument_checks import check_mask
from sigmaslam.slam.late_eye import at_one_moment

# Patches have a radius of so many pixels: nearer to what is masked they show some of it.
_MARGIN = 5


class Frame:
    """A rectified pair. Its features, which only keyframes need, are made when they are asked for.

    Args:
        left, right: (H, W) uint8, rectified.
        usable: (H, W) bool, pixels of the left image that landmarks may be found at; None: all.
        exchanged: gives left and right as they are if each image is the other eye's; by default as they are here.
        late: the rectified pair, and the way (6,) of `at_one_moment`; None: there is none.
        infinity: as of `StereoView`.
    """

    def __init__(
        self,
        left: np.ndarray,
        right: np.ndarray,
        frontend: Frontend,
        usable: np.ndarray | None = None,
        exchanged: Callable[[], tuple[np.ndarray, np.ndarray]] | None = None,
        late: tuple[RectifiedStereo, np.ndarray] | None = None,
        infinity: float = 0.0,
    ) -> None:
        self._infinity = infinity
        self._observe, self._exchanged, self._late = frontend.observe, exchanged or (lambda: (right, left)), late
        self.left = left
        self.right = right
        self.usable = usable

    @cached_property
    def is_blurred(self) -> bool:
        """Motion has blurred the left image."""
        return is_blurred(self.left)

    @cached_property
    def view(self) -> StereoView:
        """The pair with its features and their disparities."""
        view = self._observe(self.left, self.right).within(self.usable)
        view = replace(view, is_blurred=self.is_blurred, infinity=self._infinity)
        return view if self._late is None else at_one_moment(view, *self._late)

    def is_exchanged(self, last: StereoView, min_to_judge: int) -> bool:
        """Whether each image is the other eye's: hardly a disparity as they are, and many the other way round.

        Args:
            last: the last keyframe's view, of which usual shares are.
            min_to_judge: as of `StereoView.is_swapped`, by which some cameras show it at once.
        """
        few = int(ACCEPTANCE.exchanged_share * np.isfinite(last.disparity).sum())
        if self.view.is_swapped(min_to_judge) or self.view.has_stereo(few, min_to_judge):
            return self.view.is_swapped(min_to_judge)
        return self._observe(*self._exchanged()).has_stereo(2 * few, min_to_judge)


def usable_pixels(mask: np.ndarray | None, rectifier: StereoRectifier) -> np.ndarray | None:
    """(H, W) bool, pixels of the rectified left image whose patches show nothing that is masked; None: all of them.

    Args:
        mask: (H, W) bool or uint8 of the raw left image, zero where it is not to be used; None: nothing is masked.
    Raises:
        FrameError: the mask has the wrong type or size, or is zero everywhere.
    """
    if mask is None:
        return None
    check_mask(mask, rectifier.camera.left.width, rectifier.camera.left.height)
    side = 2 * _MARGIN + 1
    return cv2.erode(rectifier.rectify_mask((mask > 0).astype(np.uint8)), np.ones((side, side), np.uint8)) > 0
