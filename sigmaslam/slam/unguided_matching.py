"""The pose of a view relative to a keyframe from their features alone, without a prediction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.measurement_noise import MeasurementNoise
from sigmaslam.two_view.scene_pose import estimate_scene_pose
from sigmaslam.two_view.stereo_pose import RelativePose


@dataclass(frozen=True, slots=True)
class UnguidedMatcher:
    """Finds keyframes in views, wherever they are.

    Attributes:
        camera: the rectified pair.
        frontend: matches features.
        window: whose calibration corrects the disparities.
        noise: of what is matched.
        config: settings.
    """

    camera: RectifiedStereo
    frontend: Frontend
    window: KeyframeWindow
    noise: MeasurementNoise
    config: TrackerConfig

    def relative_pose_to(
        self, key: StereoView, view: StereoView, excludes: Callable[[np.ndarray], bool] | None = None
    ) -> RelativePose | None:
        """Pose of a view relative to a keyframe by all of its stereo features; None where too few agree.

        Args:
            key, view: the keyframe's and the current one.
            excludes: as of `estimate_scene_pose`.
        """
        index = np.flatnonzero(np.isfinite(key.disparity))
        if len(index) < self.config.min_inliers:
            return None
        matches = self.frontend.match(KeypointSearch.anywhere(key, index), view).within(view.usable)
        rows = matches.key_index
        place = np.full(len(rows), self.config.keyframe_sigma)
        relative = estimate_scene_pose(
            self.camera,
            self.window.as_calibrated(key.measured(rows)),
            np.column_stack([place, place, key.disparity_sigma[rows]]),
            self.window.as_calibrated(matches.measured),
            self.noise.of_matches(matches),
            matches.probability,
            excludes,
        )
        if relative is None:
            return None
        # Each by its probability: many doubtful ones are few.
        agreeing = float(matches.probability[relative.inliers].sum())
        fair = agreeing >= ACCEPTANCE.probable_share * matches.probability.sum()
        least = self.config.min_inliers * (1 if fair else ACCEPTANCE.improbable_inliers)
        return relative if agreeing >= least else None

    def is_beyond_chance(self, relative: RelativePose) -> bool:
        """Whether so many agree as no repeated texture does, wherever the pose lies."""
        return bool(relative.inliers.sum() >= ACCEPTANCE.improbable_inliers * self.config.min_inliers)
