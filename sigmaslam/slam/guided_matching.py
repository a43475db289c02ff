"""Where the landmarks of a window are in a view, by a prediction of its pose."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.mahalanobis import quantiles, squared_mahalanobis
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView, TemporalMatches
from sigmaslam.frontend.motion_blur import streak_covariance
from sigmaslam.frontend.plane_alignment import plane_maps
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.image_cells import pixels_in
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.landmark_places import landmark_places
from sigmaslam.slam.measurement_noise import MeasurementNoise

CONFIRMED = 2
"""A landmark that so many views agree with stands still: something that moves is a landmark for a frame, too."""
# The prediction holds where so many of them are where it says: the others may be covered by what moves.
_RIGHT = 0.3
# The quantile of the chi-square distribution with two degrees of freedom is that of an exponential one.
_CHI_SQUARE_RIGHT = -2.0 * np.log1p(-_RIGHT)
# A keyframe of which fewer landmarks are in view is not searched for.
_MIN_LANDMARKS = 8


@dataclass(frozen=True, slots=True)
class GuidedMatches:
    """Landmarks of the window in the current frame.

    Attributes:
        views: of those that were found.
        probability: (M,) that each match is right.
        searched: (S,) rows of those that were searched for.
        streaked: motion has blurred either the view or one of the keyframes.
        rival: (4, 4) another pose that nearly as many matches agree with; None: there is none.
        after_gap: the keyframes are far behind, but views to come will be near this one.
    """

    views: LandmarkViews
    probability: np.ndarray
    searched: np.ndarray
    streaked: bool = False
    rival: np.ndarray | None = None
    after_gap: bool = False

    @classmethod
    def empty(cls) -> Self:
        """No match, and no search."""
        return cls(LandmarkViews.empty(), np.zeros(0), np.zeros(0, np.int64))


@dataclass(frozen=True, slots=True)
class GuidedMatcher:
    """Active search: finds landmarks within the innovation ellipse of their prediction, keyframe by keyframe.

    Attributes:
        window: whose landmarks are searched for.
        update: predicts them.
        noise: of what is matched.
        in_stereo: views have disparities. Those of a late eye would hold errors of the velocity that poses tell, and
            come back larger.
    """

    camera: RectifiedStereo
    frontend: Frontend
    window: KeyframeWindow
    update: FrameUpdate
    noise: MeasurementNoise
    config: TrackerConfig
    in_stereo: bool = True

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
            keyframes: what the window's keyframes saw.
            pose: (4, 4) expected T_world_camera.
            covariance: (6, 6) of it relative to the keyframe `reference`, perturbed from the left in the world.
            reference: the last one by default.
            alone: the view is too far from the keyframes' to share errors with them.
        """
        count = self.config.min_inliers
        parts: list[tuple[np.ndarray, KeypointSearch, TemporalMatches]] = []
        for anchor, rows, search in self._searches(view.usable, keyframes, pose, covariance, reference):
            matches = self.frontend.match(search, view).within(view.usable)
            if alone and anchor != reference % len(keyframes) and len(matches) < count:
                continue  # a few that agree by chance would connect keyframes that hardly see each other
            parts.append((rows, search, matches))
        return self._measured(parts, view, alone)

    def follow(
        self,
        frame: Frame,
        keyframes: list[StereoView],
        pose: np.ndarray,
        covariance: np.ndarray,
        carry: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    ) -> tuple[GuidedMatches, float]:
        """Finds landmarks likewise in a pair without features.

        Before anything is gated, optical flow tells by how much the prediction is off: a camera that is shaken turns
        back within a few frames, which no constant velocity foresees. Where the flow departs further than predicted,
        landmarks are searched for in ellipses that much wider.

        Args:
            keyframes, pose, covariance: as of `match_guided`.
            carry: from the left image, ids (K,) and predicted places (K, 2) of landmarks to where optical flow takes
                them, NaN where it does not.
        Returns:
            The matches, and by what the prediction's variances are to be multiplied, 1 or more.
        """
        searches = [(rows, search) for _, rows, search in self._searches(frame.usable, keyframes, pose, covariance, -1)]
        if not searches:
            return GuidedMatches.empty(), 1.0
        rows = np.concatenate([each for each, _ in searches])
        predicted = np.concatenate([search.predicted for _, search in searches])
        start = carry(frame.left, self.window.landmarks.id[rows], predicted)
        covariances = [search.covariance for _, search in searches if search.covariance is not None]
        confirmed = self.window.landmarks.views[rows] >= CONFIRMED
        excess = _excess((start - predicted)[confirmed], np.concatenate(covariances)[confirmed])
        searches = [(each, search.widened(excess)) for each, search in searches]
        starts = np.split(start, np.cumsum([len(each) for each, _ in searches])[:-1])
        found = self.frontend.follow([search for _, search in searches], starts, frame.left, frame.right)
        parts = [
            (rows, search, matches.within(frame.usable))
            for (rows, search), matches in zip(searches, found, strict=True)
        ]
        return self._measured(parts, frame, alone=False), excess

    def _searches(
        self,
        usable: np.ndarray | None,
        keyframes: list[StereoView],
        pose: np.ndarray,
        covariance: np.ndarray,
        reference: int,
    ) -> Iterator[tuple[int, np.ndarray, KeypointSearch]]:
        """For each keyframe of which enough landmarks are in view: its number, their rows, and what is searched for."""
        landmarks = self.window.landmarks
        rows = np.flatnonzero(landmarks.misses < self.config.max_misses)
        if not len(rows):
            return
        predicted, S, in_front = self.update.predict(rows, pose, covariance, reference)
        S = S[:, :2, :2] + np.eye(2)
        u, v = predicted[:, 0], predicted[:, 1]
        inside = in_front & (u >= 0) & (v >= 0) & (u < self.camera.width) & (v < self.camera.height)
        inside &= within_reach(S, self.config.search_limit)
        if usable is not None:
            inside[inside] = pixels_in(usable, predicted[inside, :2])
        rows, predicted, S = rows[inside], predicted[inside], S[inside]
        anchors, feature = landmarks.anchor[rows], landmarks.feature[rows]
        chosen = [np.flatnonzero(anchors == anchor) for anchor in range(len(keyframes))]
        slope = np.zeros((len(rows), 2))
        for key, some in zip(keyframes, chosen, strict=True):
            if key.slope is not None:
                slope[some] = key.slope[feature[some]]
        T_view_key = se3_inverse(pose) @ self.window.posterior.poses
        measured = landmark_places(self.window)[0].take(rows, axis=0)
        maps = plane_maps(self.camera, measured, slope, T_view_key[anchors])
        for anchor, (key, some) in enumerate(zip(keyframes, chosen, strict=True)):
            if len(some) < _MIN_LANDMARKS:
                continue
            own, places = None if key.slope is None else maps.select(some), predicted[some]
            search = KeypointSearch(key, feature[some], places[:, :2], S[some], own, places[:, 2])
            yield anchor, rows[some], search

    def _measured(
        self, parts: list[tuple[np.ndarray, KeypointSearch, TemporalMatches]], view: StereoView | Frame, alone: bool
    ) -> GuidedMatches:
        """Matches of keyframes, each with the rows that were searched for, as views of landmarks."""
        if not parts:
            return GuidedMatches.empty()
        matches = TemporalMatches.concatenate([found for _, _, found in parts])
        noise, common = self.noise.of_matches(matches), np.zeros((len(matches), 3, 2))
        landmarks, streaked, end = [], False, 0
        for rows, search, found in parts:
            # Features of a keyframe ascend with the rows of its landmarks.
            landmarks.append(rows[np.searchsorted(search.index, found.key_index)])
            key, begin, end = search.key, end, end + len(found)
            if not (key.is_blurred or view.is_blurred):
                continue
            streak = streak_covariance(key.left, view.left, key.features.keypoints[found.key_index], found.points)
            if streak is not None:
                # They share it: all of them say no more of it than one.
                noise[begin:end, :2, :2] += len(found) * streak
                streaked = True
        if not alone:
            noise, common = self.noise.split(noise)
        measured = matches.measured if self.in_stereo else np.insert(matches.points, 2, np.nan, axis=1)
        views = LandmarkViews(np.concatenate(landmarks), measured, noise, common)
        return GuidedMatches(views, matches.probability, np.concatenate([rows for rows, _, _ in parts]), streaked)


def within_reach(covariance: np.ndarray, limit: float) -> np.ndarray:
    """(K,) bool, whether the larger sigmas of places with covariances (K, 2, 2) are below a limit, pixels."""
    u, v = covariance[:, 0, 0], covariance[:, 1, 1]
    return np.asarray(0.5 * (u + v) + np.hypot(0.5 * (u - v), covariance[:, 0, 1]) < limit**2)


def _excess(departure: np.ndarray, covariance: np.ndarray) -> float:
    """By what covariances (K, 2, 2) are too small for the smaller departures (K, 2), 1 or more; NaN: unknown."""
    known = np.isfinite(departure[:, 0])
    if known.sum() < _MIN_LANDMARKS:
        return 1.0
    squared = squared_mahalanobis(departure[known], covariance[known])
    return max(1.0, float(quantiles(squared, np.array(_RIGHT))) / _CHI_SQUARE_RIGHT)
