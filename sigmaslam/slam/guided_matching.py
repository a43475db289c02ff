"""Where the landmarks of a window are in a view, by a prediction of its pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView
from sigmaslam.frontend.plane_alignment import plane_maps
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.measurement_noise import MeasurementNoise

# A keyframe of which fewer landmarks are in view is not searched for.
_MIN_LANDMARKS = 8


@dataclass(frozen=True, slots=True)
class GuidedMatches:
    """Landmarks of the window in the current frame.

    Attributes:
        views: of those that were found.
        probability: (M,) that each match is right.
        searched: (S,) rows of those that were searched for.
    """

    views: LandmarkViews
    probability: np.ndarray
    searched: np.ndarray

    @classmethod
    def empty(cls) -> GuidedMatches:
        """No match, and no search."""
        return cls(LandmarkViews.empty(), np.zeros(0), np.zeros(0, np.int64))

    @classmethod
    def concatenate(cls, parts: list[GuidedMatches]) -> GuidedMatches:
        """The matches of all keyframes."""
        if not parts:
            return cls.empty()
        return cls(
            LandmarkViews.concatenate([part.views for part in parts]),
            np.concatenate([part.probability for part in parts]),
            np.concatenate([part.searched for part in parts]),
        )


@dataclass(frozen=True, slots=True)
class GuidedMatcher:
    """Active search: finds landmarks within the innovation ellipse of their prediction, keyframe by keyframe.

    Attributes:
        camera: the rectified pair.
        frontend: matches features.
        window: whose landmarks are searched for.
        update: predicts them.
        noise: of what is matched.
        config: settings.
    """

    camera: RectifiedStereo
    frontend: Frontend
    window: KeyframeWindow
    update: FrameUpdate
    noise: MeasurementNoise
    config: TrackerConfig

    def match_guided(
        self,
        view: StereoView,
        keyframes: list[StereoView],
        pose: np.ndarray,
        covariance: np.ndarray,
        reference: int = -1,
        alone: bool = False,
    ) -> GuidedMatches:
        """Finds landmarks near where a predicted pose sees them.

        Args:
            view: where they are searched for.
            keyframes: what the window's keyframes saw.
            pose: (4, 4) expected T_world_camera.
            covariance: (6, 6) of it relative to the keyframe `reference`, perturbed from the left in the world.
            reference: the last one by default.
            alone: the view is too far from the keyframes' to share errors with them.
        """
        landmarks = self.window.landmarks
        rows = np.flatnonzero(landmarks.misses < self.config.max_misses)
        if not len(rows):
            return GuidedMatches.empty()
        predicted, S, in_front = self.update.predict(rows, pose, covariance, reference)
        S = S[:, :2, :2] + np.eye(2)
        inside = in_front & self._in_image(predicted)
        inside &= np.linalg.eigvalsh(S)[:, 1] < self.config.search_limit**2
        rows, predicted, S = rows[inside], predicted[inside], S[inside]
        T_view_key = se3_inverse(pose) @ self.window.posterior.poses
        parts = []
        for anchor, key in enumerate(keyframes):
            chosen = np.flatnonzero(landmarks.anchor[rows] == anchor)
            if len(chosen) < _MIN_LANDMARKS:
                continue
            feature = landmarks.feature[rows[chosen]]
            maps = None
            if key.slope is not None:
                measured = self.window.true_disparity(landmarks.estimate[rows[chosen]])
                maps = plane_maps(self.camera, measured, key.slope[feature], T_view_key[anchor])
            search = KeypointSearch(key, feature, predicted[chosen, :2], S[chosen], maps)
            matches = self.frontend.match(search, view)
            # Features of a keyframe ascend with the rows of its landmarks.
            place = np.searchsorted(feature, matches.key_index)
            noise, common = self.noise.of_matches(matches), np.zeros((len(place), 3, 2))
            if alone and anchor != reference % len(keyframes) and len(place) < self.config.min_inliers:
                continue  # a few that agree by chance would connect keyframes that hardly see each other
            if not alone:
                noise, common = self.noise.split(noise)
            views = LandmarkViews(rows[chosen][place], matches.measured, noise, common)
            parts.append(GuidedMatches(views, matches.probability, rows[chosen]))
        return GuidedMatches.concatenate(parts)

    def _in_image(self, predicted: np.ndarray) -> np.ndarray:
        u, v = predicted[:, 0], predicted[:, 1]
        return np.asarray((u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height))
