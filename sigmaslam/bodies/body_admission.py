"""Which features are those of one rigid body that moves before a camera at rest.

A box or mask says so in the first frame. What lies in it and stays where it was, when enough of it has moved, was
background; from then on a new landmark must be where the body's own points say, as far away as they, and must not be
where a background that stands still has been seen.
"""

import numpy as np

from sigmaslam.bodies.object_region import BodyShape, inner_half
from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_999
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.mahalanobis import squared_mahalanobis
from sigmaslam.frontend import Frontend, KeypointSearch, StereoView, TemporalMatches
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.image_cells import pixels_in
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.unguided_matching import UnguidedMatcher

# A landmark that moved so far in the image with the body, pixels, is the body's.
_MOVED = 3.0
# A place where the background was and is again, to so many pixels, is background if the body would have moved it by
# `_MOVED` more.
_STILL = 2.0
# Before it is told from what stands still, a body may move by so much unseen, pixels, one sigma.
_UNSEEN = 0.75
# Matches agree with a motion within so many pixels, and standard deviations of the disparity.
_AGREE, _AGREE_SIGMAS = 2.0, 4.0
# The background is known by the first view and so many later ones.
_REFERENCES = 3
# Of the first frame's points: fewer inside the region than so many times those that make a pose are too few.
_START_FACTOR = 2
_MIN_DISPARITY = 0.5


class BodyAdmission:
    """Admits the features of a body.

    Args:
        region: (H, W) bool, where the body is in the first rectified left image.

    Attributes:
        T_camera_body: (4, 4) the body's frame in the first rectified camera, whose axes it has.
        started: there has been a first view.
        separated: what moves in the region is told from what stands still.
    """

    restarts_anywhere = False  # what is seen then may be anything: the body is looked for until it is found
    moving = None

    def __init__(self, camera: RectifiedStereo, region: np.ndarray, frontend: Frontend, config: TrackerConfig) -> None:
        self.min_points = config.min_inliers
        self.T_camera_body = np.eye(4)
        self.separated = False
        self._camera = camera
        self._region = region
        self._frontend = frontend
        self._config = config
        self._shape = BodyShape(camera)
        self._first: StereoView | None = None  # with disparities in the region alone
        self._references: list[tuple[StereoView, np.ndarray]] = []

    @property
    def started(self) -> bool:
        """There has been a first view."""
        return self._first is not None

    def points(self) -> np.ndarray:
        """(M, 3) of the body in the first rectified camera's frame."""
        return self._shape.points()

    def unseen_motion(self) -> np.ndarray:
        """(6, 6) covariance of how far the body may have moved while what stands still outnumbers it; its own frame."""
        assert self._first is not None
        camera = self._camera
        points = camera.triangulate(self._first.measured(np.isfinite(self._first.disparity)))
        depth, size = float(np.median(points[:, 2])), float(np.linalg.norm(np.std(points, axis=0)))
        aside = _UNSEEN * depth / camera.fx
        far = _UNSEEN * depth**2 / camera.focal_baseline
        return np.asarray(np.diag([aside, aside, far, aside / size, aside / size, aside / size]) ** 2)

    def admit(self, view: StereoView, pose: np.ndarray, window: KeyframeWindow) -> np.ndarray:
        """(N,) bool: features of a view from `pose` (4, 4), in the first camera's frame, that are the body's.

        Raises:
            InputError: in the first view too few points of the region have a disparity.
        """
        if self._first is None:
            return self._begin(view)
        if view is self._first:
            return np.isfinite(view.disparity)
        usable = np.isfinite(view.disparity) & (np.nan_to_num(view.disparity) > _MIN_DISPARITY)
        if not self.separated:
            return usable & pixels_in(self._region, view.features.keypoints)
        index = np.flatnonzero(usable)
        # The shape is that of measured disparities but for what they are off by.
        index = index[self._shape.holds(pose, window.as_calibrated(view.measured(index)))]
        index = index[~self._stands_still(view, index, pose)]
        self._references = [self._references[0], *self._references[1:][-_REFERENCES + 1 :], (view, pose)]
        admitted = np.zeros(len(view.disparity), bool)
        admitted[index] = True
        return admitted

    def confirm(self, views: LandmarkViews, window: KeyframeWindow) -> None:
        """Takes landmarks that agree with the body's pose for its own where they have moved."""
        if not self.separated:
            return
        landmarks, poses = window.landmarks, window.posterior.poses
        if not len(self._shape):  # those of the first view have moved, all of them
            self._shape.add(landmarks.id, self._camera.triangulate(landmarks.measured[:, :3]))
        rows = views.landmark
        away = np.linalg.norm(views.measurement[:, :2] - landmarks.measured[rows, :2], axis=1)
        uvd = window.as_calibrated(landmarks.estimate[rows])
        sure = (away > _MOVED) & (uvd[:, 2] > _MIN_DISPARITY)
        rows = rows[sure]
        anchor = poses[landmarks.anchor[rows]]
        points = self._camera.triangulate(uvd[sure])
        self._shape.add(landmarks.id[rows], (anchor[:, :3, :3] @ points[..., None])[..., 0] + anchor[:, :3, 3])

    def begin_again(self, frame: Frame, matcher: UnguidedMatcher) -> StereoView | None:
        """The first view with what has moved since, once that is enough to give a pose; None while all is at rest."""
        if self.separated:
            return None
        body = self._moving_part(frame.view, matcher)
        if body is not None:
            self._first, self.separated = body, True
        return body

    def _begin(self, view: StereoView) -> np.ndarray:
        """The features of the region in the first view, (N,) bool; and the body's frame."""
        chosen = np.isfinite(view.disparity) & pixels_in(self._region, view.features.keypoints)
        chosen &= np.nan_to_num(view.disparity) > _MIN_DISPARITY
        needed = _START_FACTOR * self._config.min_inliers
        if chosen.sum() < needed:
            raise InputError(
                f"--track-object: only {int(chosen.sum())} points in the region are seen by both eyes in the first "
                f"frame, {needed} are needed; give a larger region, or a body with more texture"
            )
        self._first = view.only(chosen)
        self._references = [(view, np.eye(4))]
        inner = chosen & pixels_in(inner_half(self._region), view.features.keypoints)
        points = self._camera.triangulate(view.measured(inner if inner.any() else chosen))
        self.T_camera_body[:3, 3] = np.median(points, axis=0)
        return chosen

    def _moving_part(self, view: StereoView, matcher: UnguidedMatcher) -> StereoView | None:
        """The first view with what has moved since; None where that is too little."""
        first, min_inliers = self._first, self._config.min_inliers
        assert first is not None
        index = np.flatnonzero(np.isfinite(first.disparity))
        matches = self._frontend.match(KeypointSearch.anywhere(first, index), view)
        rows = matches.key_index
        before = first.measured(rows)
        moved = self._has_moved(before, first.disparity_sigma[rows], matches)
        if moved.sum() < min_inliers:
            return None
        chosen = np.zeros(len(first.disparity), bool)
        chosen[rows[moved]] = True
        relative = matcher.relative_pose_to(first.only(chosen), view)
        if relative is None:
            return None
        expected, in_front = self._carried(before, se3_inverse(relative.T_key_camera))
        agree = in_front & (np.linalg.norm(expected[:, :2] - matches.points, axis=1) < _AGREE)
        spread = np.hypot(first.disparity_sigma[rows], np.nan_to_num(matches.disparity_sigma))
        off = np.nan_to_num(np.abs(expected[:, 2] - matches.disparity))
        agree &= off < _AGREE_SIGMAS * spread + 0.5
        if (moved & agree).sum() < min_inliers:
            return None
        chosen[rows[moved & ~agree]] = False
        return first.only(chosen)

    def _has_moved(self, before: np.ndarray, disparity_sigma: np.ndarray, matches: TemporalMatches) -> np.ndarray:
        """Which matches cannot be of what stood still; (M,) bool. Places before are (M, 3)."""
        motion = matches.measured - before
        known = np.isfinite(motion[:, 2])
        noise = np.zeros((len(motion), 3, 3))
        noise[:, :2, :2] = matches.covariance + self._config.keyframe_sigma**2 * np.eye(2)
        noise[:, 2, 2] = np.where(known, disparity_sigma**2 + np.nan_to_num(matches.disparity_sigma) ** 2, 1.0)
        motion[~known, 2] = 0.0
        return np.asarray(squared_mahalanobis(motion, noise) > CHI_SQUARE_999[2 + known])

    def _stands_still(self, view: StereoView, index: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Which of these features are where background was in an earlier view; (K,) bool."""
        still = np.zeros(len(index), bool)
        places = view.measured(index)
        for earlier, earlier_pose in self._references:
            rows = np.flatnonzero(np.nan_to_num(earlier.disparity) > _MIN_DISPARITY)
            before = earlier.measured(rows)
            carried, in_front = self._carried(before, se3_inverse(pose) @ earlier_pose)
            away = ~in_front | (np.linalg.norm(carried[:, :2] - before[:, :2], axis=1) > _STILL + _MOVED)
            rows, before = rows[away], before[away]
            if not len(rows) or not len(index):
                continue
            near = np.tile((0.5 * _STILL) ** 2 * np.eye(2), (len(rows), 1, 1))
            matches = self._frontend.match(KeypointSearch(earlier, rows, before[:, :2], near), view)
            drift = np.linalg.norm(matches.points - earlier.measured(matches.key_index)[:, :2], axis=1)
            there = matches.points[drift < _STILL]
            if len(there):
                distance = np.linalg.norm(places[:, None, :2] - there[None], axis=2).min(axis=1)
                still |= distance < _STILL
        return still

    def _carried(self, uvd: np.ndarray, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(u, v, disparity) (K, 3) of points moved by T (4, 4), and which are in front of the camera, (K,) bool."""
        points = transform_points(T, self._camera.triangulate(uvd))
        in_front = points[:, 2] > 1e-6
        return self._camera.project(np.where(in_front[:, None], points, [0.0, 0.0, 1.0])), in_front
