"""The update of one frame's pose against a window of keyframes.

A frame that is no keyframe is estimated from the window's posterior and its own views alone, and then forgotten but for
the velocity: nothing of it can be counted twice.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.frame_fit import FrameFit, FramePosterior
from sigmaslam.estimation.gaussian import (
    append_moved,
    condition,
    condition_common,
    matrix_root,
    project_covariance,
    replace_part,
    weighted_information,
)
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.estimation.robust import (
    UNKNOWN_VARIANCE,
    common_scale,
    mask_missing,
    student_weight,
    whiten,
)
from sigmaslam.estimation.sigma_point_linearisation import Linearisation
from sigmaslam.estimation.state_layout import CALIBRATION, CALIBRATION_SIZE, LANDMARK_SIZE, pose_slice
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, se3_log

# Scales of the robust loss by which a frame's pose is first found, in standard deviations: it narrows.
_ROBUST_SCALES = (6.0, 4.0, 3.0)
# Linearisations with a gate, which must agree twice or give way to the last.
_GATED = 3


@dataclass(frozen=True, slots=True)
class FrameUpdate:
    """Predicts what a frame sees of a window's landmarks, and estimates its pose; changes nothing.

    Attributes:
        window: whose posterior is the prior.
        iterations: linearisations with a robust loss.
    """

    window: KeyframeWindow
    iterations: int

    def predict(
        self, rows: np.ndarray, pose: np.ndarray, step_covariance: np.ndarray, reference: int = -1
    ) -> tuple[np.ndarray, ...]:
        """Where a frame should see landmarks.

        Args:
            rows: (K,) of the landmark table.
            pose: (4, 4) expected T_world_camera.
            step_covariance: (6, 6) of it relative to a keyframe, perturbed from the left in the world.
            reference: that keyframe; the last one by default.
        Returns:
            (u, v, disparity) (K, 3), its covariance without the measurement's noise (K, 3, 3), in front (K,) bool.
        """
        state = self.window.posterior
        covariance = append_moved(matrix_root(state.covariance), pose_slice(reference % len(state)), step_covariance)
        covariance = covariance @ covariance.T
        moved, common = np.zeros((len(rows), LANDMARK_SIZE)), np.zeros((len(rows), 3, 2))
        linear = self._linearise(rows, pose, np.zeros(len(covariance)), covariance, moved, common)
        noise, by_state = self._through_landmarks(rows, linear, np.zeros((len(rows), 3, 3)))
        return linear.mean, noise + project_covariance(by_state, covariance), linear.in_front

    def fit(
        self,
        views: LandmarkViews,
        pose: np.ndarray,
        step_covariance: np.ndarray,
        min_inliers: int,
        start: np.ndarray | None = None,
        scale: float = 1.0,
    ) -> FrameFit | None:
        """Posterior of a frame's pose.

        Args:
            views: what it sees.
            pose, step_covariance: as of `predict`: the prior.
            min_inliers: fewer are no pose.
            start: (4, 4) pose to linearise at first, close to the truth; then the innovations are not gated against
                the prior, but only the residuals after the update.
            scale: how much smaller than claimed the variances are by which views are told to agree.
        Returns:
            None where too few views agree.
        """
        window = self.window
        last, frame = pose_slice(len(window) - 1), pose_slice(len(window))
        factor = append_moved(matrix_root(window.posterior.covariance), last, step_covariance)
        prior = factor @ factor.T
        components = views.components
        offset = np.zeros(len(prior))
        spread = prior
        if start is not None:
            offset[frame] = se3_log(start @ se3_inverse(pose))
            # As certain as the last keyframe, to draw sigma points about a good start.
            spread = replace_part(prior, frame, last)
        # Landmarks are estimated along with the pose: measured places and depths in the role of true ones would
        # draw the pose towards no motion.
        moved = np.zeros((len(views), LANDMARK_SIZE))

        for iteration in range(self.iterations):
            update = self._linearised(views, pose, offset, spread, moved, 1.0)
            if update.usable.sum() < min_inliers:
                return None
            squared = update.squared
            if iteration == 0 and start is None:
                # About what the prior expects.
                innovation_covariance = update.noise + project_covariance(update.by_state, prior)
                squared = squared_mahalanobis(update.residual, innovation_covariance)
            whitened = update.whitened()
            for limit in _ROBUST_SCALES:
                weight = update.usable / (1.0 + squared / (scale * limit**2)) ** 2
                solution, spread = condition(factor, *weighted_information(whitened, offset, weight))
                after = update.residual - update.by_state @ (solution - offset)
                squared = np.einsum("mi,mij,mj->m", after, update.precision, after)
            offset, moved = solution, self._landmark_step(views, update, solution - offset)

        inliers: np.ndarray | None = None
        noise_scale = 1.0
        for iteration in range(_GATED):
            update = self._linearised(views, pose, offset, spread, moved, noise_scale)
            if inliers is None:
                # Before the gate, which would hide how far they scatter.
                noise_scale = common_scale(update.squared[update.usable], components[update.usable])
                update = update.scaled(noise_scale)
            agree = update.usable & (update.squared <= scale * CHI_SQUARE_999[components])
            if iteration == _GATED - 1 or (inliers is not None and (agree == inliers).all()):
                break
            inliers = agree
            if update.usable.sum() < min_inliers or inliers.sum() < min_inliers:
                return None
            weight = inliers * student_weight(update.squared, components, window.student_freedom)
            information, vector = weighted_information(update.whitened(), offset, weight)
            solution, spread = condition(factor, information, vector)
            offset, moved = solution, self._landmark_step(views, update, solution - offset)
        inliers = inliers & agree
        if inliers.sum() < min_inliers:
            return None
        common = window.posterior.common
        common = condition_common(np.concatenate([common, common[last]]), spread, information)
        standard = np.linalg.lstsq(factor, offset, rcond=1e-12)[0]
        prior_cost = float(standard @ standard)
        cross = spread[frame, last]
        return FrameFit(
            nearest_rigid(se3_exp(offset[frame]) @ pose),
            spread[frame, frame] + spread[last, last] - cross - cross.T,
            spread[frame, frame],
            window.posterior.calibration + offset[CALIBRATION],
            spread[CALIBRATION, CALIBRATION],
            FramePosterior(offset, spread, common, information, vector - information @ offset),
            inliers,
            prior_cost + float(update.squared[inliers].sum()),
            int(components[inliers].sum()),
            noise_scale,
        )

    # ---- the equations

    def _linearised(
        self,
        views: LandmarkViews,
        pose: np.ndarray,
        offset: np.ndarray,
        spread: np.ndarray,
        moved: np.ndarray,
        noise_scale: float,
    ) -> _LinearisedViews:
        """The views at a state `offset` from the prior's mean, with landmarks `moved` from where it has them."""
        linear = self._linearise(views.landmark, pose, offset, spread, moved, views.common)
        noise, by_state = self._through_landmarks(views.landmark, linear, views.noise)
        expected = linear.mean - (linear.by_landmark @ moved[..., None])[..., 0]
        residual, noise = mask_missing(views.measurement - expected, noise_scale * noise)
        precision = np.linalg.inv(noise)
        squared = np.einsum("mi,mij,mj->m", residual, precision, residual)
        usable = linear.in_front & (squared < UNKNOWN_VARIANCE)
        return _LinearisedViews(residual, noise, precision, by_state, linear.by_landmark, squared, usable)

    def _landmark_step(self, views: LandmarkViews, update: _LinearisedViews, step: np.ndarray) -> np.ndarray:
        """(M, 6) how far the landmarks move when the state moves by a step."""
        after = update.residual - update.by_state @ step
        cross = self.window.landmarks.covariance[views.landmark] @ update.by_landmark.transpose(0, 2, 1)
        return np.asarray((cross @ (update.precision @ after[..., None]))[..., 0])

    def _linearise(
        self,
        rows: np.ndarray,
        pose: np.ndarray,
        offset: np.ndarray,
        covariance: np.ndarray,
        moved: np.ndarray,
        common: np.ndarray,
    ) -> Linearisation:
        """Views of landmarks by the frame, with the state moved by `offset` from the window's posterior and `pose`.

        The landmarks follow the state, and lie `moved` (M, 6) from there.
        """
        window, state = self.window, self.window.posterior
        size = len(state.covariance)
        poses = np.concatenate([state.poses, pose[None]])
        poses = se3_exp(offset[CALIBRATION_SIZE:].reshape(-1, 6)) @ poses
        landmarks = window.landmarks
        return window.lineariser.linearise(
            poses,
            state.calibration + offset[CALIBRATION],
            covariance,
            landmarks.estimate[rows] + landmarks.dependence[rows] @ offset[:size] + moved,
            landmarks.covariance[rows],
            landmarks.anchor[rows],
            np.full(len(rows), len(state)),
            common,
            window.depth,
        )

    def _through_landmarks(
        self, rows: np.ndarray, linear: Linearisation, noise: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Noise with that of the landmarks, and derivatives by the state with those through the landmarks."""
        landmarks, size = self.window.landmarks, len(self.window.posterior.covariance)
        by_state = linear.by_state.copy()
        by_state[:, :, :size] += linear.by_landmark @ landmarks.dependence[rows]
        through = project_covariance(linear.by_landmark, landmarks.covariance[rows])
        return noise + linear.nonlinearity + through, by_state


@dataclass(frozen=True, slots=True)
class _LinearisedViews:
    """The views of a frame at one linearisation point.

    Attributes:
        residual: (M, 3), zero for what is missing.
        noise, precision: (M, 3, 3) of it and inverse, with the uncertainty of the landmarks.
        by_state: (M, 3, n) derivatives, also through the landmarks.
        by_landmark: (M, 3, 6) derivatives, given the state.
        squared: (M,) squared length of the residual, in units of the noise.
        usable: (M,) bool, in front of the camera and anywhere near.
    """

    residual: np.ndarray
    noise: np.ndarray
    precision: np.ndarray
    by_state: np.ndarray
    by_landmark: np.ndarray
    squared: np.ndarray
    usable: np.ndarray

    def scaled(self, factor: float) -> _LinearisedViews:
        """The same with so many times the noise."""
        return replace(
            self, noise=self.noise * factor, precision=self.precision / factor, squared=self.squared / factor
        )

    def whitened(self) -> np.ndarray:
        """(3 M, n + 1) derivatives and residuals in units of the noise."""
        return whiten(np.concatenate([self.by_state, self.residual[..., None]], axis=2), self.noise)
