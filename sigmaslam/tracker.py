"""The tracker: one stereo pair in, one pose with covariance out."""

from __future__ import annotations

import logging
from enum import Enum, auto
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.camera import StereoCamera
from sigmaslam.config import TrackerConfig
from sigmaslam.errors import InputError
from sigmaslam.estimate import CalibrationEstimate, Estimate
from sigmaslam.frame_fit import FrameFit
from sigmaslam.frame_update import FrameUpdate
from sigmaslam.frontend import Frontend, StereoView, build_frontend
from sigmaslam.guided_matching import GuidedMatcher, GuidedMatches
from sigmaslam.keyframes import Keyframes
from sigmaslam.landmark_admission import AdmitAll, LandmarkAdmission
from sigmaslam.landmark_table import LandmarkViews
from sigmaslam.linearise import ViewLineariser
from sigmaslam.localisation import Localiser, Prediction
from sigmaslam.loop_closure import LoopCloser
from sigmaslam.mapping import KeyframeTracks, Mapper
from sigmaslam.measurement_noise import MeasurementNoise
from sigmaslam.motion import MotionFilter
from sigmaslam.point_map import PointMap
from sigmaslam.rectify import StereoRectifier
from sigmaslam.relocalisation import Relocalisation, Relocaliser
from sigmaslam.rotation import se3_adjoint, se3_inverse, turn_covariance
from sigmaslam.state_layout import CALIBRATION, pose_slice
from sigmaslam.stopwatch import Stopwatch
from sigmaslam.unguided_matching import UnguidedMatcher
from sigmaslam.window import KeyframeWindow

__all__ = ["CalibrationEstimate", "Estimate", "StereoTracker", "TrackerConfig"]

_LOGGER = logging.getLogger(__name__)

# A blurred view whose matches scatter by so many times the variance that they claim is no keyframe. A sharp one is: no
# keyframes at all for 20 frames lost the KITTI drive.
_SCATTERED = 1.6
# Tracking starts from a view of which this share of the keypoints is seen by both eyes.
_MIN_STEREO_SHARE = 0.25
# Variance of a pose that is not known at all, m^2 and rad^2.
_ANYWHERE = 1e6


class Phase(Enum):
    """What a tracker knows; a lost one stays in its phase."""

    WAITING = auto()  # no keyframe yet
    WAITING_IN_MAP = auto()  # no keyframe yet, and the world is a map's
    STARTING = auto()  # a keyframe, but no pose from images yet
    TRACKING = auto()  # poses and a velocity
    RESUMED = auto()  # there have been poses, but the velocity since the last one is unknown


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
        admission: what may become a landmark; by default everything.
    """

    def __init__(
        self,
        camera: StereoCamera,
        frontend: Frontend | str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
        admission: LandmarkAdmission | None = None,
    ) -> None:
        self.config = config = config or TrackerConfig()
        self._rectifier = StereoRectifier(camera)
        self._camera = rectified = self._rectifier.rectified
        self._T_rectified_left = np.eye(4)
        self._T_rectified_left[:3, :3] = self._rectifier.R_rectified_left
        if isinstance(frontend, str):
            frontend = build_frontend(frontend, config.max_keypoints, backend)
        self._frontend = frontend
        self._admission = admission or AdmitAll(config.min_inliers)
        lineariser = ViewLineariser(rectified, backend, config.linearisation == "unscented")
        calibration_sigma = np.array([config.offset_sigma, config.turn_sigma, config.turn_sigma])
        self._window = window = KeyframeWindow(rectified, calibration_sigma, lineariser)
        self._noise = noise = MeasurementNoise(config)
        self._motion = MotionFilter(backend)
        self._keyframes = keyframes = Keyframes(window, config.max_keyframes, config.max_points)
        update = FrameUpdate(window, config.iterations)
        guided = GuidedMatcher(rectified, frontend, window, update, noise, config)
        self._unguided = unguided = UnguidedMatcher(rectified, frontend, window, noise, config)
        self._localiser = Localiser(window, update, guided, unguided, config)
        self._mapper = Mapper(rectified, window, keyframes, noise, config)
        self._loops = LoopCloser(window, keyframes, unguided)
        self._relocaliser = Relocaliser(window, keyframes, unguided, self._admission, config.min_inliers)
        self._phase = Phase.WAITING
        self._timestamp: float | None = None
        self._tracked_at = self._started_at = 0.0
        self._landmarks_in_keyframe = 0

    def load_map(self, path: Path) -> None:
        """Takes the world of a map that `sigmaslam track` has written; tracking starts where a view is found in it.

        Raises:
            InputError: the file is no map, or made with another front-end or camera.
        """
        self._keyframes.load(path, self._frontend.name, self._camera)
        self._phase = Phase.WAITING_IN_MAP

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> Estimate:
        """Takes one stereo pair.

        Args:
            left, right: (H, W) uint8, raw images of the calibrated size.
            timestamp: seconds, larger than the one before.
        Raises:
            InputError: the time stamp does not increase.
            FrameError: an image has the wrong type or size.
        """
        self._check_time(timestamp)
        clock = Stopwatch()
        view = self._frontend.observe(*self._rectifier.rectify(left, right))
        clock.lap("features")
        self._predict(timestamp)
        matches, fit = self._localise(view, timestamp, clock)
        tracks = None
        if fit is not None:
            status = "tracking"
            fit = self._inflate(fit, view)
            expected = self._motion.step, self._motion.step_covariance
            self._correct(fit, matches, timestamp)
            if self._is_keyframe_due(fit):
                tracks = self._insert_tracked(view, timestamp, fit, matches, expected)
        elif (found := self._relocaliser.relocalise(view)) is not None:
            status = "relocalised"
            tracks = self._insert_relocalised(found, timestamp)
        else:
            status = "lost" if self._phase in (Phase.TRACKING, Phase.RESUMED) else "starting"
            tracks = self._start_or_recover(view, timestamp)
        if tracks is not None:
            self._loops.close()
        clock.lap("map")
        self._timestamp = timestamp
        return self._report(timestamp, status, matches, fit, tracks, clock.milliseconds)

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times."""
        return self._keyframes.map().transform(se3_inverse(self._T_rectified_left))

    def describe_rectified(self) -> dict[str, Any]:
        """The rectified pair that tracks are measured in: intrinsics (5,), R_rectified_left (3, 3)."""
        camera = self._camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline])
        return {"intrinsics": intrinsics, "R_rectified_left": self._T_rectified_left[:3, :3]}

    def pack_keyframes(self) -> dict[str, Any]:
        """Keyframes by which a later run finds its place in the map, as arrays by name."""
        return self._keyframes.pack(self._frontend.name, self._camera)

    # ---- the stages of a frame

    def _check_time(self, timestamp: float) -> None:
        if self._timestamp is not None and timestamp <= self._timestamp:
            raise InputError(
                f"time stamp {timestamp:.6f} s does not come after {self._timestamp:.6f} s: sort the frames by time"
            )

    def _predict(self, timestamp: float) -> None:
        if self._timestamp is not None:
            self._motion.predict(timestamp - self._timestamp, self._densities())

    def _localise(self, view: StereoView, timestamp: float, clock: Stopwatch) -> tuple[GuidedMatches, FrameFit | None]:
        """Matches with the window's landmarks, and the pose if enough of them agree."""
        if not len(self._window) or view.is_swapped(self.config.min_inliers):
            return GuidedMatches.empty(), None
        first = self._admission.begin_again(view, self._unguided)
        if first is not None:
            self._restart(first, timestamp)
        return self._localiser.localise(view, self._keyframes.views, self._prediction(), clock)

    def _inflate(self, fit: FrameFit, view: StereoView) -> FrameFit:
        """Patches that are blurred are misplaced alike, along the blur and towards where they were expected.

        Many of them say no more than a few.
        """
        return fit.inflated(max(fit.nis_before_scaling, 1.0) * self._keyframes.blur(view))

    def _correct(self, fit: FrameFit, matches: GuidedMatches, timestamp: float) -> None:
        """Takes the pose over."""
        seen = matches.views.select(fit.inliers)
        self._admission.confirm(seen, self._window)
        self._window.count_sightings(matches.searched, seen.landmark)
        back = se3_inverse(self._window.posterior.poses[-1])
        self._motion.correct(back @ fit.pose, turn_covariance(back, fit.relative))
        self._noise.adapt(fit.nis_per_dof)
        self._tracked_at = timestamp
        self._phase = Phase.TRACKING

    def _is_keyframe_due(self, fit: FrameFit) -> bool:
        """Whether the landmarks of the last keyframe fade, and the view is good enough to replace it."""
        # A scale beyond the NIS is that of blur: such a keyframe would spoil what comes after it.
        blurred = fit.inflation > fit.nis_before_scaling > _SCATTERED
        return fit.count < self.config.keyframe_ratio * self._landmarks_in_keyframe and not blurred

    def _insert_tracked(
        self,
        view: StereoView,
        timestamp: float,
        fit: FrameFit,
        matches: GuidedMatches,
        expected: tuple[np.ndarray, np.ndarray],
    ) -> KeyframeTracks | None:
        """Makes a tracked view a keyframe, where its step from the last one was `expected`."""
        admitted = view.only(self._admission.admit(view, fit.pose, self._window))
        if not admitted.has_stereo(self._admission.min_points, self.config.min_inliers):
            return None
        views = matches.views.select(fit.inliers).inflated(fit.inflation)
        return self._insert(admitted, timestamp, fit.pose, *expected, views)

    def _insert_relocalised(self, found: Relocalisation, timestamp: float) -> KeyframeTracks:
        """Goes on from where a lost view was found."""
        covariance = turn_covariance(found.pose, found.covariance)
        self._phase = Phase.RESUMED
        return self._insert_at_rest(found.view, timestamp, found.pose, found.pose, covariance, found.origin)

    def _start_or_recover(self, view: StereoView, timestamp: float) -> KeyframeTracks | None:
        """Without a pose: starts, or waits for a while and goes on with the uncertainty of the prediction."""
        if self._phase is Phase.WAITING_IN_MAP or not self._has_stereo(view):
            return None
        if self._phase is Phase.WAITING:
            seen_by_both = np.isfinite(view.disparity).mean()
            return self._start(view, timestamp) if seen_by_both >= _MIN_STEREO_SHARE else None
        since = timestamp - self._tracked_at
        if since <= self.config.lost_seconds or not self._admission.restarts_anywhere:
            return None
        _LOGGER.warning("tracking starts anew at %.3f s, %.2f s after the last pose", timestamp, since)
        if self._phase is Phase.TRACKING:
            self._phase = Phase.RESUMED
        motion = self._motion
        return self._insert_at_rest(view, timestamp, self._prediction().pose, motion.step, motion.step_covariance)

    # ---- keyframes

    def _start(self, view: StereoView, timestamp: float) -> KeyframeTracks:
        """Makes the view the first keyframe, and its camera the world."""
        self._started_at, self._phase = timestamp, Phase.STARTING
        view = view.only(self._admission.admit(view, np.eye(4), self._window))
        return self._insert_at_rest(view, timestamp, np.eye(4), np.eye(4), np.zeros((6, 6)))

    def _restart(self, first: StereoView, timestamp: float) -> None:
        """Starts again from the first view, now with other landmarks, and predicts the current frame from there."""
        phase = self._phase
        self._keyframes.restart()
        self._start(first, self._started_at)
        if phase in (Phase.TRACKING, Phase.RESUMED):
            self._phase = Phase.RESUMED
        self._motion.predict(timestamp - self._started_at, self._densities())

    def _insert_at_rest(
        self,
        view: StereoView,
        timestamp: float,
        pose: np.ndarray,
        step: np.ndarray,
        step_covariance: np.ndarray,
        origin: int | None = None,
    ) -> KeyframeTracks:
        """Makes a view a keyframe that sees no known landmark; its velocity is unknown."""
        tracks = self._insert(view, timestamp, pose, step, step_covariance, None, origin)
        sigma = np.repeat([self.config.start_speed * self._window.depth, self.config.start_turn], 3)
        self._motion.forget_twist(sigma)
        self._tracked_at = timestamp
        return tracks

    def _insert(
        self,
        view: StereoView,
        timestamp: float,
        pose: np.ndarray,
        step: np.ndarray,
        step_covariance: np.ndarray,
        views: LandmarkViews | None,
        origin: int | None = None,
    ) -> KeyframeTracks:
        """Makes a view a keyframe; arguments as of `Mapper.insert`."""
        tracks = self._mapper.insert(view, timestamp, pose, step, step_covariance, views, origin)
        self._motion.start_keyframe()
        self._landmarks_in_keyframe = len(tracks)
        return tracks

    def _has_stereo(self, view: StereoView) -> bool:
        return view.has_stereo(self._admission.min_points, self.config.min_inliers)

    # ---- motion and results

    def _densities(self) -> np.ndarray:
        """(2,) power spectral densities of the accelerations."""
        config = self.config
        return np.array([(config.acceleration * self._window.depth) ** 2, config.angular_acceleration**2])

    def _prediction(self) -> Prediction:
        key = self._window.posterior.poses[-1]
        covariance = turn_covariance(key, self._motion.step_covariance)
        return Prediction(key @ self._motion.step, covariance, self._phase is Phase.TRACKING)

    def _report(
        self,
        timestamp: float,
        status: str,
        matches: GuidedMatches,
        fit: FrameFit | None,
        tracks: KeyframeTracks | None,
        milliseconds: dict[str, float],
    ) -> Estimate:
        state = self._window.posterior
        if fit is not None:
            pose, absolute, relative = fit.pose, fit.covariance, fit.relative
            calibration, spread = fit.calibration, fit.calibration_covariance
        elif len(state):
            prediction = self._prediction()
            last = pose_slice(len(state) - 1)
            pose, relative = prediction.pose, prediction.covariance
            absolute = state.covariance[last, last] + relative
            calibration, spread = state.calibration, state.covariance[CALIBRATION, CALIBRATION]
        else:
            pose, calibration, spread = np.eye(4), state.calibration, state.covariance
            relative = absolute = (_ANYWHERE if self._phase is Phase.WAITING_IN_MAP else 0.0) * np.eye(6)
        # The filter knows the rectified camera; users know the left camera of their calibration.
        T_left_rectified = se3_inverse(self._T_rectified_left)
        adjoint = se3_adjoint(T_left_rectified) @ se3_adjoint(se3_inverse(pose))
        belief = 1.0 - np.sqrt(max(np.linalg.eigvalsh(turn_covariance(se3_inverse(pose), relative))[-1], 0.0))
        covariance = adjoint @ absolute @ adjoint.T
        frame_covariance = adjoint @ relative @ adjoint.T if fit is not None else np.zeros((6, 6))
        return Estimate(
            timestamp=timestamp,
            T_world_camera=T_left_rectified @ pose @ self._T_rectified_left,
            covariance=0.5 * (covariance + covariance.T),
            status=status,
            belief=float(np.clip(belief, 0.0, 1.0)),
            matches=len(matches.probability),
            inliers=fit.count if fit is not None else 0,
            nis=fit.nis if fit is not None else 0.0,
            dof=fit.dof if fit is not None else 0,
            calibration=CalibrationEstimate(float(calibration[0]), float(np.sqrt(max(spread[0, 0], 0.0)))),
            milliseconds=milliseconds,
            frame_covariance=0.5 * (frame_covariance + frame_covariance.T),
            tracks=tracks,
        )
