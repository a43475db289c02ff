"""What a frame says of its pose, given the window."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.geometry.se3 import se3_inverse


@dataclass(frozen=True, slots=True)
class FramePosterior:
    """Window and frame as the frame's views have them together; n is the window's error state, the frame stands behind.

    Attributes:
        step: (n + 6,) from the window's posterior and the predicted pose.
        covariance: (n + 6, n + 6) of both, as far as it comes from matches and motion.
        common: (n + 6, 15) how considered errors of the calibration, of variance one, enter the errors of both.
        information: (n + 6, n + 6) of the views alone.
        score: (n + 6,) slope of the views' log-likelihood at the posterior mean.
    """

    step: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    information: np.ndarray
    score: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """(6, 6) covariance of the frame's pose relative to the window's last one."""
        last, frame, cross = self.covariance[-12:-6, -12:-6], self.covariance[-6:, -6:], self.covariance[-6:, -12:-6]
        return np.asarray(frame + last - cross - cross.T)


@dataclass(frozen=True, slots=True)
class FrameFit:
    """Posterior of a frame's pose together with the window.

    Attributes:
        pose: (4, 4) T_world_camera.
        last: (4, 4) T_world_keyframe of the last keyframe, from which `step` is.
        relative: (6, 6) covariance of the pose relative to the last keyframe, perturbed from the left in the world, as
            far as it comes from matches and motion.
        covariance: (6, 6) of the pose, likewise.
        calibration: (15,) its errors as this frame has them.
        joint: of the window and the frame, without `inflation`.
        inliers: (M,) bool, the views that agree.
        nis, dof: of the inliers.
        noise_scale: what the variances of all views are multiplied by in the posterior, 1 or more, as they scatter.
        clustering: by what errors that neighbours share make `relative` too small, 1 or more; not applied to it.
        scores: (M, 6) slope of each view's log-likelihood by the pose.
        inflation: by what `relative` was multiplied for errors that all views share.
    """

    pose: np.ndarray
    last: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray
    calibration: np.ndarray
    joint: FramePosterior
    inliers: np.ndarray
    nis: float
    dof: int
    noise_scale: float
    clustering: float
    scores: np.ndarray
    inflation: float = 1.0

    @property
    def count(self) -> int:
        """How many views agree."""
        return int(np.count_nonzero(self.inliers))

    @property
    def nis_per_dof(self) -> float:
        """1 where the covariances are right."""
        return self.nis / max(self.dof, 1)

    @property
    def nis_before_scaling(self) -> float:
        """NIS per degree of freedom by the noise that the views came with; a larger one excuses no chance agreement."""
        return self.noise_scale * self.nis_per_dof

    @property
    def step(self) -> np.ndarray:
        """(4, 4) T_keyframe_camera since the last keyframe."""
        return np.asarray(se3_inverse(self.last) @ self.pose)

    def spread_by(self, covariance: np.ndarray) -> Self:
        """The same pose, less certain by a covariance (6, 6) that matches do not know of."""
        return replace(self, relative=self.relative + covariance, covariance=self.covariance + covariance)

    def inflated(self, factor: float) -> Self:
        """The same pose, known so much less well relative to the last keyframe."""
        return replace(
            self,
            relative=factor * self.relative,
            covariance=self.covariance + (factor - 1.0) * self.relative,
            inflation=factor * self.inflation,
        )
