"""The pose of a view relative to a keyframe from their features alone, without a prediction."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.state_layout import CALIBRATION
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView, TemporalMatches
from sigmaslam.frontend.plane_alignment import plane_maps
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.image_cells import pixels_in
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.guided_matching import within_reach
from sigmaslam.slam.measurement_noise import MeasurementNoise
from sigmaslam.two_view.scene_pose import estimate_scene_pose
from sigmaslam.two_view.stereo_pose import MIN_DISPARITY, RelativePose, foresee

# What is seen from so nearly the same distance and side (15 degrees) looks as it did, unless something hides it.
_ALIKE_ZOOM, _ALIKE_COSINE = 1.25, 0.966


@dataclass(frozen=True, slots=True)
class UnguidedMatcher:
    """Finds keyframes in views, wherever they are.

    Attributes:
        window: whose calibration corrects the disparities.
        noise: of what is matched.
        is_late: right eyes are; disparities of views that are sought, which the velocity corrects, are not used.
    """

    camera: RectifiedStereo
    frontend: Frontend
    window: KeyframeWindow
    noise: MeasurementNoise
    config: TrackerConfig
    is_late: bool = False

    def relative_pose_to(
        self, key: StereoView, view: StereoView, excludes: Callable[[np.ndarray], bool] | None = None
    ) -> RelativePose | None:
        """Pose of a view relative to a keyframe by all of its stereo features; None where too few agree.

        Args:
            excludes: as of `estimate_scene_pose`.
        """
        index = np.flatnonzero(np.isfinite(key.disparity))
        if len(index) < self.config.min_inliers:
            return None
        matches = self.frontend.match(KeypointSearch.anywhere(key, index), view).within(view.usable)
        relative = self._pose_of(key, matches, excludes)
        if relative is None:
            return None
        # Each by its probability: many doubtful ones are few.
        agreeing = float(matches.probability[relative.inliers].sum())
        fair = agreeing >= ACCEPTANCE.probable_share * matches.probability.sum()
        least = self.config.min_inliers * (1 if fair else ACCEPTANCE.improbable_inliers)
        return relative if agreeing >= least else None

    def confirmed_pose_to(self, key: StereoView, view: StereoView) -> RelativePose | None:
        """The same by all landmarks that such a pose foresees in the view; None where too few of them are there.

        On repeated texture dozens of features agree with a wrong pose, and hardly any other landmark does. And where
        little agrees at first, as after a long way ahead, the search finds more, and in places that are less wrong.
        Errors that neighbours share, and those of the calibration, are in the covariance.
        """
        if self.is_late:
            view = replace(view, disparity=np.full_like(view.disparity, np.nan))
        first = self.relative_pose_to(key, view)
        if first is None:
            return None
        index = np.flatnonzero(key.disparity >= MIN_DISPARITY)
        measured = self.window.as_calibrated(key.measured(index))
        ahead = measured[:, 2] > 0.0  # a wrong offset moves others behind infinity
        index, measured = index[ahead], measured[ahead]
        errors = self.window.posterior.whole_covariance[CALIBRATION, CALIBRATION]
        sigma, first = self._sigmas(key, index), first.with_shared_errors(errors)
        predicted, covariance, inside = foresee(self.camera, measured, sigma, first)
        covariance = covariance[:, :2, :2] + np.eye(2)
        if view.usable is not None:
            inside[inside] = pixels_in(view.usable, predicted[inside, :2])
        sought = np.flatnonzero(inside & within_reach(covariance, self.config.search_limit))
        slope = np.zeros((len(sought), 2)) if key.slope is None else key.slope[index[sought]]
        maps = plane_maps(self.camera, measured[sought], slope, se3_inverse(first.T_key_camera))
        seen = predicted[sought]
        search = KeypointSearch(key, index[sought], seen[:, :2], covariance[sought], maps, seen[:, 2])
        found = self._pose_of(key, self.frontend.match(search, view).within(view.usable))
        if found is None:
            return None
        alike = inside & _look_alike(self.camera, measured, found.T_key_camera)
        least = max(ACCEPTANCE.confirmed_share * alike.sum(), self.config.min_inliers)
        found = replace(found.with_shared_errors(errors), foreseen=int(inside.sum()))
        return found if found.inliers.sum() >= least else None

    def _pose_of(
        self, key: StereoView, matches: TemporalMatches, excludes: Callable[[np.ndarray], bool] | None = None
    ) -> RelativePose | None:
        """Pose of the view that these matches of a keyframe are in, relative to it; None where there is none."""
        rows = matches.key_index
        return estimate_scene_pose(
            self.camera,
            self.window.as_calibrated(key.measured(rows)),
            self._sigmas(key, rows),
            self.window.as_calibrated(matches.measured),
            self.noise.of_matches(matches),
            matches.probability,
            excludes,
        )

    def _sigmas(self, key: StereoView, rows: np.ndarray) -> np.ndarray:
        """(M, 3) of what the keyframe measured, pixels."""
        place = np.full(len(rows), self.config.keyframe_sigma)
        return np.column_stack([place, place, key.disparity_sigma[rows]])

    def is_beyond_chance(self, relative: RelativePose) -> bool:
        """Whether so many agree as no repeated texture does, wherever the pose lies."""
        least = max(ACCEPTANCE.improbable_inliers * self.config.min_inliers, ACCEPTANCE.clear_share * relative.foreseen)
        return bool(relative.inliers.sum() >= least)


def _look_alike(camera: RectifiedStereo, measured: np.ndarray, T_key_camera: np.ndarray) -> np.ndarray:
    """(M,) whether points (u, v, disparity) (M, 3) of a keyframe are seen from nearly the same side and distance."""
    points = camera.triangulate(measured)
    away = points - T_key_camera[:3, 3]
    far, near = np.linalg.norm(points, axis=1), np.linalg.norm(away, axis=1)
    same_side = np.sum(points * away, axis=1) > _ALIKE_COSINE * near * far
    return (np.abs(np.log(near / far)) < np.log(_ALIKE_ZOOM)) & same_side
