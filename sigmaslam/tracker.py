"""The tracker: one stereo pair in, one pose with covariance out."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.camera import StereoCamera
from sigmaslam.chi_square import CHI_SQUARE_9999_OF_6
from sigmaslam.config import TrackerConfig
from sigmaslam.errors import InputError
from sigmaslam.estimate import CalibrationEstimate, Estimate
from sigmaslam.frame_fit import FrameFit
from sigmaslam.frontend import Frontend, StereoView, build_frontend
from sigmaslam.frontend.planes import disparity_slopes
from sigmaslam.frontend.relief import patch_relief
from sigmaslam.keyframes import Keyframes
from sigmaslam.landmarks import PointMap
from sigmaslam.match_noise import MatchNoise
from sigmaslam.motion import MotionFilter
from sigmaslam.rectify import StereoRectifier
from sigmaslam.rotation import nearest_rigid, se3_adjoint, se3_inverse, turn_covariance
from sigmaslam.search import Found, LandmarkSearch
from sigmaslam.spacing import select_apart
from sigmaslam.stopwatch import Stopwatch
from sigmaslam.tables import CALIBRATION, Views, join_views, pose_slice
from sigmaslam.window import KeyframeWindow

__all__ = ["CalibrationEstimate", "Estimate", "StereoTracker", "TrackerConfig"]

_LOGGER = logging.getLogger(__name__)

# A pose that fewer of the matches near the prediction agree with is not believed.
_LEAST_SHARE = 0.3
# A fit near the prediction with a larger NIS per degree of freedom may sit in a wrong place: it is checked against one
# that does without the prediction.
_DOUBTFUL_NIS = 2.0
# With so large a NIS a pose needs so many times the least number of inliers.
_MANY = 3
# A blurred view whose matches scatter by so many times the variance that they claim is no keyframe. A sharp one is: no
# keyframes at all for 20 frames lost the KITTI drive.
_SCATTERED = 1.6
# Where more than this share of the disparities is negative by more than a pixel, which no disparity offset explains,
# the eyes are swapped, or nothing fits.
_MOST_NEGATIVE = 0.1
# Tracking starts from a view of which this share of the keypoints is seen by both eyes.
_LEAST_STEREO_SHARE = 0.25
# Variance of a pose that is not known at all, m^2 and rad^2.
_ANYWHERE = 1e6
# Without a prediction the view is compared with so many late keyframes.
_LATE_KEYFRAMES = 3
# When it is lost, with so many of those that left the window, the ones most like it.
_SIMILAR_KEYFRAMES = 3


class StereoTracker:
    """Tracks a moving stereo camera through a static scene, frame by frame, in bounded time.

    Example:
        tracker = StereoTracker(StereoCamera.from_yaml("stereo.yaml"))
        estimate = tracker.step(left, right, timestamp)

    Args:
        camera: calibration of the raw images; they are rectified here.
        frontend: "learned", "sift", "orb", "klt", or one of your own.
        backend: "onnx", or "torch" (needs the extra `train`).
        config: settings.
    """

    def __init__(
        self,
        camera: StereoCamera,
        frontend: Frontend | str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
    ) -> None:
        self.config = config or TrackerConfig()
        self._rectifier = StereoRectifier(camera)
        self._camera = self._rectifier.rectified
        self._T_rectified_left = np.eye(4)
        self._T_rectified_left[:3, :3] = self._rectifier.R_rectified_left
        if isinstance(frontend, str):
            frontend = build_frontend(frontend, self.config.max_keypoints, backend)
        self._frontend = frontend
        turn = self.config.turn_sigma
        self._window = KeyframeWindow(
            self._camera,
            np.array([self.config.offset_sigma, turn, turn]),
            backend,
            self.config.linearisation,
            self.config.iterations,
        )
        self._noise = MatchNoise(self.config)
        self._search = LandmarkSearch(self._camera, self._frontend, self._window, self._noise, self.config)
        self._motion = MotionFilter(backend)
        self._keyframes = Keyframes(self._window, self.config.remembered, self.config.most_points)
        self._reference = 0  # landmarks in the last keyframe
        self._densities = np.zeros(2)
        self._timestamp: float | None = None
        self._tracked_at = 0.0
        self._moving = False  # there has been a pose from the images
        self._velocity_known = False  # since the last start
        self._in_map = False  # the world is that of a map that was loaded
        self.keyframe_views: Views | None = None
        """What the last frame saw if it became a keyframe, by numbers of landmarks that stay."""

    def load_map(self, path: Path) -> None:
        """Takes the world of a map that `sigmaslam track` has written; tracking starts where a view is found in it.

        Raises:
            InputError: the file is no map, or made with another front-end or camera.
        """
        self._keyframes.load(path, self._frontend.name, self._camera)
        self._in_map = True

    def describe_rectified(self) -> dict[str, Any]:
        """The rectified pair that `keyframe_views` are measured in: intrinsics (5,), R_rectified_left (3, 3)."""
        camera = self._camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline])
        return {"intrinsics": intrinsics, "R_rectified_left": self._T_rectified_left[:3, :3]}

    def pack_keyframes(self) -> dict[str, Any]:
        """Keyframes by which a later run finds its place in the map, as arrays by name."""
        return self._keyframes.pack(self._frontend.name, self._camera)

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> Estimate:
        """Takes one stereo pair.

        Args:
            left, right: (H, W) uint8, raw images of the calibrated size.
            timestamp: seconds, larger than the one before.
        Raises:
            InputError: the time stamp does not increase.
            FrameError: an image has the wrong type or size.
        """
        if self._timestamp is not None and timestamp <= self._timestamp:
            raise InputError(
                f"time stamp {timestamp:.6f} s does not come after {self._timestamp:.6f} s: sort the frames by time"
            )
        clock = Stopwatch()
        self.keyframe_views = None
        view = self._frontend.observe(*self._rectifier.rectify(left, right))
        clock.lap("features")
        if self._timestamp is not None:
            self._motion.predict(timestamp - self._timestamp, self._densities)
        matches, fit, status = 0, None, "starting"
        if len(self._window) and not self._is_swapped(view):
            found, fit = self._track(view, clock)
            matches = len(found.probability)
        if fit is not None:
            status = "tracking"
            # Patches that are blurred are misplaced alike, along the blur and towards where they were expected: many of
            # them say no more than a few.
            fit = fit.doubted(max(fit.misfit, 1.0) * self._keyframes.blur(view))
            self._accept(fit, found, view, timestamp)
        elif self._remember(view, timestamp):
            status = "relocalised"
        elif len(self._window):
            status = "lost" if self._moving else "starting"
            self._recover(view, timestamp)
        elif self._has_stereo(view) and np.isfinite(view.disparity).mean() >= _LEAST_STEREO_SHARE and not self._in_map:
            self._start(view, timestamp)
        clock.lap("map")
        self._timestamp = timestamp
        return self._report(timestamp, status, matches, fit, clock.milliseconds)

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times."""
        return self._keyframes.map().transform(se3_inverse(self._T_rectified_left))

    # ---- a frame against the window

    def _pose_and_step(self) -> tuple[np.ndarray, np.ndarray]:
        """The predicted pose, and its covariance relative to the last keyframe, perturbed in the world."""
        key = self._window.poses[-1]
        return key @ self._motion.step, turn_covariance(key, self._motion.step_covariance)

    def _track(self, view: StereoView, clock: Stopwatch) -> tuple[Found, FrameFit | None]:
        """Finds the landmarks in the view, first near the prediction, then anywhere; what was found and the fit."""
        pose, covariance = self._pose_and_step()
        found, fit = Found.nothing(), None
        if self._velocity_known:
            found = self._search.near(view, self._keyframes.views, pose, covariance)
            clock.lap("match")
            fit = self._fit(found, pose, covariance)
            clock.lap("filter")
        if fit is None or fit.nis_per_dof > _DOUBTFUL_NIS:
            other_found, other = self._track_anywhere(view, clock)
            if fit is None or (other is not None and other.nis_per_dof < fit.nis_per_dof):
                found, fit = other_found, other
        if fit is not None and fit.misfit > _DOUBTFUL_NIS and fit.kept.sum() < _MANY * self.config.least_inliers:
            return found, None  # chance agreement of a few
        return found, fit

    def _track_anywhere(self, view: StereoView, clock: Stopwatch) -> tuple[Found, FrameFit | None]:
        """Without a prediction: the pose relative to a late keyframe from its features, then landmarks near there."""
        found = Found.nothing()
        for back in range(1, min(_LATE_KEYFRAMES, len(self._window)) + 1):
            relative = self._search.locate(self._keyframes.views[-back], view)
            clock.lap("match")
            if relative is None:
                continue
            start = self._window.poses[-back] @ relative.T_key_camera
            # How far the landmarks of other keyframes may be from where this pose expects them.
            margin = np.diag(np.repeat([0.01 * self._window.depth, 0.01], 3) ** 2)
            uncertain = turn_covariance(start, relative.covariance + margin)
            found = self._search.near(view, self._keyframes.views, start, uncertain, -back, alone=True)
            clock.lap("match")
            pose, covariance = self._pose_and_step()
            fit = self._window.fit_frame(
                found.views, pose, covariance, self.config.least_inliers, start, relative.scale
            )
            clock.lap("filter")
            if fit is not None and fit.kept.sum() >= _LEAST_SHARE * len(found.probability):
                return found, fit
        return found, None

    def _fit(self, found: Found, pose: np.ndarray, covariance: np.ndarray) -> FrameFit | None:
        """Update from the prediction; most of what was found near it must agree."""
        count = len(found.probability)
        if count < self.config.least_inliers:
            return None
        fit = self._window.fit_frame(found.views, pose, covariance, self.config.least_inliers)
        if fit is None or fit.prior_cost > CHI_SQUARE_9999_OF_6:
            # The camera has jumped, and all matches with it; or something moves that gives most of them, and those that
            # stand still agree with a pose close to the prediction: it holds on to that first.
            expected = np.flatnonzero(self._window.expected_views(found.views, pose, covariance))
            views = found.views.select(expected)
            least = _MANY * self.config.least_inliers
            steady = self._window.fit_frame(views, pose, 0.01 * covariance, least)
            if steady is not None:
                expected = expected[steady.kept]
                steady = self._window.fit_frame(found.views.select(expected), pose, covariance, least)
            if steady is not None and steady.kept.sum() >= _LEAST_SHARE * count:
                kept = np.zeros(count, bool)
                kept[expected] = steady.kept
                fit = replace(steady, kept=kept)
        return fit if fit is not None and fit.kept.sum() >= _LEAST_SHARE * count else None

    def _accept(self, fit: FrameFit, found: Found, view: StereoView, timestamp: float) -> None:
        """Takes the pose over, and makes the view a keyframe when the old ones fade."""
        landmarks = self._window.landmarks
        landmarks.misses[found.searched] += 1
        seen = found.views.rows[fit.kept]
        landmarks.misses[seen] = 0
        landmarks.views[seen] += 1
        back = se3_inverse(self._window.poses[-1])
        expected, step_covariance = self._motion.step, self._motion.step_covariance
        self._motion.correct(back @ fit.pose, turn_covariance(back, fit.relative))
        self._tracked_at = timestamp
        self._moving = self._velocity_known = True
        self._noise.adapt(fit.nis_per_dof)
        count = int(fit.kept.sum())
        if count < self.config.keyframe_ratio * self._reference:
            if fit.doubt > fit.misfit > _SCATTERED:  # more than the misfit is what blur adds
                return  # a bad keyframe would spoil what comes after it; the next view may be a better one
            view = self._choose(view, fit.pose)
            if self._has_stereo(view):
                views = found.views.select(fit.kept).scaled(fit.doubt)
                self._add_keyframe(view, timestamp, fit.pose, expected, step_covariance, views)

    # ---- places that were visited before

    def _remember(self, view: StereoView, timestamp: float) -> bool:
        """Finds the view among the remembered keyframes and goes on from there; whether it was found."""
        if not self._has_stereo(view):
            return False
        memory = self._keyframes.memory
        for keyframe in memory.similar(view, _SIMILAR_KEYFRAMES):
            relative = self._search.locate(keyframe.view, view)
            if relative is None:
                continue
            chosen = self._choose(view, nearest_rigid(keyframe.pose @ relative.T_key_camera))
            if not self._has_stereo(chosen):
                continue
            while len(self._window):
                self._keyframes.retire_oldest(keyframe.timestamp)
            memory.refresh(self._window.past)
            origin = memory.index(keyframe.timestamp)
            pose = nearest_rigid(memory.keyframes[origin].pose @ relative.T_key_camera)
            self._add_keyframe(chosen, timestamp, pose, pose, turn_covariance(pose, relative.covariance), None, origin)
            self._forget_twist()
            self._tracked_at = timestamp
            self._moving, self._velocity_known = True, False
            return True
        return False

    def _close_loop(self, view: StereoView) -> None:
        """Looks for the newest keyframe among those that were here long ago, and ties it to what is found."""
        memory = self._keyframes.memory
        for keyframe in memory.similar(view, 1, self._keyframes.revisited()):
            relative = self._search.locate(keyframe.view, view)
            if relative is None:
                continue
            index = memory.index(keyframe.timestamp)
            match = turn_covariance(keyframe.pose @ relative.T_key_camera, relative.covariance)
            if self._window.tie(index, relative.T_key_camera, match):
                _LOGGER.info("loop closed with the keyframe of %.3f s", keyframe.timestamp)
                memory.refresh(self._window.past)

    def _recover(self, view: StereoView, timestamp: float) -> None:
        """Without a pose: wait for a while, then go on from this view with the uncertainty of the prediction."""
        if timestamp - self._tracked_at > self.config.lost_seconds and self._has_stereo(view):
            _LOGGER.warning(
                "tracking starts anew at %.3f s, %.2f s after the last pose", timestamp, timestamp - self._tracked_at
            )
            pose, _ = self._pose_and_step()
            self._add_keyframe(view, timestamp, pose, self._motion.step, self._motion.step_covariance, None)
            self._forget_twist()
            self._tracked_at = timestamp
            self._velocity_known = False

    # ---- keyframes

    def _choose(self, view: StereoView, pose: np.ndarray) -> StereoView:
        """The view with disparities only where it may become landmarks, seen from `pose`: here everywhere."""
        return view

    def _has_stereo(self, view: StereoView) -> bool:
        return int(np.isfinite(view.disparity).sum()) >= 2 * self.config.least_inliers and not self._is_swapped(view)

    def _is_swapped(self, view: StereoView) -> bool:
        """Whether the right image looks like the left eye's: too much lies behind infinity."""
        known = view.disparity[np.isfinite(view.disparity)]
        return len(known) >= self.config.least_inliers and float((known < -1.0).mean()) > _MOST_NEGATIVE

    def _start(self, view: StereoView, timestamp: float) -> None:
        view = self._choose(view, np.eye(4))
        self._add_keyframe(view, timestamp, np.eye(4), np.eye(4), np.zeros((6, 6)), None)
        self._forget_twist()
        self._tracked_at = timestamp

    def _add_keyframe(
        self,
        view: StereoView,
        timestamp: float,
        pose: np.ndarray,
        step: np.ndarray,
        step_covariance: np.ndarray,
        views: Views | None,
        origin: int | None = None,
    ) -> None:
        """Makes the view a keyframe: it sees `views`, and whatever else it has in stereo is new."""
        window = self._window
        if len(window) == self.config.window:
            number = self._keyframes.retire_oldest()
            if views is not None:
                views = views.renumber(number)
        if len(window):
            step_covariance = turn_covariance(window.poses[-1], step_covariance)
        since = timestamp - self._keyframes.times[-1] if self._keyframes.times else 0.0
        walk = np.array([self.config.offset_walk**2 * since, 0.0, 0.0])
        window.add_keyframe(pose, step, step_covariance, walk, origin)
        slope = disparity_slopes(view.features.keypoints, view.disparity)
        view = replace(view, slope=slope)
        self._keyframes.append(view, timestamp)
        if views is not None:
            window.add_views(views)
        self._add_landmarks(view, views, slope)
        first = window.landmarks.select(window.landmarks.host == len(window) - 1).first_views()
        seen = [] if views is None else [replace(views, rows=window.landmarks.serial[views.rows])]
        self.keyframe_views = join_views([*seen, first])
        window.solve()
        self._keyframes.memory.refresh(window.past)
        self._close_loop(view)
        self._motion.start_keyframe()
        self._reference = int((window.landmarks.host == len(window) - 1).sum())
        self._reference += 0 if views is None else len(views.rows)

    def _add_landmarks(self, view: StereoView, views: Views | None, slope: np.ndarray) -> None:
        """Stereo points that no landmark has been found at."""
        index = np.flatnonzero(np.isfinite(view.disparity))
        taken = np.zeros((0, 2)) if views is None else views.measurement[:, :2]
        index = index[select_apart(view.features.select(index), taken, self.config.spacing, view.left.shape)]
        measured = view.measured(index)
        relief = patch_relief(view.left, view.right, measured, slope[index])
        self._window.add_landmarks(index, measured, self._noise.of_keypoints(view, index), relief)
        depth = self._camera.fx * self._camera.baseline / max(float(np.nanmedian(view.disparity)), 0.5)
        self._window.depth = depth
        self._densities = np.array([(self.config.acceleration * depth) ** 2, self.config.angular_acceleration**2])

    def _forget_twist(self) -> None:
        self._motion.forget_twist(np.repeat([self.config.start_speed * self._window.depth, self.config.start_turn], 3))

    # ---- results

    def _report(
        self, timestamp: float, status: str, matches: int, fit: FrameFit | None, milliseconds: dict[str, float]
    ) -> Estimate:
        window = self._window
        if fit is not None:
            pose, absolute, relative = fit.pose, fit.covariance, fit.relative
            calibration, spread = fit.calibration, fit.calibration_covariance
        elif len(window):
            pose, step = self._pose_and_step()
            last = pose_slice(len(window) - 1)
            relative, absolute = step, window.covariance[last, last] + step
            calibration, spread = window.calibration, window.covariance[CALIBRATION, CALIBRATION]
        else:
            pose, calibration, spread = np.eye(4), window.calibration, window.covariance
            relative = absolute = (_ANYWHERE if self._in_map else 0.0) * np.eye(6)
        # The filter knows the rectified camera; users know the left camera of their calibration.
        T_left_rectified = se3_inverse(self._T_rectified_left)
        adjoint = se3_adjoint(T_left_rectified) @ se3_adjoint(se3_inverse(pose))
        belief = 1.0 - np.sqrt(max(np.linalg.eigvalsh(turn_covariance(se3_inverse(pose), relative))[-1], 0.0))
        covariance = adjoint @ absolute @ adjoint.T
        own = adjoint @ relative @ adjoint.T if fit is not None else np.zeros((6, 6))
        return Estimate(
            timestamp=timestamp,
            T_world_camera=T_left_rectified @ pose @ self._T_rectified_left,
            covariance=0.5 * (covariance + covariance.T),
            status=status,
            belief=float(np.clip(belief, 0.0, 1.0)),
            matches=matches,
            inliers=int(fit.kept.sum()) if fit is not None else 0,
            nis=fit.nis if fit is not None else 0.0,
            dof=fit.dof if fit is not None else 0,
            calibration=CalibrationEstimate(float(calibration[0]), float(np.sqrt(max(spread[0, 0], 0.0)))),
            milliseconds=milliseconds,
            own_covariance=0.5 * (own + own.T),
        )
