"""The tracker: one stereo pair in, one pose with covariance out."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from sigmaslam.estimation.build_motion import build_motion
from sigmaslam.estimation.calibration_errors import ERRORS, TURNS, CalibrationPrior
from sigmaslam.estimation.clustered_errors import SharedErrors
from sigmaslam.estimation.estimator_graphs import EstimatorGraphs
from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend import Frontend, build_frontend
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.inertial_sensor import InertialSensor
from sigmaslam.geometry.odometry_sensor import OdometrySensor
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.inference.networks import WeightsFolder
from sigmaslam.slam.argument_checks import check_frame, check_sample, check_tracker_arguments
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.frame import Frame, usable_pixels
from sigmaslam.slam.frame_history import FrameHistory
from sigmaslam.slam.frozen_images import LastPairs, is_noise
from sigmaslam.slam.guided_matching import GuidedMatcher, GuidedMatches
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_admission import AdmitAll, LandmarkAdmission
from sigmaslam.slam.landmark_following import LandmarkFollower
from sigmaslam.slam.localisation import Localiser, Prediction
from sigmaslam.slam.loop_closure import LoopCloser
from sigmaslam.slam.map_file import TURN
from sigmaslam.slam.mapping import Mapper
from sigmaslam.slam.matched_frame import MatchedFrame
from sigmaslam.slam.measurement_noise import MeasurementNoise
from sigmaslam.slam.phase import Course, Phase
from sigmaslam.slam.point_map import PointMap
from sigmaslam.slam.recovery import Recovery
from sigmaslam.slam.relative_poses import RelativePoseReporter
from sigmaslam.slam.relocalisation import Relocaliser
from sigmaslam.slam.reporting import Reporter
from sigmaslam.slam.rig_change import RigChange, find_change
from sigmaslam.slam.scrutiny import Scrutiny
from sigmaslam.slam.set_clock import by_times
from sigmaslam.slam.start_pose import StartPose
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.slam.unguided_matching import UnguidedMatcher

__all__ = ["CalibrationEstimate", "Estimate", "StereoTracker", "TrackerConfig"]


class StereoTracker:
    """Tracks a moving stereo camera through a static scene, frame by frame, in bounded time.

    Example:
        tracker = StereoTracker(StereoCamera.from_yaml("stereo.yaml"))
        estimate = tracker.step(left, right, timestamp)

    Args:
        camera: calibration of the raw images; they are rectified here.
        frontend: "learned", "sift", "orb", "klt", or one of your own.
        backend: "onnx", or "torch" (needs the extra `train`).
        admission: what may become a landmark; by default everything.
        threads: of the network.
        start: pose of the first frame, a keyframe of an earlier run, in its world; by default that frame is the world.
        provider: where ONNX Runtime computes the networks, "cpu", "cuda" or "openvino"; the estimator stays on the CPU.
        weights: folder of one's own networks, as `sigmaslam train export` writes it, before those that ship.
        disparity_error: pixels by which a check found disparities to be off: poses are doubtful, and less certain.
        imu: an inertial sensor on the rig, whose samples `add_imu` takes.
        odometry: wheels under the rig, whose samples `add_odometry` takes.
        right_delay: seconds by which right images are later than left ones: disparities are corrected, bumps not seen.

    Attributes:
        rectifier: of the images that are tracked.
        last_frame: what the last frame saw, for pictures, to be copied before one draws; None before the first.
    Raises:
        InputError: an argument is of another type, or there is no such front-end or backend, the provider is not
            installed, or the folder of weights holds no network of the front-end, or one that does not fit.
    """

    def __init__(
        self,
        camera: StereoCamera,
        frontend: Frontend | str = "learned",
        backend: str = "onnx",
        config: TrackerConfig | None = None,
        admission: LandmarkAdmission | None = None,
        threads: int = 2,
        start: StartPose | None = None,
        provider: str = "cpu",
        weights: WeightsFolder = None,
        disparity_error: float | None = None,
        imu: InertialSensor | None = None,
        odometry: OdometrySensor | None = None,
        right_delay: float = 0.0,
    ) -> None:
        check_tracker_arguments(camera, frontend, backend, config, threads, weights, right_delay, imu, odometry)
        self._turn, self._delay, self.config = RLock(), right_delay, (config := config or TrackerConfig())
        networks = config.max_keypoints, backend, threads, provider, weights
        load: Callable[[], Frontend] = partial(build_frontend, frontend, *networks)
        if threads > 1:  # beside all else that a start needs
            load = ThreadPoolExecutor(1, "loading").submit(load).result
        self.rectifier = StereoRectifier(camera)
        self._camera, turned = (rectified := self.rectifier.rectified), self.rectifier.T_rectified_left
        self._admission = admission = admission or AdmitAll(config.min_inliers, config.spacing)
        graphs = EstimatorGraphs(rectified, backend, config.linearisation == "unscented")
        prior = CalibrationPrior.of(rectified, camera.sigmas, config.offset_sigma, config.estimate, camera.covariance)
        by_check = np.isin(ERRORS, ("offset", *TURNS)) * (disparity_error or 0.0)
        self._window = window = KeyframeWindow(rectified, prior.widened(by_check), graphs, usual=prior)
        self._noise = noise = MeasurementNoise(config)
        self._motion = motion = build_motion(backend, imu, odometry, turned)
        self._blas, self._course = ThreadpoolController(), (course := Course())
        self._shared_errors, self._clock, self._last_pairs = SharedErrors(), FrameClock(motion.sensors), LastPairs()
        self._keyframes = keyframes = Keyframes(window, config.max_keyframes, config.max_points)
        self._frontend = frontend = load()
        update = FrameUpdate(window, config.iterations, bool(motion.sensors))
        guided = GuidedMatcher(rectified, frontend, window, update, noise, config, not right_delay)
        self._unguided = unguided = UnguidedMatcher(rectified, frontend, window, noise, config, bool(right_delay))
        self._follower = follower = LandmarkFollower(guided)
        self._localiser = localiser = Localiser(window, motion, update, guided, follower, unguided, config, self._clock)
        self._scrutiny = Scrutiny(localiser, self._clock, course, admission.moving, disparity_error is not None)
        self._mapper = Mapper(rectified, window, keyframes, motion, noise, admission, config)
        self._loops = LoopCloser(window, keyframes, unguided)
        self._relocaliser = Relocaliser(window, keyframes, motion, unguided, admission, config.min_inliers)
        origin = None if start is None else start.of_rectified(turned)
        self._recovery = Recovery(course, window, keyframes, motion, self._mapper, admission, config, origin)
        relative = RelativePoseReporter(turned, window, keyframes, motion)
        self._reporter = Reporter(self.rectifier, window, keyframes, motion, relative, self._scrutiny.timing)
        self.last_frame: MatchedFrame | None = None
        self._history = FrameHistory(window, keyframes, turned)

    def load_map(self, path: Path) -> None:
        """Takes the world of a map that `sigmaslam track` has written; tracking starts where a view is found in it.

        Raises:
            InputError: the file is no map, or of another front-end or camera, or the tracker has keyframes.
        """
        self._keyframes.load(Path(path), self._frontend.name, self._camera)
        self._course.phase = Phase.WAITING_IN_MAP

    def add_imu(self, timestamp: float, gyro: np.ndarray, accel: np.ndarray) -> None:
        """Takes a sample of the inertial sensor; those up to a frame come before its `step`.

        Args:
            timestamp: seconds of its clock; a sample that is not later than the last one is left out.
            gyro, accel: (3,) rad/s and m/s^2; at rest the second is 9.81 away from the ground.
        Raises:
            InputError: the tracker was made without `imu`, or a value is not finite.
        """
        check_sample(self._motion, "imu", timestamp, gyro, accel).add(timestamp, gyro, accel)

    def add_odometry(self, timestamp: float, linear: np.ndarray, angular: np.ndarray) -> None:
        """Takes velocities (3,) of the vehicle in its axes forward, left, up, m/s and rad/s, as `add_imu` does."""
        check_sample(self._motion, "odometry", timestamp, linear, angular).add(timestamp, angular, linear)

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float, mask: np.ndarray | None = None) -> Estimate:
        """Takes one stereo pair.

        Args:
            left, right: (H, W) uint8, raw images of the calibrated size.
            timestamp: seconds, larger than the one before.
            mask: (H, W) bool or uint8 of the raw left image: where it is zero no landmark is made, or found again.
        Raises:
            InputError: the time stamp is no finite number, or does not increase.
            FrameError: an image or the mask has the wrong type or size, or the mask leaves nothing.
        """
        # The matrices are small: threads of BLAS would wait for each other for longer than they compute.
        with self._turn, self._blas.limit(limits=1, user_api="blas"):
            seconds = check_frame(left, right, timestamp, self._course.timestamp)
            pair = self._last_pairs.of_one_moment(left, right)
            return self._step(*pair, seconds, usable_pixels(mask, self.rectifier))

    def _step(self, left: np.ndarray, right: np.ndarray, timestamp: float, usable: np.ndarray | None) -> Estimate:
        clock = Stopwatch()
        pair, exchanged = self.rectifier.rectify(left, right), partial(self.rectifier.rectify, right, left)
        late = (self._camera, self._delay * self._motion.twist) if self._delay else None
        frame = Frame(*pair, self._frontend, usable, exchanged, late, self._window.held_offset.infinity)
        clock.lap("rectify")
        if self._course.timestamp is not None:
            seconds, sigma, stretch = self._clock.tick(timestamp - self._course.timestamp)
            if stretch != 1.0:
                twist_sigma = self.config.initial_twist_sigma(self._window.depth)
                self._motion.set_twist(self._motion.twist / stretch, twist_sigma)
            self._motion.predict(seconds, self.config.densities(self._window.depth), sigma, timestamp)
        is_skipped = self._last_pairs.is_repeated(left, right)
        matches, fit, change, doubts = GuidedMatches.empty(), None, None, Doubts()
        if not is_skipped and not is_noise(left):
            matches, fit, change = by_times(self._localiser, partial(self._localise, frame, timestamp, clock, doubts))
        is_skipped |= change is not None and not self._course.is_shifted
        self._course.is_shifted = change is not None and is_skipped
        if fit is None:
            shows = not is_skipped and change is None and self._relocaliser.is_enough(frame.view)
            self._scrutiny.miss(timestamp, shows)
        seen = frame.left, frame.right, self._window.landmarks.id[matches.views.landmark], matches
        self.last_frame = MatchedFrame(*seen, None if fit is None else fit.inliers, frame.usable)
        predicted = filtered = self._motion.state
        if fit is not None:
            matches, fit, doubts = self._scrutiny.doubt(frame, matches, fit)
            expected = self._motion.step, self._motion.step_covariance
            blur, of_matches = self._keyframes.blur(frame.left, matches.views.select(fit.inliers))
            fit = self._correct(fit, of_matches, matches, timestamp)
            filtered = self._motion.state
            tracks = self._mapper.insert_if_due(frame, timestamp, fit, blur, matches, expected, doubts)
            status = self._scrutiny.doubt_rig(doubts, fit)
        elif is_skipped:
            status, tracks = "skipped", None
        elif change is not None:
            doubts.add(Doubt.RIG)
            self.rectifier.raise_right(change.rows)
            frame = Frame(*self.rectifier.rectify(left, right), self._frontend, usable)
            tracks = self._recovery.go_on_after_bump(change, frame.view, timestamp)
            status = "lost" if tracks is None else doubts.status
        elif (found := self._relocaliser.relocalise(frame.view, self._clock.after_gap)) is not None:
            tracks = self._recovery.resume(found, timestamp, self._delay)
            status = self._recovery.status if tracks is None else "relocalised"
        else:
            status = self._recovery.status
            tracks = self._recovery.start_or_recover(frame.view, timestamp)
        if not is_skipped:
            self._follower.remember_frame(frame.left, matches, fit, tracks)
        loop = self._loops.close() if tracks is not None and status != "relocalised" else None
        clock.lap("map")
        # The images before it again, or too little in stereo.
        self._clock.was_blind = is_skipped or (fit is None and not self._relocaliser.is_enough(frame.view))
        self._course.timestamp = timestamp
        estimate = self._reporter.report(timestamp, status, matches, fit, tracks, loop, clock.milliseconds, doubts)
        self._history.append(estimate, predicted, filtered)
        return estimate

    def warm_up(self) -> None:
        """Runs the front-end once on noise, so that the first frame does not wait for memory: before cameras start."""
        noise = np.random.default_rng(0).integers(0, 256, (2, self._camera.height, self._camera.width), np.uint8)
        self._frontend.observe(*noise)

    def map(self) -> PointMap:
        """All landmarks so far that were seen at least three times."""
        with self._turn:
            return self._keyframes.map().transform(se3_inverse(self.rectifier.T_rectified_left))

    def final_trajectory(self) -> tuple[Trajectory, np.ndarray]:
        """All frames with a pose so far as they are known now, with covariances (N, 6, 6) in the camera's own frame."""
        with self._turn:
            return self._history.final()

    def pack_keyframes(self) -> dict[str, Any]:
        """Keyframes by which a later run finds its place in the map, as arrays by name."""
        with self._turn:
            return {TURN: self.rectifier.T_rectified_left, **self._keyframes.pack(self._frontend.name, self._camera)}

    def _localise(
        self, frame: Frame, timestamp: float, clock: Stopwatch, doubts: Doubts
    ) -> tuple[GuidedMatches, FrameFit | None, RigChange | None]:
        """Matches with the window's landmarks, and the pose if enough of them agree, or else why they do not."""
        if self._course.is_waiting:
            return GuidedMatches.empty(), None, None
        if (first := self._admission.begin_again(frame, self._unguided)) is not None:
            self._recovery.begin_again(first, timestamp)
        if self._delay and self._course.phase is Phase.STARTING:
            self._recovery.begin_late(frame, self._unguided, self._delay, timestamp)
        prediction = Prediction.of(self._window, self._motion)
        guided = self._course.phase is Phase.TRACKING
        if guided and self._follower.is_ready:
            matches, fit = self._localiser.follow(frame, self._keyframes.active, prediction, clock)
            if fit is not None:
                return matches, fit, None
            seen = self._localiser, self._keyframes.active[-1].view, frame, matches, prediction
            if not self._delay and (change := find_change(*seen)) is not None:
                return matches, None, change
            prediction = Prediction.of(self._window, self._motion)
        view = frame.view
        clock.lap("features")
        keyframes = [keyframe.view for keyframe in self._keyframes.active]
        if frame.is_exchanged(keyframes[-1], self.config.min_inliers):
            doubts.add(Doubt.EYES)
            return GuidedMatches.empty(), None, None
        return *self._localiser.localise(view, keyframes, prediction, guided, clock), None

    def _correct(self, fit: FrameFit, blur: float, matches: GuidedMatches, timestamp: float) -> FrameFit:
        """Takes a pose over, less certain where the frame is blurred."""
        # Blurred patches are misplaced alike, as those of a body that moves: many of them say no more than a few.
        fit = self._shared_errors.averaged(fit)
        fit = fit.inflated(max(fit.nis_before_scaling, 1.0) * blur * fit.clustering)
        seen = matches.views.select(fit.inliers)
        self._admission.confirm(seen, self._window)
        self._window.count_sightings(matches.searched, seen.landmark)
        self._motion.correct(fit.step, turn_covariance(se3_inverse(fit.last), fit.relative))
        if not matches.streaked:  # what streaks add to the noise is no scatter
            self._noise.adapt(fit.nis_per_dof)
        self._course.track(timestamp)
        return fit.spread_by(self._mapper.spread(seen))
