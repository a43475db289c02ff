"""The disparity offset that published poses stand on: one for the run, until the images contradict it.

The window's own estimate of the offset moves from keyframe to keyframe, by what patches that are aligned alike have in
common, and poses move along with it: a pixel more is 0.4 to 0.9 m of a car's way. As the window is Gaussian, a pose for
another offset is its regression on the offset, and costs nothing.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.gaussian import step_with
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp

# An offset that is known to be so many standard deviations away is followed so far.
_AGREES = 2.0
# As of views (`_VIEW_TURN` in calibration_errors.py): no number of frames tells it from an offset.
IN_COMMON = 0.01
"""Standard deviation of an error of alignment with the right eye that all patches have in common, pixels."""


@dataclass(frozen=True, slots=True)
class HeldOffset:
    """What the disparity offset is taken to be.

    Attributes:
        value: pixels; None until a second keyframe says something of it.
        is_moving: the images have just contradicted it: it may be no constant.
    """

    value: float | None = None
    is_moving: bool = True

    @property
    def infinity(self) -> float:
        """Disparity of what is infinitely far, as far as it is less than zero: what lies behind it is wrong, pixels."""
        return min(self.value or 0.0, 0.0)

    def following(self, state: WindowState) -> Self:
        """After a keyframe is added to a window."""
        if len(state) < 2 and self.value is None:
            return self
        estimate, sigma = float(state.calibration[0]), float(np.sqrt(state.covariance[0, 0]))
        before = estimate if self.value is None else self.value
        value = float(np.clip(before, estimate - _AGREES * sigma, estimate + _AGREES * sigma))
        return replace(self, value=value, is_moving=value != self.value)

    def place(
        self, pose: np.ndarray, estimate: float, covariance: np.ndarray, part: slice
    ) -> tuple[np.ndarray, np.ndarray]:
        """A pose as it is with this offset, and the covariance (6, 6) of what other offsets would make of it.

        Args:
            pose: (4, 4) as estimated together with an offset.
            estimate: that offset, pixels.
            covariance: (n, n) of a state with the offset in front, and the pose, perturbed from the left in the world.
            part: the pose's.
        """
        if self.value is None:
            return pose, np.zeros((6, 6))
        by_pixel, change = step_with(covariance, part, 0, 1.0), self.value - estimate
        spread = np.outer(by_pixel, by_pixel) * (change**2 + IN_COMMON**2)
        return nearest_rigid(se3_exp(by_pixel * change) @ pose), spread
