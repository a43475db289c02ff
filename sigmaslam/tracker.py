"""The tracker: one stereo pair in, one pose with covariance out."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sigmaslam.camera import StereoCamera
from sigmaslam.errors import InputError
from sigmaslam.frontend import Features, StereoView, TemporalMatches, build_frontend
from sigmaslam.landmarks import PointMap, map_points, merge_maps, thin_map
from sigmaslam.motion import MotionFilter
from sigmaslam.recall import KeyframeMemory, RememberedKeyframe, pack_keyframes, read_keyframes
from sigmaslam.rectify import StereoRectifier
from sigmaslam.rotation import nearest_rigid, se3_adjoint, se3_body, se3_inverse
from sigmaslam.startup import RelativePose, estimate_relative_pose
from sigmaslam.tables import CALIBRATION, Views, join_views, pose_slice
from sigmaslam.window import FrameFit, KeyframeWindow

_LOGGER = logging.getLogger(__name__)

# A pose that fewer of the matches near the prediction agree with is not believed.
_LEAST_SHARE = 0.3
# A pose from matches alone has no prediction to agree with. Where fewer than this share of the matches that should be
# right by their probabilities agree with it, twice as many inliers are asked for: symmetric texture in a mirrored image
# once gave 35 inliers, 26 by their probabilities, where 67 should be right. Half of the right ones may be on movers.
_LEAST_SHARE_UNGUIDED = 0.5
# A fit near the prediction with a larger NIS per degree of freedom may sit in a wrong place: it is checked against one
# that does without the prediction.
_DOUBTFUL_NIS = 2.0
# With so large a NIS a pose needs so many times the least number of inliers.
_MANY = 3
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
# A loop is looked for beyond so many remembered keyframes, among those that look less than 60 degrees away.
_RECENT_KEYFRAMES, _LOOP_COSINE = 10, 0.5
# A keyframe of which fewer landmarks are in view is not searched for.
_LEAST_OF_A_KEYFRAME = 8
# The noise of matches follows the NIS: bounds of its scale, and the exponent of one frame's part in it.
_NOISE_SCALES, _ADAPTATION = (0.25, 4.0), 0.1


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Settings; the defaults serve driving, indoor flight and endoscopy alike, because lengths scale with scene depth.

    Attributes:
        max_keypoints: per image.
        constant_sigma: standard deviations of every matched place per axis and of every disparity, pixels, in place of
            the matches' own; for comparison.
        keyframe_sigma: of a keypoint of the keyframe itself, pixels; small, because the current place is measured
            relative to its patch.
        acceleration: square root of the power spectral density of the linear acceleration, in median scene depths
            per s^1.5.
        angular_acceleration: the same for rotation, rad / s^1.5.
        start_speed: prior standard deviation of the velocity, median scene depths per second.
        start_turn: of the angular velocity, rad/s.
        offset_sigma: prior of the disparity offset, pixels.
        offset_walk: its random walk, pixels per root second.
        turn_sigma: prior of what a turn of the right camera (yaw, pitch) does to disparities at unit normalised
            coordinates, pixels; zero switches these states off.
        linearisation: "unscented" or "extended".
        iterations: linearisations in a frame's update.
        window: keyframes that are estimated jointly.
        spacing: landmarks are at least so far apart, pixels; what lies closer has the same errors (patches overlap).
        shared_disparity: share of the variance of a landmark's disparities that is the same in all views.
        most_points: of the map; when there are twice as many, the least confirmed half goes.
        remembered: keyframes that are kept to find the way back to.
        most_misses: after so many frames in a row in which it was not found a landmark is no longer looked for.
        least_inliers: fewer is no pose; without a prediction and a fair share of the matches, fewer than twice as many.
        keyframe_ratio: a new keyframe is taken when the inliers fall below this share of the landmarks in the last one.
        search_limit: with a predicted place less certain than this (pixels, one sigma) the search is not guided.
        lost_seconds: after this long without a pose, tracking starts anew from the current view.
    """

    max_keypoints: int = 1500
    constant_sigma: tuple[float, float] | None = None
    keyframe_sigma: float = 0.25
    acceleration: float = 0.1
    angular_acceleration: float = 0.5
    start_speed: float = 1.0
    start_turn: float = 1.0
    offset_sigma: float = 0.5
    offset_walk: float = 0.02
    turn_sigma: float = 0.0
    linearisation: str = "unscented"
    iterations: int = 2
    window: int = 6
    spacing: float = 8.0
    shared_disparity: float = 0.8
    most_points: int = 100_000
    remembered: int = 60
    most_misses: int = 3
    least_inliers: int = 15
    keyframe_ratio: float = 0.65
    search_limit: float = 25.0
    lost_seconds: float = 0.5


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """What the images say about the stereo calibration.

    Attributes:
        disparity_offset: measured minus true disparity, pixels.
        disparity_offset_sigma: its standard deviation, pixels.
    """

    disparity_offset: float
    disparity_offset_sigma: float


@dataclass(frozen=True, slots=True)
class Estimate:
    """Result for one stereo pair.

    Attributes:
        timestamp: seconds.
        T_world_camera: (4, 4) pose of the left camera; the world is the first left camera.
        covariance: (6, 6) of that pose in the camera's own frame, translation (metres) before rotation (radians).
        status: "starting", "tracking", "lost", or "relocalised": found again among keyframes that had left the window,
            or in the map.
        belief: 1 - sqrt of the largest eigenvalue of the covariance of the pose relative to the keyframe (metres and
            radians together), clipped to [0, 1] (Tables 9.1, 9.2).
        matches, inliers: points matched to the keyframe, and those that passed the gate.
        nis, dof: normalised innovation squared and its degrees of freedom; 0 without an update.
        calibration: of the stereo pair.
        milliseconds: wall time by stage.
    """

    timestamp: float
    T_world_camera: np.ndarray
    covariance: np.ndarray
    status: str
    belief: float
    matches: int
    inliers: int
    nis: float
    dof: int
    calibration: CalibrationEstimate
    milliseconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Found:
    """Views of the window's landmarks in the current frame, and the probability of each."""

    views: Views
    probability: np.ndarray
    searched: np.ndarray


class StereoTracker:
    """Tracks a moving stereo camera through a static scene, frame by frame, in bounded time.

    Example:
        tracker = StereoTracker(StereoCamera.from_yaml("stereo.yaml"))
        estimate = tracker.step(left, right, timestamp)

    Args:
        camera: calibration of the raw images; they are rectified here.
        frontend: "learned", "sift", "orb" or "klt".
        backend: "onnx", or "torch" (needs the extra `train`).
        config: settings.
    """

    def __init__(
        self,
        camera: StereoCamera,
        frontend: str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
    ) -> None:
        self.config = config or TrackerConfig()
        self._rectifier = StereoRectifier(camera)
        self._camera = self._rectifier.rectified
        self._T_rectified_left = np.eye(4)
        self._T_rectified_left[:3, :3] = self._rectifier.R_rectified_left
        self._frontend = build_frontend(frontend, self.config.max_keypoints, backend)
        turn = self.config.turn_sigma
        self._window = KeyframeWindow(
            self._camera,
            np.array([self.config.offset_sigma, turn, turn]),
            backend,
            self.config.linearisation,
            self.config.iterations,
        )
        self._motion = MotionFilter(backend)
        self._keyframe_views: list[StereoView] = []
        self._keyframe_times: list[float] = []
        self._reference = 0  # landmarks in the last keyframe
        self._retired: list[PointMap] = []
        self._densities = np.zeros(2)
        self._noise_scale = 1.0
        self._timestamp: float | None = None
        self._tracked_at = 0.0
        self._moving = False  # there has been a pose from the images
        self._velocity_known = False  # since the last start
        self._memory = KeyframeMemory(self.config.remembered)
        self._in_map = False  # the world is that of a map that was loaded
        self.keyframe_views: Views | None = None
        """What the last frame saw if it became a keyframe, by numbers of landmarks that stay."""

    def load_map(self, path: Path) -> None:
        """Takes the world of a map that `sigmaslam track` has written; tracking starts where a view is found in it.

        Raises:
            InputError: the file is no map, or made with another front-end or camera.
        """
        for keyframe in read_keyframes(path, self._frontend.name, self._camera):
            self._memory.add(keyframe)
        self._in_map = True

    def describe_rectified(self) -> dict[str, Any]:
        """The rectified pair that `keyframe_views` are measured in: intrinsics (5,), R_rectified_left (3, 3)."""
        camera = self._camera
        intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline])
        return {"intrinsics": intrinsics, "R_rectified_left": self._T_rectified_left[:3, :3]}

    def pack_keyframes(self) -> dict[str, Any]:
        """Keyframes by which a later run finds its place in the map, as arrays by name."""
        window = self._window
        late = [self._remembered(k) for k in range(len(window))]
        return pack_keyframes([*self._memory.keyframes, *late], self._frontend.name, self._camera)

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
        clock = _Stopwatch()
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
        whole = np.ones(len(self._window.landmarks), bool)
        parts = [*self._retired, map_points(self._window, whole, np.array(self._keyframe_times))]
        return merge_maps(parts).transform(se3_inverse(self._T_rectified_left))

    # ---- where landmarks are

    def _pose_and_step(self) -> tuple[np.ndarray, np.ndarray]:
        """The predicted pose, and its covariance relative to the last keyframe, perturbed in the world."""
        key = self._window.poses[-1]
        adjoint = se3_adjoint(key)
        return key @ self._motion.step, adjoint @ self._motion.step_covariance @ adjoint.T

    def _track(self, view: StereoView, clock: _Stopwatch) -> tuple[_Found, FrameFit | None]:
        """Finds the landmarks in the view, first near the prediction, then anywhere; what was found and the fit."""
        pose, covariance = self._pose_and_step()
        found, fit = _NOTHING, None
        if self._velocity_known:
            found = self._search(view, pose, covariance)
            clock.lap("match")
            fit = self._fit(found, pose, covariance)
            clock.lap("filter")
        if fit is None or fit.nis_per_dof > _DOUBTFUL_NIS:
            other_found, other = self._search_anywhere(view, clock)
            if fit is None or (other is not None and other.nis_per_dof < fit.nis_per_dof):
                found, fit = other_found, other
        if fit is not None and fit.nis_per_dof > _DOUBTFUL_NIS and fit.kept.sum() < _MANY * self.config.least_inliers:
            return found, None  # chance agreement of a few
        return found, fit

    def _search(
        self, view: StereoView, pose: np.ndarray, covariance: np.ndarray, anchor: int = -1, own: float | None = None
    ) -> _Found:
        """Active search: every landmark within the innovation ellipse of its prediction, keyframe by keyframe.

        The pose's covariance is relative to the keyframe `anchor`; `own` as of `_found`.
        """
        own = 1.0 - self.config.shared_disparity if own is None else own
        landmarks = self._window.landmarks
        rows = np.flatnonzero(landmarks.misses < self.config.most_misses)
        if not len(rows):
            return _NOTHING
        predicted, S, in_front = self._window.predict(rows, pose, covariance, anchor)
        S = S[:, :2, :2] + np.eye(2)
        inside = in_front & self._in_image(predicted)
        inside &= np.linalg.eigvalsh(S)[:, 1] < self.config.search_limit**2
        rows, predicted, S = rows[inside], predicted[inside], S[inside]
        parts = []
        for host, key in enumerate(self._keyframe_views):
            chosen = np.flatnonzero(landmarks.host[rows] == host)
            if len(chosen) < _LEAST_OF_A_KEYFRAME:
                continue
            matches = self._frontend.match(key, landmarks.feature[rows[chosen]], view, predicted[chosen, :2], S[chosen])
            # Features of a keyframe ascend with the rows of its landmarks.
            place = np.searchsorted(landmarks.feature[rows[chosen]], matches.key_index)
            parts.append(self._found(rows[chosen][place], matches, rows[chosen], own))
        return _merge(parts)

    def _search_anywhere(self, view: StereoView, clock: _Stopwatch) -> tuple[_Found, FrameFit | None]:
        """Without a prediction: the pose relative to a late keyframe from its features, then landmarks near there."""
        found = _NOTHING
        for back in range(1, min(_LATE_KEYFRAMES, len(self._window)) + 1):
            relative = self._locate(self._keyframe_views[-back], view)
            clock.lap("match")
            if relative is None:
                continue
            start = self._window.poses[-back] @ relative.T_key_camera
            adjoint = se3_adjoint(start)
            # How far the landmarks of other keyframes may be from where this pose expects them.
            margin = np.diag(np.repeat([0.01 * self._window.depth, 0.01], 3) ** 2)
            found = self._search(view, start, adjoint @ (relative.covariance + margin) @ adjoint.T, -back, 1.0)
            clock.lap("match")
            pose, covariance = self._pose_and_step()
            fit = self._window.fit_frame(found.views, pose, covariance, self.config.least_inliers, start)
            clock.lap("filter")
            if fit is not None and fit.kept.sum() >= _LEAST_SHARE * len(found.probability):
                return found, fit
        return found, None

    def _locate(self, key: StereoView, view: StereoView) -> RelativePose | None:
        """Pose relative to a keyframe by all of its stereo features, wherever they are in the view."""
        index = np.flatnonzero(np.isfinite(key.disparity))
        if len(index) < self.config.least_inliers:
            return None
        matches = self._frontend.match(key, index, view, key.features.keypoints[index].astype(np.float64), None)
        rows = matches.key_index
        keypoints = key.features.keypoints[rows].astype(np.float64)
        place = np.full(len(rows), self.config.keyframe_sigma)
        views = self._found(rows, matches, rows[:0]).views
        relative = estimate_relative_pose(
            self._camera,
            np.column_stack([keypoints, key.disparity[rows]]),
            np.column_stack([place, place, key.disparity_sigma[rows]]),
            views.measurement,
            views.noise,
            matches.probability,
        )
        if relative is None:
            return None
        # Each by its probability: many doubtful ones are few.
        agreeing = float(matches.probability[relative.inliers].sum())
        fair = agreeing >= _LEAST_SHARE_UNGUIDED * matches.probability.sum()
        return relative if agreeing >= self.config.least_inliers * (1 if fair else 2) else None

    def _found(self, rows: np.ndarray, matches: TemporalMatches, searched: np.ndarray, own: float = 1.0) -> _Found:
        """Matches as views of landmarks; `own` is the share of a disparity's variance that is this view's alone."""
        noise = np.zeros((len(rows), 3, 3))
        if self.config.constant_sigma is None:
            noise[:, :2, :2] = matches.covariance
            noise[:, 2, 2] = own * np.where(np.isfinite(matches.disparity), matches.disparity_sigma, 1.0) ** 2
        else:
            place, disparity = self.config.constant_sigma
            noise[:] = np.diag([place, place, disparity]) ** 2
        measurement = np.column_stack([matches.points, matches.disparity])
        return _Found(Views(rows, measurement, self._noise_scale * noise), matches.probability, searched)

    def _in_image(self, predicted: np.ndarray) -> np.ndarray:
        u, v = predicted[:, 0], predicted[:, 1]
        return np.asarray((u >= 0) & (v >= 0) & (u < self._camera.width) & (v < self._camera.height))

    # ---- poses

    def _fit(self, found: _Found, pose: np.ndarray, covariance: np.ndarray) -> FrameFit | None:
        """Update from the prediction; most of what was found near it must agree."""
        count = len(found.probability)
        if count < self.config.least_inliers:
            return None
        fit = self._window.fit_frame(found.views, pose, covariance, self.config.least_inliers)
        return fit if fit is not None and fit.kept.sum() >= _LEAST_SHARE * count else None

    def _accept(self, fit: FrameFit, found: _Found, view: StereoView, timestamp: float) -> None:
        """Takes the pose over, and makes the view a keyframe when the old ones fade."""
        landmarks = self._window.landmarks
        landmarks.misses[found.searched] += 1
        seen = found.views.rows[fit.kept]
        landmarks.misses[seen] = 0
        landmarks.views[seen] += 1
        key = self._window.poses[-1]
        back = se3_adjoint(se3_inverse(key))
        expected, step_covariance = self._motion.step, self._motion.step_covariance
        self._motion.correct(se3_inverse(key) @ fit.pose, back @ fit.relative @ back.T)
        self._tracked_at = timestamp
        self._moving = self._velocity_known = True
        if self.config.constant_sigma is None:
            low, high = _NOISE_SCALES
            self._noise_scale = float(np.clip(self._noise_scale * fit.nis_per_dof**_ADAPTATION, low, high))
        count = int(fit.kept.sum())
        if count < self.config.keyframe_ratio * self._reference and self._has_stereo(view):
            self._add_keyframe(view, timestamp, fit.pose, expected, step_covariance, found.views.select(fit.kept))

    def _remember(self, view: StereoView, timestamp: float) -> bool:
        """Finds the view among the remembered keyframes and goes on from there; whether it was found."""
        if not self._has_stereo(view):
            return False
        for keyframe in self._memory.similar(view, _SIMILAR_KEYFRAMES):
            relative = self._locate(keyframe.view, view)
            if relative is None:
                continue
            pose = nearest_rigid(keyframe.pose @ relative.T_key_camera)
            adjoint = se3_adjoint(pose)
            for host in range(len(self._window)):
                self._memory.add(self._remembered(host))
            self._retire(np.ones(len(self._window.landmarks), bool))
            self._window.restart()
            self._keyframe_views, self._keyframe_times = [], []
            self._add_keyframe(
                view, timestamp, pose, pose, keyframe.covariance + adjoint @ relative.covariance @ adjoint.T, None
            )
            self._forget_twist()
            self._tracked_at = timestamp
            self._moving, self._velocity_known = True, False
            return True
        return False

    def _close_loop(self, view: StereoView) -> None:
        """Looks for the newest keyframe among those that were here long ago, and ties it to what is found."""
        window = self._window
        pose, place = window.poses[-1], pose_slice(len(window) - 1)
        reach = window.depth + 3.0 * np.sqrt(np.trace(se3_body(pose, window.covariance[place, place])[:3, :3]))

        def near(keyframe: RememberedKeyframe) -> bool:
            between = se3_inverse(pose) @ keyframe.pose
            return bool(np.linalg.norm(between[:3, 3]) < reach and between[2, 2] > _LOOP_COSINE)

        old = [each for each in self._memory.keyframes[:-_RECENT_KEYFRAMES] if near(each)]
        for keyframe in self._memory.similar(view, 1, old):
            relative = self._locate(keyframe.view, view)
            if relative is None:
                continue
            found = nearest_rigid(keyframe.pose @ relative.T_key_camera)
            adjoint = se3_adjoint(found)
            if window.tie(found, adjoint @ relative.covariance @ adjoint.T, keyframe.covariance):
                _LOGGER.info("loop closed with the keyframe of %.3f s", keyframe.timestamp)

    def _retire(self, chosen: np.ndarray) -> None:
        """Puts landmarks of the window into the map, whose size is bounded."""
        self._retired.append(map_points(self._window, chosen, np.array(self._keyframe_times)))
        if sum(len(part.points) for part in self._retired) > 2 * self.config.most_points:
            self._retired = [thin_map(merge_maps(self._retired), self.config.most_points)]

    def _remembered(self, host: int) -> RememberedKeyframe:
        """A keyframe of the window as the memory keeps it."""
        place = pose_slice(host)
        window = self._window
        return RememberedKeyframe(
            self._keyframe_views[host],
            window.poses[host],
            window.covariance[place, place],
            self._keyframe_times[host],
        )

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

    def _has_stereo(self, view: StereoView) -> bool:
        return int(np.isfinite(view.disparity).sum()) >= 2 * self.config.least_inliers and not self._is_swapped(view)

    def _is_swapped(self, view: StereoView) -> bool:
        """Whether the right image looks like the left eye's: too much lies behind infinity."""
        known = view.disparity[np.isfinite(view.disparity)]
        return len(known) >= self.config.least_inliers and float((known < -1.0).mean()) > _MOST_NEGATIVE

    def _start(self, view: StereoView, timestamp: float) -> None:
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
    ) -> None:
        """Makes the view a keyframe: it sees `views`, and whatever else it has in stereo is new."""
        window = self._window
        if len(window) == self.config.window:
            leaving = window.landmarks.host == 0
            self._retire(leaving)
            self._memory.add(self._remembered(0))
            if views is not None:
                staying = ~leaving[views.rows]
                number = np.cumsum(~leaving) - 1
                views = Views(number[views.rows[staying]], views.measurement[staying], views.noise[staying])
            window.retire_oldest()
            del self._keyframe_views[0], self._keyframe_times[0]
        if len(window):
            adjoint = se3_adjoint(window.poses[-1])
            step_covariance = adjoint @ step_covariance @ adjoint.T
        since = timestamp - self._keyframe_times[-1] if self._keyframe_times else 0.0
        walk = np.array([self.config.offset_walk**2 * since, 0.0, 0.0])
        window.add_keyframe(pose, step, step_covariance, walk)
        self._keyframe_views.append(view)
        self._keyframe_times.append(timestamp)
        if views is not None:
            window.add_views(views)
        self._add_landmarks(view, views)
        own = window.landmarks.select(window.landmarks.host == len(window) - 1)
        first = Views(own.serial, own.measured[:, :3], _with_shared(own.variance))
        seen = [] if views is None else [Views(window.landmarks.serial[views.rows], views.measurement, views.noise)]
        self.keyframe_views = join_views([*seen, first])
        window.solve()
        self._close_loop(view)
        self._motion.start_keyframe()
        self._reference = int((window.landmarks.host == len(window) - 1).sum())
        self._reference += 0 if views is None else len(views.rows)

    def _add_landmarks(self, view: StereoView, views: Views | None) -> None:
        """Stereo points that no landmark has been found at."""
        index = np.flatnonzero(np.isfinite(view.disparity))
        taken = np.zeros((0, 2)) if views is None else views.measurement[:, :2]
        index = index[_apart(view.features.select(index), taken, self.config.spacing, view.left.shape)]
        keypoints = view.features.keypoints[index].astype(np.float64)
        measured = np.column_stack([keypoints, view.disparity[index]])
        known = self.config.constant_sigma
        disparity = view.disparity_sigma[index] if known is None else np.full(len(index), known[1])
        place = np.full(len(index), self.config.keyframe_sigma**2)
        shared = self.config.shared_disparity
        variance = self._noise_scale * np.column_stack(
            [place, place, (1.0 - shared) * disparity**2, shared * disparity**2]
        )
        self._window.add_landmarks(index, measured, variance)
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
        to_body = se3_adjoint(se3_inverse(pose))
        adjoint = se3_adjoint(T_left_rectified) @ to_body
        belief = 1.0 - np.sqrt(max(np.linalg.eigvalsh(to_body @ relative @ to_body.T)[-1], 0.0))
        covariance = adjoint @ absolute @ adjoint.T
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
        )


_NOTHING = _Found(
    Views(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))), np.zeros(0), np.zeros(0, np.int64)
)


def _apart(features: Features, taken: np.ndarray, spacing: float, shape: tuple[int, ...]) -> np.ndarray:
    """Ascending indices of features that are `spacing` from places taken (K, 2) and from each other, best first."""
    occupied = np.zeros(shape, np.uint8)
    radius = round(spacing)

    def occupy(place: np.ndarray) -> None:
        cv2.circle(occupied, (round(float(place[0])), round(float(place[1]))), radius, 1, -1)

    for place in taken:
        occupy(place)
    height, width = shape
    kept = []
    columns, rows = np.clip(np.rint(features.keypoints), 0, (width - 1, height - 1)).astype(int).T
    for k in np.argsort(-features.scores, kind="stable"):
        if not occupied[rows[k], columns[k]]:
            kept.append(k)
            occupy(features.keypoints[k])
    return np.sort(np.array(kept, np.int64))


def _with_shared(variance: np.ndarray) -> np.ndarray:
    """Covariances (K, 3, 3) of (u, v, disparity) from variances of landmarks (K, 4)."""
    return np.asarray(np.eye(3) * np.column_stack([variance[:, :2], variance[:, 2] + variance[:, 3]])[:, None, :])


def _merge(parts: list[_Found]) -> _Found:
    """All that was found."""
    if not parts:
        return _NOTHING
    return _Found(
        join_views([part.views for part in parts]),
        np.concatenate([part.probability for part in parts]),
        np.concatenate([part.searched for part in parts]),
    )


class _Stopwatch:
    """Adds up wall time by stage."""

    def __init__(self) -> None:
        self.milliseconds = dict.fromkeys(("features", "match", "filter", "map"), 0.0)
        self._since = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.milliseconds[stage] += 1e3 * (now - self._since)
        self._since = now
