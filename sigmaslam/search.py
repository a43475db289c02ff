"""Where landmarks are in a view: near a prediction, or anywhere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.config import TrackerConfig
from sigmaslam.frontend import Frontend, StereoView, TemporalMatches
from sigmaslam.frontend.planes import plane_maps
from sigmaslam.match_noise import MatchNoise
from sigmaslam.rotation import se3_inverse
from sigmaslam.startup import RelativePose, estimate_relative_pose
from sigmaslam.tables import Views, join_views
from sigmaslam.window import KeyframeWindow

# A pose from matches alone has no prediction to agree with. Where fewer than this share of the matches that should be
# right by their probabilities agree with it, three times as many inliers are asked for: symmetric texture in a mirrored
# image once gave 41 inliers, 31 by their probabilities, where 66 should be right. Half of the right ones may be on
# movers.
_LEAST_SHARE_UNGUIDED = 0.5
# A keyframe of which fewer landmarks are in view is not searched for.
_LEAST_OF_A_KEYFRAME = 8


@dataclass(frozen=True, slots=True)
class Found:
    """Landmarks of the window in the current frame.

    Attributes:
        views: of those that were found.
        probability: (M,) that each match is right.
        searched: (S,) rows of those that were looked for.
    """

    views: Views
    probability: np.ndarray
    searched: np.ndarray

    @classmethod
    def nothing(cls) -> Found:
        """Nothing was found, nor looked for."""
        return cls(Views.empty(), np.zeros(0), np.zeros(0, np.int64))


class LandmarkSearch:
    """Looks for the landmarks of a window, and for keyframes, in views.

    Args:
        camera: the rectified pair.
        frontend: matches features.
        window: whose landmarks are looked for; it is not changed.
        noise: of what is matched.
        config: settings.
    """

    def __init__(
        self,
        camera: RectifiedStereo,
        frontend: Frontend,
        window: KeyframeWindow,
        noise: MatchNoise,
        config: TrackerConfig,
    ) -> None:
        self._camera = camera
        self._frontend = frontend
        self._window = window
        self._noise = noise
        self._config = config

    def near(
        self,
        view: StereoView,
        keyframes: list[StereoView],
        pose: np.ndarray,
        covariance: np.ndarray,
        anchor: int = -1,
        alone: bool = False,
    ) -> Found:
        """Active search: every landmark within the innovation ellipse of its prediction, keyframe by keyframe.

        Args:
            view: where they are looked for.
            keyframes: what the window's keyframes saw.
            pose: (4, 4) expected T_world_camera.
            covariance: (6, 6) of it relative to the keyframe `anchor`, perturbed from the left in the world.
            anchor: the last one by default.
            alone: the view is too far from the keyframes' to share errors with them.
        """
        landmarks = self._window.landmarks
        rows = np.flatnonzero(landmarks.misses < self._config.most_misses)
        if not len(rows):
            return Found.nothing()
        predicted, S, in_front = self._window.predict(rows, pose, covariance, anchor)
        S = S[:, :2, :2] + np.eye(2)
        inside = in_front & self._in_image(predicted)
        inside &= np.linalg.eigvalsh(S)[:, 1] < self._config.search_limit**2
        rows, predicted, S = rows[inside], predicted[inside], S[inside]
        T_view_key = se3_inverse(pose) @ self._window.poses
        parts = []
        for host, key in enumerate(keyframes):
            chosen = np.flatnonzero(landmarks.host[rows] == host)
            if len(chosen) < _LEAST_OF_A_KEYFRAME:
                continue
            feature = landmarks.feature[rows[chosen]]
            maps = None
            if key.slope is not None:
                measured = self._window.true_disparity(landmarks.estimate[rows[chosen]])
                maps = plane_maps(self._camera, measured, key.slope[feature], T_view_key[host])
            matches = self._frontend.match(key, feature, view, predicted[chosen, :2], S[chosen], maps)
            # Features of a keyframe ascend with the rows of its landmarks.
            place = np.searchsorted(feature, matches.key_index)
            noise, common = self._noise.of_matches(matches), np.zeros((len(place), 3, 2))
            if alone and host != anchor % len(keyframes) and len(place) < self._config.least_inliers:
                continue  # a few that agree by chance would tie keyframes that hardly see each other
            if not alone:
                noise, common = self._noise.split(noise)
            views = Views(rows[chosen][place], _measurement(matches), noise, common)
            parts.append(Found(views, matches.probability, rows[chosen]))
        return _merge(parts)

    def locate(self, key: StereoView, view: StereoView) -> RelativePose | None:
        """Pose of a view relative to a keyframe by all of its stereo features, wherever they are in the view."""
        index = np.flatnonzero(np.isfinite(key.disparity))
        if len(index) < self._config.least_inliers:
            return None
        matches = self._frontend.match(key, index, view, key.features.keypoints[index].astype(np.float64), None)
        rows = matches.key_index
        place = np.full(len(rows), self._config.keyframe_sigma)
        relative = estimate_relative_pose(
            self._camera,
            self._window.true_disparity(key.measured(rows)),
            np.column_stack([place, place, key.disparity_sigma[rows]]),
            self._window.true_disparity(_measurement(matches)),
            self._noise.of_matches(matches),
            matches.probability,
        )
        if relative is None:
            return None
        # Each by its probability: many doubtful ones are few.
        agreeing = float(matches.probability[relative.inliers].sum())
        fair = agreeing >= _LEAST_SHARE_UNGUIDED * matches.probability.sum()
        return relative if agreeing >= self._config.least_inliers * (1 if fair else 3) else None

    def _in_image(self, predicted: np.ndarray) -> np.ndarray:
        u, v = predicted[:, 0], predicted[:, 1]
        return np.asarray((u >= 0) & (v >= 0) & (u < self._camera.width) & (v < self._camera.height))


def _measurement(matches: TemporalMatches) -> np.ndarray:
    """(M, 3) (u, v, disparity)."""
    return np.column_stack([matches.points, matches.disparity])


def _merge(parts: list[Found]) -> Found:
    """All that was found."""
    if not parts:
        return Found.nothing()
    return Found(
        join_views([part.views for part in parts]),
        np.concatenate([part.probability for part in parts]),
        np.concatenate([part.searched for part in parts]),
    )
