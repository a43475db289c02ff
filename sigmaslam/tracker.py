"""The tracker: one stereo pair in, one pose with covariance out."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field

import numpy as np

from sigmaslam.camera import StereoCamera
from sigmaslam.errors import InputError
from sigmaslam.frontend import StereoView, TemporalMatches, build_frontend
from sigmaslam.landmarks import KeyframeLandmarks, PointMap, merge_maps
from sigmaslam.pose_filter import PoseFilter, PoseState, StereoPoints, UpdateResult
from sigmaslam.rectify import StereoRectifier
from sigmaslam.rotation import se3_adjoint, se3_inverse, se3_log
from sigmaslam.startup import estimate_relative_pose

_LOGGER = logging.getLogger(__name__)

# 99.9 % quantiles of chi-square with 0, 1, 2 and 3 degrees of freedom.
_CHI_SQUARE_999 = np.array([0.0, 10.827566170662733, 13.815510557964274, 16.26623619623813])
# A pose that fewer of the matches near the prediction agree with is not believed.
_LEAST_SHARE = 0.3
# A pose from matches alone has no prediction to agree with. Where fewer than this share of the matches that should be
# right by their probabilities agree with it, twice as many inliers are asked for: symmetric texture in a mirrored image
# once gave 35 inliers, 26 by their probabilities, where 67 should be right. Half of the right ones may be on movers.
_LEAST_SHARE_UNGUIDED = 0.5
# A fit near the prediction with a larger NIS per degree of freedom may sit in a wrong place: it is checked against one
# that does without the prediction.
_DOUBTFUL_NIS = 2.0


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
        least_inliers: fewer is no pose; without a prediction and a fair share of the matches, fewer than twice as many.
        keyframe_ratio: a new keyframe is taken when the inliers fall below this share of what the keyframe began with.
        search_limit: with a predicted place less certain than this (pixels, one sigma) the search is not guided.
        lost_seconds: after this long without a pose, tracking starts anew from the current view.
    """

    max_keypoints: int = 1500
    constant_sigma: tuple[float, float] | None = None
    keyframe_sigma: float = 0.1
    acceleration: float = 0.1
    angular_acceleration: float = 0.5
    start_speed: float = 1.0
    start_turn: float = 1.0
    offset_sigma: float = 0.2
    offset_walk: float = 0.02
    least_inliers: int = 15
    keyframe_ratio: float = 0.6
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
        status: "starting", "tracking" or "lost".
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


@dataclass(slots=True)
class _Keyframe:
    view: StereoView
    landmarks: KeyframeLandmarks
    offset: np.ndarray  # disparity offset as it was known before this keyframe, (1,)
    offset_variance: float
    first_inliers: int | None = None


@dataclass(frozen=True, slots=True)
class _Fit:
    """A posterior that has not been taken over yet, with the rows of the landmarks behind it."""

    state: PoseState
    result: UpdateResult
    points: StereoPoints
    rows: np.ndarray

    @property
    def nis_per_dof(self) -> float:
        return self.result.nis / max(self.result.dof, 1)


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
        self._filter = PoseFilter(self._camera, self.config.offset_sigma, backend)
        self._keyframe: _Keyframe | None = None
        self._retired: list[PointMap] = []
        self._densities = np.zeros(3)
        self._depth = 1.0
        self._timestamp: float | None = None
        self._tracked_at = 0.0
        self._tracked_pose = np.eye(4)  # the pose at that time
        self._moving = False  # there has been a pose from the images
        self._velocity_known = False  # since the last start
        self._origin_covariance = np.zeros((6, 6))  # of the pose where tracking last started anew, in the world

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
        view = self._frontend.observe(*self._rectifier.rectify(left, right))
        clock.lap("features")
        if self._timestamp is None or self._keyframe is None:
            matches, fit = 0, None
            if self._timestamp is not None:
                self._predict(timestamp)
            if self._take_keyframe(view):
                self._anchor(timestamp)
            status = "starting"
        else:
            self._predict(timestamp)
            matches, fit = self._track(view, timestamp, clock)
            if fit is None:
                status = "lost" if self._moving else "starting"
                self._recover(view, timestamp)
            else:
                status = "tracking"
                self._accept(fit, view, timestamp)
        clock.lap("map")
        self._timestamp = timestamp
        return self._report(timestamp, status, matches, fit, clock.milliseconds)

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times."""
        parts = list(self._retired)
        if self._keyframe is not None:
            parts.append(self._keyframe_map())
        merged = merge_maps(parts)
        R = self._T_rectified_left[:3, :3]
        return PointMap(merged.points @ R, R.T @ merged.covariances @ R, merged.observations)

    def _predict(self, timestamp: float) -> None:
        assert self._timestamp is not None
        self._filter.predict(timestamp - self._timestamp, self._densities)

    def _track(self, view: StereoView, timestamp: float, clock: _Stopwatch) -> tuple[int, _Fit | None]:
        """Matches the keyframe with the view, first near the prediction, then anywhere; number of matches and fit."""
        assert self._keyframe is not None
        landmarks = self._keyframe.landmarks
        predicted, S, in_front = self._filter.innovate(
            landmarks.measured, landmarks.sigma, np.tile(np.eye(3), (len(landmarks.index), 1, 1))
        )
        spread = np.linalg.eigvalsh(S[:, :2, :2])[:, 1]
        matches, fit = 0, None
        rows = np.flatnonzero(in_front & self._in_image(predicted))
        enough = len(rows) >= self.config.least_inliers
        if enough and self._velocity_known and np.median(spread[rows]) < self.config.search_limit**2:
            ellipses = S[rows, :2, :2]
            found = self._frontend.match(
                self._keyframe.view, landmarks.index[rows], view, predicted[rows, :2], ellipses
            )
            clock.lap("match")
            matches, fit = len(found.key_index), self._fit(found)
            clock.lap("filter")
        if fit is None or fit.nis_per_dof > _DOUBTFUL_NIS:
            found = self._frontend.match(self._keyframe.view, landmarks.index, view, predicted[:, :2], None)
            clock.lap("match")
            other = self._fit_without_prediction(found, timestamp)
            clock.lap("filter")
            if fit is None or (other is not None and other.nis_per_dof < fit.nis_per_dof):
                matches, fit = len(found.key_index), other
        return matches, fit

    def _in_image(self, predicted: np.ndarray) -> np.ndarray:
        u, v = predicted[:, 0], predicted[:, 1]
        return np.asarray((u >= 0) & (v >= 0) & (u < self._camera.width) & (v < self._camera.height))

    def _stereo_points(self, found: TemporalMatches) -> tuple[StereoPoints, np.ndarray]:
        """Matches as measurements of landmarks, and the landmarks' rows."""
        assert self._keyframe is not None
        landmarks = self._keyframe.landmarks
        rows = np.searchsorted(landmarks.index, found.key_index)
        noise = np.zeros((len(rows), 3, 3))
        if self.config.constant_sigma is None:
            noise[:, :2, :2] = found.covariance
            noise[:, 2, 2] = np.where(np.isfinite(found.disparity), found.disparity_sigma, 1.0) ** 2
        else:
            place, disparity = self.config.constant_sigma
            noise[:] = np.diag([place, place, disparity]) ** 2
        measurement = np.column_stack([found.points, found.disparity])
        return StereoPoints(landmarks.measured[rows], landmarks.sigma[rows], measurement, noise), rows

    def _fit(self, found: TemporalMatches) -> _Fit | None:
        """Chi-square gate on the innovation, update, gate on the residual, update again."""
        points, rows = self._stereo_points(found)
        if len(rows) < self.config.least_inliers:
            return None
        predicted, S, in_front = self._filter.innovate(points.landmarks, points.landmark_sigma, points.noise)
        innovation = points.measurement - predicted
        known = np.isfinite(innovation)
        # A disparity that is not there: no innovation, unit variance, no covariance with the rest.
        present = known[:, :, None] & known[:, None, :]
        S = np.where(present, S, np.eye(3))
        innovation = np.where(known, innovation, 0.0)
        distance = np.einsum("mi,mi->m", innovation, np.linalg.solve(S, innovation[..., None])[..., 0])
        kept = in_front & (distance <= _CHI_SQUARE_999[known.sum(axis=1)])
        if kept.sum() < self.config.least_inliers:
            return None
        state, result = self._filter.evaluate_update(points.select(kept))
        bad = result.squared_residual > _CHI_SQUARE_999[result.components]
        if bad.any():
            kept[np.flatnonzero(kept)[bad]] = False
            if kept.sum() < self.config.least_inliers:
                return None
            state, result = self._filter.evaluate_update(points.select(kept))
        if kept.sum() < _LEAST_SHARE * len(rows):
            return None
        return _Fit(state, result, points.select(kept), rows[kept])

    def _fit_without_prediction(self, found: TemporalMatches, timestamp: float) -> _Fit | None:
        """Start-up and recovery: relative pose from the matches alone, then the update from a vague prior about it."""
        points, _ = self._stereo_points(found)
        relative = estimate_relative_pose(
            self._camera,
            points.landmarks,
            points.landmark_sigma,
            points.measurement,
            points.noise,
            found.probability,
        )
        if relative is None:
            return None
        # Each by its probability: many doubtful ones are few.
        agreeing = float(found.probability[relative.inliers].sum())
        fair = agreeing >= _LEAST_SHARE_UNGUIDED * found.probability.sum()
        least = self.config.least_inliers * (1 if fair else 2)
        if agreeing < least:
            return None
        before = self._filter.state
        self._filter.set_pose_from_clone(relative.T_key_camera, np.repeat([0.01 * self._depth, 0.01], 3))
        # The mean velocity since the last pose, as uncertain as an acceleration over that time makes it.
        elapsed = timestamp - self._tracked_at
        sigma = np.sqrt(np.repeat(self._densities[:2], 3) * elapsed)
        self._filter.set_twist(se3_log(se3_inverse(self._tracked_pose) @ self._filter.state.pose) / elapsed, sigma)
        fit = self._fit(found.select(relative.inliers))
        if fit is None or len(fit.rows) < least:
            self._filter.state = before
            return None
        return fit

    def _forget_twist(self) -> None:
        sigma = np.repeat([self.config.start_speed * self._depth, self.config.start_turn], 3)
        self._filter.set_twist(np.zeros(6), sigma)

    def _anchor(self, timestamp: float) -> None:
        """Remembers the pose that the next velocity is measured from."""
        self._tracked_at = timestamp
        self._tracked_pose = self._filter.state.pose

    def _accept(self, fit: _Fit, view: StereoView, timestamp: float) -> None:
        """Takes the posterior over, sharpens the map, and takes a new keyframe when the old one fades."""
        assert self._keyframe is not None
        if self._keyframe.first_inliers is None:
            self._keyframe.first_inliers = len(fit.rows)
        faded = len(fit.rows) < self.config.keyframe_ratio * self._keyframe.first_inliers
        self._filter.state = fit.state
        self._anchor(timestamp)
        self._moving = self._velocity_known = True
        known = np.isfinite(fit.points.measurement[:, 2])
        self._keyframe.landmarks.observe(
            fit.rows[known],
            fit.points.measurement[known],
            fit.points.noise[known],
            se3_inverse(fit.state.clone) @ fit.state.pose,
            self._camera,
            float(fit.state.offset[0]),
        )
        if faded and self._take_keyframe(view):
            return
        # Every view of a keyframe repeats the noise of its landmarks. The pose forgets between frames, the offset does
        # not: it is estimated in each frame from what was known before the keyframe, and only the last view, the one
        # with the longest baseline, is remembered.
        self._filter.hold_offset(self._keyframe.offset, self._keyframe.offset_variance)

    def _recover(self, view: StereoView, timestamp: float) -> None:
        """Without a pose: wait for a while, then go on from this view with the uncertainty of the prediction."""
        if timestamp - self._tracked_at > self.config.lost_seconds and self._take_keyframe(view):
            _LOGGER.warning(
                "tracking starts anew at %.3f s, %.2f s after the last pose", timestamp, timestamp - self._tracked_at
            )
            self._origin_covariance = self._origin_covariance + self._filter.forget_origin()
            self._anchor(timestamp)
            self._forget_twist()
            self._velocity_known = False

    def _take_keyframe(self, view: StereoView) -> bool:
        """Makes this view the keyframe if it has enough stereo points."""
        index = np.flatnonzero(np.isfinite(view.disparity))
        if len(index) < 2 * self.config.least_inliers:
            return False
        if self._keyframe is not None:
            self._retired.append(self._keyframe_map())
        measured = np.column_stack([view.features.keypoints[index].astype(np.float64), view.disparity[index]])
        keypoint = np.full(len(index), self.config.keyframe_sigma)
        known = self.config.constant_sigma
        disparity = view.disparity_sigma[index] if known is None else np.full(len(index), known[1])
        sigma = np.column_stack([keypoint, keypoint, disparity])
        starting = self._keyframe is None
        self._filter.clone_pose()
        state = self._filter.state
        self._keyframe = _Keyframe(
            view,
            KeyframeLandmarks(index, measured, sigma),
            state.offset,
            state.offset_variance,
        )
        self._depth = self._camera.fx * self._camera.baseline / max(float(np.median(view.disparity[index])), 0.5)
        self._densities = np.array(
            [
                (self.config.acceleration * self._depth) ** 2,
                self.config.angular_acceleration**2,
                self.config.offset_walk**2,
            ]
        )
        if starting:
            self._forget_twist()
        return True

    def _keyframe_map(self) -> PointMap:
        assert self._keyframe is not None
        state = self._filter.state
        return self._keyframe.landmarks.to_map(state.clone, self._camera, float(state.offset[0]), least_observations=3)

    def _report(
        self, timestamp: float, status: str, matches: int, fit: _Fit | None, milliseconds: dict[str, float]
    ) -> Estimate:
        state = self._filter.state
        knows = fit.state if fit is not None else state  # the offset as this frame alone adds to it
        # The filter knows the rectified camera; users know the left camera of their calibration.
        T_left_rectified = se3_inverse(self._T_rectified_left)
        adjoint = se3_adjoint(T_left_rectified)
        absolute = state.body_covariance(self._origin_covariance)
        relative = state.relative_covariance() if status == "tracking" else absolute
        belief = 1.0 - np.sqrt(max(np.linalg.eigvalsh(relative)[-1], 0.0))
        return Estimate(
            timestamp=timestamp,
            T_world_camera=T_left_rectified @ state.pose @ self._T_rectified_left,
            covariance=adjoint @ absolute @ adjoint.T,
            status=status,
            belief=float(np.clip(belief, 0.0, 1.0)),
            matches=matches,
            inliers=len(fit.rows) if fit is not None else 0,
            nis=fit.result.nis if fit is not None else 0.0,
            dof=fit.result.dof if fit is not None else 0,
            calibration=CalibrationEstimate(float(knows.offset[0]), float(np.sqrt(knows.offset_variance))),
            milliseconds=milliseconds,
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
