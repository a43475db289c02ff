"""The disparity offset that published poses stand on: one for the run, until the images contradict it.

The window's own estimate of the offset moves from keyframe to keyframe, by what patches that are aligned alike have in
common, and poses move along with it: a pixel more is 0.4 to 0.9 m of a car's way. As the window is Gaussian, a pose for
another offset is its regression on the offset, and costs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.calibration_errors import CalibrationPrior
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp

# An offset that is known to be so many standard deviations away is followed so far.
_AGREES = 2.0


@dataclass(frozen=True, slots=True)
class HeldOffset:
    """What the disparity offset is taken to be.

    Attributes:
        value: pixels; None until a second keyframe says something of it.
        is_moving: the images have just contradicted it: it may be no constant.
    """

    value: float | None = None
    is_moving: bool = True

    def following(self, state: WindowState, prior: CalibrationPrior, expected: float) -> HeldOffset:
        """After a keyframe is added.

        Args:
            state: of the window.
            prior: of the errors of the calibration.
            expected: mean of the offset's prior, zero but after a bump.
        """
        if len(state) < 2 and self.value is None:
            return self
        estimate, sigma = float(state.calibration[0]), float(np.sqrt(state.covariance[0, 0]))
        if expected == 0.0:
            estimate *= _evidence(estimate, float(np.sqrt(state.whole_covariance[0, 0])), prior.sigma[0])
        before = estimate if self.value is None else self.value
        value = float(np.clip(before, estimate - _AGREES * sigma, estimate + _AGREES * sigma))
        return HeldOffset(value, value != self.value)

    def place(
        self, pose: np.ndarray, estimate: float, variance: float, cross: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """A pose as it is with this offset, and by what covariance (6, 6) it is off if the estimate is right.

        Args:
            pose: (4, 4) as estimated together with an offset.
            estimate: that offset, pixels.
            variance: of it, pixels squared.
            cross: (6,) covariance of the pose with it, perturbed from the left in the world.
        """
        if self.value is None or variance <= 0.0:
            return pose, np.zeros((6, 6))
        step = cross / variance * (self.value - estimate)
        return nearest_rigid(se3_exp(step) @ pose), np.outer(step, step)

    def describe(self, calibration: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Errors of the calibration (12,) with this offset in place of the estimate, and covariance (12, 12)."""
        if self.value is None:
            return calibration, covariance
        others = np.arange(len(calibration)) > 0
        covariance = covariance + np.diag(np.where(others, 0.0, (self.value - calibration[0]) ** 2))
        return np.where(others, calibration, self.value), covariance


def _evidence(estimate: float, sigma: float, prior: float) -> float:
    """Probability that there is an offset at all, by the ratio of Dickey (1971); before images it is a half.

    Args:
        estimate, sigma: of the offset, given that there is one, considered errors included.
        prior: its standard deviation before images.
    """
    if sigma <= 0.0 or prior <= 0.0:
        return 1.0
    none = prior / sigma * np.exp(-0.5 * (estimate / sigma) ** 2)
    return float(1.0 / (1.0 + none))
