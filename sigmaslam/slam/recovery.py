"""Tracking begins, begins again, or goes on from a view whose velocity is unknown."""

import logging
from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.calibration_correction import change_rig
from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.image_sharpness import is_defocused
from sigmaslam.geometry.se3 import se3_body, se3_inverse, se3_log, turn_covariance
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_admission import LandmarkAdmission
from sigmaslam.slam.late_eye import at_one_moment
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.mapping import KeyframeTracks, Mapper, NewKeyframe
from sigmaslam.slam.phase import Course, Phase
from sigmaslam.slam.relocalisation import Relocalisation
from sigmaslam.slam.rig_change import RigChange
from sigmaslam.slam.unguided_matching import UnguidedMatcher

_LOGGER = logging.getLogger(__name__)

# A pose by a sensor of motion alone is one as long as its place is this certain, in median scene depths: of most
# landmarks a search knows about where they are.
_RECKONED_SIGMA = 0.2


@dataclass(frozen=True, slots=True)
class Recovery:
    """Makes views keyframes that see no known landmark.

    Attributes:
        course: of the tracker; changed.
        motion: forgets its velocity.
        mapper: inserts keyframes.
        admission: what may become a landmark.
        start: pose (4, 4) and covariance (6, 6) of the first keyframe in the world of an earlier run, perturbed
            from the left there; None: its camera is the world.
    """

    course: Course
    window: KeyframeWindow
    keyframes: Keyframes
    motion: MotionFilter
    mapper: Mapper
    admission: LandmarkAdmission
    config: TrackerConfig
    start: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def status(self) -> str:
        """Of a view without a pose by its images."""
        reckoned = dead_reckoning(self.motion)
        if reckoned is not None and self.course.has_moved:
            sigma = np.sqrt(np.linalg.eigvalsh(se3_body(self.motion.step, self.motion.step_covariance)[:3, :3])[-1])
            if sigma <= _RECKONED_SIGMA * self.window.depth:
                return reckoned
        return "lost" if self.course.has_moved else "starting"

    def start_or_recover(self, view: StereoView, timestamp: float) -> KeyframeTracks | None:
        """Without a pose: starts, or waits for a while and goes on with the uncertainty of the prediction."""
        course, config = self.course, self.config
        if course.phase is Phase.WAITING_IN_MAP or not view.has_stereo(self.admission.min_points, config.min_inliers):
            return None
        if course.phase is Phase.WAITING:
            # Of an earlier run it was a keyframe.
            accepted = self.start is not None or np.isfinite(view.disparity).mean() >= ACCEPTANCE.start_stereo_share
            return self._start(view, timestamp) if accepted and not self._waits(view, timestamp) else None
        since = timestamp - course.tracked_at
        if since <= config.lost_seconds or not self.admission.restarts_anywhere:
            return None
        active, is_reckoned = self.keyframes.active, self.status == dead_reckoning(self.motion)
        if is_reckoned and active and is_defocused(view.left, active[-1].view.left):
            return None
        _LOGGER.warning("tracking starts anew at %.3f s, %.2f s after the last pose", timestamp, since)
        if course.has_moved and dead_reckoning(self.motion) is None:
            course.resume(timestamp)
        course.tracked_at = timestamp
        pose = Prediction.of(self.window, self.motion).pose
        return self._insert(NewKeyframe(view, timestamp, pose, self.motion.step, self.motion.step_covariance))

    def _waits(self, view: StereoView, timestamp: float) -> bool:
        """Whether a blurred first view, whose error would stay in all poses, should give way to a sharper one."""
        since = self.course.waiting_since = min(timestamp, self.course.waiting_since)
        self.course.is_shaken |= view.is_blurred
        return timestamp - since < self.config.lost_seconds and view.is_blurred

    def resume(self, found: Relocalisation, timestamp: float, delay: float) -> KeyframeTracks | None:
        """Goes on from where a lost view was found; with a late right eye from the second one, by their motion."""
        (before, since), self.course.found = self.course.found, (found.pose, timestamp)
        twist = None
        if delay:
            if timestamp - since > self.config.lost_seconds:
                return None
            twist = se3_log(se3_inverse(before) @ found.pose) / (timestamp - since)
            way = delay * (twist - self.motion.twist)  # the view is corrected by that already
            found = replace(found, view=at_one_moment(found.view, self.window.camera, way))
        while self.keyframes.active:
            self.keyframes.marginalise_oldest(spare=found.keyframe)
        if dead_reckoning(self.motion) is not None:
            self.course.track(timestamp)
        else:
            self.course.resume(timestamp)
        covariance = turn_covariance(found.pose, found.covariance)
        origin = self.keyframes.index(found.keyframe.origin)
        new = NewKeyframe(found.view, timestamp, found.pose, found.pose, covariance, origin=origin)
        return self._insert(new, twist)

    def go_on_after_bump(self, change: RigChange, view: StereoView, timestamp: float) -> KeyframeTracks | None:
        """Begins a window anew where the left camera is, with a calibration of which little is known.

        None, and nothing is done, where the view has too little in stereo.
        """
        if not view.has_stereo(self.admission.min_points, self.config.min_inliers):
            return None
        last = self.keyframes.active[-1]
        while self.keyframes.active:
            self.keyframes.marginalise_oldest(spare=last)
        change_rig(self.window, change.columns)
        # As if all that is remembered had been seen since.
        hanging = (each.packed.disparity for each in self.keyframes.hanging.values())
        for disparity in (*(each.view.disparity for each in self.keyframes.remembered), *hanging):
            disparity += change.columns
        self.course.track(timestamp)
        pose, origin = change.fit.pose, self.keyframes.index(last.id)
        new = NewKeyframe(view, timestamp, pose, pose, change.fit.relative, origin=origin, rig_changed=True)
        return self.mapper.insert(new)

    def begin_again(self, first: StereoView, timestamp: float) -> None:
        """Starts again from the first view, now with other landmarks, and predicts the current frame from there."""
        course, started_at, had_moved = self.course, self.course.started_at, self.course.has_moved
        self.keyframes.restart()
        self._start(first, started_at)
        if had_moved:
            course.resume(started_at)
        self.motion.predict(timestamp - started_at, self.config.densities(self.window.depth), timestamp=timestamp)

    def begin_late(self, frame: Frame, matcher: UnguidedMatcher, delay: float, timestamp: float) -> None:
        """Starts again from a first view whose right image came a delay later, if this frame shows the velocity."""
        first, camera = self.keyframes.active[0].view, self.window.camera
        if self.motion.twist.any() or (relative := matcher.relative_pose_to(first, frame.view)) is None:
            return
        twist = se3_log(relative.T_key_camera) / (timestamp - self.course.started_at)
        frame.view = at_one_moment(frame.view, camera, delay * twist)
        self.begin_again(at_one_moment(first, camera, delay * twist), timestamp)
        self.motion.set_twist(twist, self.config.initial_twist_sigma(self.window.depth))

    def _start(self, view: StereoView, timestamp: float) -> KeyframeTracks:
        """Makes the view the first keyframe, and its camera the world where no other one is given."""
        self.course.start(timestamp)
        if self.start is not None:
            self.course.resume(timestamp)
        pose, covariance = (np.eye(4), np.zeros((6, 6))) if self.start is None else self.start
        view = view.only(self.admission.admit(view, pose, self.window))
        return self._insert(NewKeyframe(view, timestamp, pose, pose, covariance))

    def _insert(self, new: NewKeyframe, twist: np.ndarray | None = None) -> KeyframeTracks:
        """Makes a view a keyframe that sees no known landmark; its velocity is hardly known."""
        tracks = self.mapper.insert(new)
        self.motion.set_twist(
            np.zeros(6) if twist is None else twist, self.config.initial_twist_sigma(self.window.depth)
        )
        return tracks
