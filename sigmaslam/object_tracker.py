"""The reverse job (9.5.1, figure 9.8): a stereo camera at rest follows one rigid body that moves.

In the body's frame it is the camera that moves, so the tracker is the same; the scene is the outlier. What is added is
where landmarks may be: on the body. A box or mask says so in the first frame. What lies in it and stays where it was,
when enough of the rest has moved, was background; from then on a new landmark must be where the body's own points say,
as far away as they, and must not be where a background that stands still has been seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.camera import StereoCamera
from sigmaslam.chi_square import CHI_SQUARE_999
from sigmaslam.config import TrackerConfig
from sigmaslam.errors import InputError
from sigmaslam.estimate import Estimate
from sigmaslam.frame_fit import FrameFit
from sigmaslam.frontend import Frontend, StereoView, TemporalMatches
from sigmaslam.landmarks import PointMap
from sigmaslam.object_region import BodyShape, inner_half, pixels_in
from sigmaslam.rotation import se3_inverse, turn_covariance
from sigmaslam.search import Found
from sigmaslam.stopwatch import Stopwatch
from sigmaslam.tracker import StereoTracker

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
OBJECT_CONFIG = TrackerConfig(acceleration=1.0, angular_acceleration=3.0, start_turn=3.0)
# Of the first frame's points: fewer inside the region than so many times those that make a pose are too few.
_START_FACTOR = 2
_LEAST_DISPARITY = 0.5


@dataclass(frozen=True, slots=True)
class ObjectEstimate(Estimate):
    """Result for one stereo pair; T_world_camera and covariance are of the camera in the body's frame."""

    @property
    def T_camera_object(self) -> np.ndarray:  # noqa: N802
        """(4, 4) pose of the body in the left camera's frame."""
        return se3_inverse(self.T_world_camera)

    @property
    def object_covariance(self) -> np.ndarray:
        """(6, 6) of `T_camera_object` in the body's own frame, translation (metres) before rotation (radians)."""
        covariance = turn_covariance(self.T_world_camera, self.covariance)
        return np.asarray(0.5 * (covariance + covariance.T))


def as_camera_object(estimate: ObjectEstimate) -> Estimate:
    """The estimate as a run folder of a followed body holds it: T_camera_object in place of T_world_camera."""
    return replace(estimate, T_world_camera=estimate.T_camera_object, covariance=estimate.object_covariance)


class ObjectTracker(StereoTracker):
    """Follows one rigid body before a stereo camera at rest.

    The body's frame has the axes of the left camera in the first frame; its origin is the median of the body's stereo
    points there (of the inner half of the region).

    Example:
        tracker = ObjectTracker(camera, read_region("400,200,300,250", width, height))
        estimate = tracker.step(left, right, timestamp)
        estimate.T_camera_object, estimate.object_covariance

    Args:
        camera: calibration of the raw images.
        region: (H, W) bool, where the body is in the first raw left image; background inside does little harm.
        frontend, backend: of `StereoTracker`.
        config: likewise; by default with more acceleration, since hands move things faster than cameras are carried.
    """

    def __init__(
        self,
        camera: StereoCamera,
        region: np.ndarray,
        frontend: Frontend | str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
    ) -> None:
        super().__init__(camera, frontend, backend, config or OBJECT_CONFIG)
        raw = region.astype(np.uint8) * 255
        self._region = self._rectifier.rectify(raw, raw)[0] > 127
        self._shape = BodyShape(self._camera)
        self._first: StereoView | None = None  # with disparities in the region alone
        self._first_time = self._now = 0.0
        self._separated = False  # what moves in the region is told from what stands still
        self._T_world_body = np.eye(4)  # the tracker's world is the first rectified camera
        self._references: list[tuple[StereoView, np.ndarray]] = []

    @property
    def origin(self) -> np.ndarray:
        """(3,) of the body's frame in the first left camera's, metres."""
        return np.asarray((se3_inverse(self._T_rectified_left) @ self._T_world_body)[:3, 3])

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> ObjectEstimate:
        """Takes one stereo pair; arguments and errors as of `StereoTracker.step`.

        Raises:
            InputError: also when too little of the region in the first frame is seen by both eyes.
        """
        self._now = timestamp
        estimate = super().step(left, right, timestamp)
        if self._first is None:
            raise InputError(
                "the first frame has too few points that both eyes see: start where the images are good, "
                "and check the calibration"
            )
        T_body_left = np.eye(4)
        T_body_left[:3, 3] = -self.origin
        values = {name: getattr(estimate, name) for name in Estimate.__slots__}
        values["T_world_camera"] = T_body_left @ estimate.T_world_camera
        if not self._separated and estimate.status != "starting":
            values["covariance"] = estimate.covariance + self._unseen_motion()
        return ObjectEstimate(**values)

    def map(self) -> PointMap:
        """The body's points, in its frame."""
        T_body_left = np.eye(4)
        T_body_left[:3, 3] = -self.origin
        points = super().map()
        body = self._shape.points()
        if len(body):
            # What was taken for the body's while it rested, and never moved with it, mostly lies beside it.
            T_left_rectified = se3_inverse(self._T_rectified_left)
            body = body @ T_left_rectified[:3, :3].T
            slack = 0.1 * np.ptp(body, axis=0).max()
            inside = (points.points >= body.min(axis=0) - slack) & (points.points <= body.max(axis=0) + slack)
            points = points.select(inside.all(axis=1))
        return points.transform(T_body_left)

    # ---- what the tracker asks

    def _start(self, view: StereoView, timestamp: float) -> None:
        if self._first is None:
            chosen = np.isfinite(view.disparity) & pixels_in(self._region, view.features.keypoints)
            chosen &= np.nan_to_num(view.disparity) > _LEAST_DISPARITY
            needed = _START_FACTOR * self.config.least_inliers
            if chosen.sum() < needed:
                raise InputError(
                    f"--track-object: only {int(chosen.sum())} points in the region are seen by both eyes in the first "
                    f"frame, {needed} are needed; give a larger region, or a body with more texture"
                )
            self._first, self._first_time = _only(view, chosen), timestamp
            self._references = [(view, np.eye(4))]
            inner = chosen & pixels_in(inner_half(self._region), view.features.keypoints)
            points = self._camera.triangulate(view.measured(inner if inner.any() else chosen))
            self._T_world_body[:3, 3] = np.median(points, axis=0)
        super()._start(view, timestamp)

    def _track(self, view: StereoView, clock: Stopwatch) -> tuple[Found, FrameFit | None]:
        if not self._separated:
            body = self._moving_part(view)
            if body is not None:
                self._restart(body)
                clock.lap("match")
        return super()._track(view, clock)

    def _accept(self, fit: FrameFit, found: Found, view: StereoView, timestamp: float) -> None:
        if self._separated:
            self._confirm(found.views.rows[fit.kept], found.views.measurement[fit.kept, :2])
        super()._accept(fit, found, view, timestamp)

    def _recover(self, view: StereoView, timestamp: float) -> None:
        """Never starts anew from what is seen now, which may be anything; the body is looked for until it is found."""

    def _has_stereo(self, view: StereoView) -> bool:
        enough = int(np.isfinite(view.disparity).sum()) >= self.config.least_inliers
        return enough and not self._is_swapped(view)

    def _choose(self, view: StereoView, pose: np.ndarray) -> StereoView:
        known = np.isfinite(view.disparity) & (np.nan_to_num(view.disparity) > _LEAST_DISPARITY)
        if not self._separated:
            assert self._first is not None
            # Made again for the body alone once that is known.
            inside = pixels_in(self._region, view.features.keypoints)
            return self._first if view is self._first else _only(view, known & inside)
        index = np.flatnonzero(known)
        # The shape is that of measured disparities but for what they are off by.
        index = index[self._shape.holds(pose, self._window.true_disparity(view.measured(index)))]
        index = index[~self._stands_still(view, index, pose)]
        self._references = [self._references[0], *self._references[1:][-_REFERENCES + 1 :], (view, pose)]
        chosen = np.zeros(len(view.disparity), bool)
        chosen[index] = True
        return _only(view, chosen)

    # ---- body and background

    def _unseen_motion(self) -> np.ndarray:
        """(6, 6) in the camera's frame: how far the body may have moved while what stands still outnumbers it."""
        assert self._first is not None
        camera = self._camera
        points = camera.triangulate(self._first.measured(np.isfinite(self._first.disparity)))
        depth, size = float(np.median(points[:, 2])), float(np.linalg.norm(np.std(points, axis=0)))
        aside = _UNSEEN * depth / camera.fx
        far = _UNSEEN * depth**2 / (camera.fx * camera.baseline)
        body = np.diag([aside, aside, far, aside / size, aside / size, aside / size]) ** 2
        # In the body's frame, whose axes are the camera's still; from there into the left camera's.
        return turn_covariance(se3_inverse(self._T_rectified_left) @ self._T_world_body, body)

    def _moving_part(self, view: StereoView) -> StereoView | None:
        """The first view with what has moved since, if that is enough to give a pose; None while all is at rest."""
        first = self._first
        assert first is not None
        index = np.flatnonzero(np.isfinite(first.disparity))
        keypoints = first.features.keypoints[index].astype(np.float64)
        matches = self._frontend.match(first, index, view, keypoints, None)
        rows = matches.key_index
        before = first.measured(rows)
        moved = self._has_moved(before, first.disparity_sigma[rows], matches)
        if moved.sum() < self.config.least_inliers:
            return None
        chosen = np.zeros(len(first.disparity), bool)
        chosen[rows[moved]] = True
        relative = self._search.locate(_only(first, chosen), view)
        if relative is None:
            return None
        T = se3_inverse(relative.T_key_camera)
        points = self._camera.triangulate(before) @ T[:3, :3].T + T[:3, 3]
        agree = points[:, 2] > 1e-6
        expected = self._camera.project(np.where(agree[:, None], points, [0.0, 0.0, 1.0]))
        agree &= np.linalg.norm(expected[:, :2] - matches.points, axis=1) < _AGREE
        spread = np.hypot(first.disparity_sigma[rows], np.nan_to_num(matches.disparity_sigma))
        off = np.nan_to_num(np.abs(expected[:, 2] - matches.disparity))
        agree &= off < _AGREE_SIGMAS * spread + 0.5
        if (moved & agree).sum() < self.config.least_inliers:
            return None
        chosen[rows[moved & ~agree]] = False
        return _only(first, chosen)

    def _has_moved(self, before: np.ndarray, disparity_sigma: np.ndarray, matches: TemporalMatches) -> np.ndarray:
        """Which matches cannot be of what stood still; (M,) bool. Places before are (M, 3)."""
        apart = np.column_stack([matches.points, matches.disparity]) - before
        known = np.isfinite(apart[:, 2])
        noise = np.zeros((len(apart), 3, 3))
        noise[:, :2, :2] = matches.covariance + self.config.keyframe_sigma**2 * np.eye(2)
        noise[:, 2, 2] = np.where(known, disparity_sigma**2 + np.nan_to_num(matches.disparity_sigma) ** 2, 1.0)
        apart[~known, 2] = 0.0
        squared = np.einsum("mi,mi->m", apart, np.linalg.solve(noise, apart[..., None])[..., 0])
        return np.asarray(squared > CHI_SQUARE_999[2 + known])

    def _restart(self, body: StereoView) -> None:
        """Begins again with the body alone as it was in the first frame; it has not moved until now."""
        self._keyframes.restart()
        self._first = body
        super()._start(body, self._first_time)
        self._separated, self._velocity_known = True, False
        self._motion.predict(self._now - self._first_time, self._densities)
        landmarks = self._window.landmarks
        self._shape.add(landmarks.serial, self._camera.triangulate(landmarks.measured[:, :3]))

    def _confirm(self, rows: np.ndarray, places: np.ndarray) -> None:
        """Landmarks that agree with the body's pose, at places (K, 2), are its own where they have moved."""
        landmarks = self._window.landmarks
        away = np.linalg.norm(places - landmarks.measured[rows, :2], axis=1)
        uvd = self._window.true_disparity(landmarks.estimate[rows])
        sure = (away > _MOVED) & (uvd[:, 2] > _LEAST_DISPARITY)
        rows = rows[sure]
        host = self._window.poses[landmarks.host[rows]]
        points = self._camera.triangulate(uvd[sure])
        self._shape.add(landmarks.serial[rows], (host[:, :3, :3] @ points[..., None])[..., 0] + host[:, :3, 3])

    def _stands_still(self, view: StereoView, index: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Which of these features are where background was in an earlier view; (K,) bool."""
        still = np.zeros(len(index), bool)
        places = view.measured(index)
        for earlier, earlier_pose in self._references:
            known = np.flatnonzero(np.nan_to_num(earlier.disparity) > _LEAST_DISPARITY)
            before = earlier.measured(known)
            T = se3_inverse(pose) @ earlier_pose
            moved = self._camera.triangulate(before) @ T[:3, :3].T + T[:3, 3]
            front = moved[:, 2] > 1e-6
            carried = self._camera.project(np.where(front[:, None], moved, [0.0, 0.0, 1.0]))
            away = ~front | (np.linalg.norm(carried[:, :2] - before[:, :2], axis=1) > _STILL + _MOVED)
            known, before = known[away], before[away]
            if not len(known) or not len(index):
                continue
            near = np.tile((0.5 * _STILL) ** 2 * np.eye(2), (len(known), 1, 1))
            matches = self._frontend.match(earlier, known, view, before[:, :2], near)
            there = matches.points[
                np.linalg.norm(matches.points - earlier.measured(matches.key_index)[:, :2], axis=1) < _STILL
            ]
            if len(there):
                distance = np.linalg.norm(places[:, None, :2] - there[None], axis=2).min(axis=1)
                still |= distance < _STILL
        return still


def _only(view: StereoView, chosen: np.ndarray) -> StereoView:
    """The view without the disparities of all but the chosen features (N,) bool."""
    return replace(view, disparity=np.where(chosen, view.disparity, np.nan))
