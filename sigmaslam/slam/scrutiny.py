"""Looks at a pose that images gave for what speaks against it."""

from dataclasses import replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.constant_velocity import dead_reckoning
from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.gaussian import step_with
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.prediction_errors import surprise, time_error
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.slam.doubt import Doubt, Doubts
from sigmaslam.slam.eye_timing import SPOILT, EyeTiming
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.frozen_images import shows_motion
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.landmark_places import seen_apart
from sigmaslam.slam.localisation import Localiser, Prediction
from sigmaslam.slam.moving_region import MovingRegion
from sigmaslam.slam.phase import Course
from sigmaslam.slam.second_motion import SecondMotion, find_scene_behind, find_second_motion
from sigmaslam.two_view.stereo_pose import MIN_POINTS

# After a shaken start one keyframe hardly tells for so many seconds what moves: of these frames of 32 renders a twelfth
# was beyond 99.9 %, of later ones none. Errors count as twice as large as matches say.
_START, _START_VARIANCE = 0.5, 4.0
# So many bodies, or parts of one, are left out of an image one by one.
_MOST_MOVERS = 3


class Scrutiny:
    """Collects doubts in poses, frame by frame.

    Args:
        localiser, clock, course: of the tracker.
        moving: where the scene moves on its own; None: all of it may.
        input_is_wrong: a check of the input found that the eyes do not fit.

    Attributes:
        timing: of the eyes.
    """

    def __init__(
        self, localiser: Localiser, clock: FrameClock, course: Course, moving: MovingRegion | None, input_is_wrong: bool
    ) -> None:
        self._localiser, self._window, self._motion = localiser, localiser.window, localiser.motion
        self._clock, self._course, self._moving = clock, course, moving
        # Places are all that is asked of it; a torn image leaves none in the next one.
        self._rival = MovingRegion(0.0, patience=0)
        self._T_rival_fit = self._parting = self._pose = np.eye(4)
        self._rival_covariance = np.zeros((6, 6))
        self._last_error, self._had_other_times = 0.0, False
        # The last pose; where the camera stopped within a frame, covariance of what was expected, twist, time before.
        self._stop: tuple[np.ndarray, np.ndarray, np.ndarray, float] | None = None
        self._input_is_wrong = input_is_wrong
        self.timing = EyeTiming(self._window.camera.baseline)
        self._before: tuple[np.ndarray, ...] | None = None
        self._fixed_for = 0

    def doubt(self, frame: Frame, matches: GuidedMatches, fit: FrameFit) -> tuple[GuidedMatches, FrameFit, Doubts]:
        """What speaks against a pose, before motion and map learn from it, and the pose without what is found to be
        wrong: matches on what moves are left out, and a contradicted prediction becomes less certain.

        Args:
            frame: the current one.
            matches, fit: of the image.
        """
        doubts, left = Doubts(), frame.left
        moving = self._moving
        for region in (moving, self._rival):
            if region is not None:
                region.carry(left, fit.pose, self._window.camera)
        if self._rival:
            self._rival.keep_if_seen_from(self._parting @ self._T_rival_fit @ fit.pose, self._window.camera)
        second = None if moving is None else find_scene_behind(self._localiser, matches, fit, doubts)
        second = second or find_second_motion(self._window, matches, fit, moving)
        for _ in range(_MOST_MOVERS):
            if moving is None or second is None or not second.is_mover:
                break
            drawn = fit.pose
            matches, fit = self._leave_out(matches, second, moving)
            doubts.add_motion(drawn, fit.pose)
            second = find_second_motion(self._window, matches, fit, moving)
        self.doubt_rig(doubts, fit)
        seen = matches.views.select(fit.inliers)
        ids, follows = self._window.landmarks.id[seen.landmark], self._localiser.follower.is_ready
        if self.timing.are_apart(frame, fit.pose, ids, seen.measurement, follows):
            doubts.add(Doubt.APART)
        elif self._is_fixed(left, matches, fit):
            doubts.add(Doubt.FIXED)
        course = self._course
        if is_start := course.tracked_at < course.started_at + _START:
            course.is_shaken |= frame.is_blurred
        if is_start and course.is_shaken:
            doubts.add(Doubt.START)
            doubts.spread = doubts.spread + (_START_VARIANCE - 1.0) * fit.clustering * fit.relative
        if matches.rival is not None:
            doubts.add_motion(matches.rival, fit.pose)
        self._doubt_prediction(doubts, matches, fit)
        if second is not None and not second.is_mover and not self._is_other(second, fit):
            # Nothing decides between the two as long as what asks for the other moves; they part on as they last did.
            T_rival_fit = second.pose @ se3_inverse(fit.pose)
            self._parting = T_rival_fit @ se3_inverse(self._T_rival_fit) if self._rival else T_rival_fit
            self._T_rival_fit, self._rival_covariance = T_rival_fit, second.covariance
            if moving is not None:
                self._add(self._rival, matches, second)
            doubts.add_motion(second.pose, fit.pose, second.covariance)
        elif self._rival:
            self._T_rival_fit = self._parting @ self._T_rival_fit
            doubts.add_motion(self._T_rival_fit @ fit.pose, fit.pose, self._rival_covariance)
        if doubts.prediction_is_wrong:
            fit = self._localiser.fit_again(matches, fit, Prediction.of(self._window, self._motion))
        self._pose = fit.pose
        return matches, fit, doubts

    def doubt_rig(self, doubts: Doubts, fit: FrameFit) -> str:
        """The status of a pose, with what the window, which may just have learned from it, knows to be wrong."""
        if self._input_is_wrong or self._window.evidence.is_gross(self._window.causes):
            doubts.add(Doubt.INPUT)
        if Doubt.OFFSET not in doubts.reasons:
            for index in np.flatnonzero(self._window.exceeded).tolist():
                doubts.add(Doubt.OFFSET, _without_error(self._window, fit, index))
        return doubts.status

    def miss(self, timestamp: float, shows: bool) -> None:
        """An image without a pose says nothing against a sensor's prediction; if it `shows` a place, nor for a stop."""
        if dead_reckoning(self._motion) is not None:
            self._motion.widen(1.0 / self._motion.widened)
        elif self._stop is not None and shows:
            _, _, twist, since = self._stop
            self._motion.set_twist(twist, np.repeat(np.linalg.norm(twist.reshape(2, 3), axis=1), 3))
            self._motion.predict(timestamp - since, self._localiser.config.densities(self._window.depth))
            self._stop = None

    def _leave_out(
        self, matches: GuidedMatches, second: SecondMotion, moving: MovingRegion
    ) -> tuple[GuidedMatches, FrameFit]:
        """Takes what moves out of window and matches, and poses that it drew along back."""
        window, views, fit = self._window, matches.views, second.first
        self._add(moving, matches, second)
        moves = moving.covers(views.measurement[:, :2])
        window.count_sightings(views.landmark[:0], views.landmark[:0], views.landmark[moves])
        window.solve()
        still = replace(matches, views=views.select(~moves), probability=matches.probability[~moves])
        again = self._localiser.fit_again(still, fit, Prediction.of(window, self._motion))
        return (matches, fit) if again is fit else (still, again)

    def _add(self, region: MovingRegion, matches: GuidedMatches, second: SecondMotion) -> None:
        points = transform_points(second.first.pose, self._window.camera.triangulate(second.expected))
        region.add(matches.views.measurement[second.agreeing, :2], points, second.departure)

    def _is_fixed(self, left: np.ndarray, matches: GuidedMatches, fit: FrameFit) -> bool:
        """Whether landmarks that agree with the pose stay where they were in an earlier image, though they should move.

        Or by the pose the camera stands, and most of the image has changed. Where most stay a loop has moved the world.
        """
        rows, seen = matches.views.landmark, matches.views.measurement[:, :2]
        ids = self._window.landmarks.id[rows]
        image, pose, old_ids, old_seen = self._before or (left, fit.pose, ids, seen)
        ways = seen_apart(self._window, rows, pose, fit.pose)
        moves = ways > 3.0 * ACCEPTANCE.stands
        if self._before is None or 2 * moves.sum() >= np.isfinite(ways).sum():
            _, now, then = np.intersect1d(ids, old_ids, assume_unique=True, return_indices=True)
            stays = moves[now] & (np.linalg.norm(seen[now] - old_seen[then], axis=1) < ACCEPTANCE.stands)
            is_fixed = (stays & fit.inliers[now]).sum() >= MIN_POINTS and 4 * stays.sum() < 3 * moves[now].sum()
            self._fixed_for = SPOILT if is_fixed else max(self._fixed_for - 1, 0)
            self._before = left, fit.pose, ids, seen
        elif 2 * (ways > ACCEPTANCE.stands).sum() < len(ways) and shows_motion(image, left):
            return True
        return self._fixed_for > 0

    def _is_other(self, second: SecondMotion, fit: FrameFit) -> bool:
        """Whether a sensor of motion rules the second motion out, and not the pose."""
        if dead_reckoning(self._motion) is None:
            return False
        prediction = Prediction.of(self._window, self._motion)
        return prediction.excludes(second.pose) and not prediction.excludes(fit.pose)

    def _stands_dead(self, matches: GuidedMatches, fit: FrameFit) -> bool:
        """Whether landmarks stay, in the very next image of a camera that was about to move them forty times as far."""
        if self._stop is not None or self._clock.is_slow or self._course.tracked_at != self._course.timestamp:
            return False
        rows = matches.views.landmark
        stays = seen_apart(self._window, rows, self._pose, fit.pose) < 0.5 * ACCEPTANCE.stands
        if 2 * stays.sum() <= len(stays):
            return False
        expected = seen_apart(self._window, rows, self._pose, Prediction.of(self._window, self._motion).pose)
        return bool(2 * (expected > 20.0 * ACCEPTANCE.stands).sum() > len(expected))

    def _doubt_prediction(self, doubts: Doubts, matches: GuidedMatches, fit: FrameFit) -> None:
        # What goes on is an acceleration: images out of order jump to and fro, and once some came others may.
        expects = self._had_other_times or self._last_error != 0.0
        error = time_error(self._motion, fit.step, self._clock.interval, expects)
        if error == 0.0 and self._stands_dead(matches, fit):
            error = -1.0  # no camera does, though the noise of its motion may allow it
        is_other = error * self._last_error < 0.0 or (error != 0.0 and self._last_error == 0.0)
        excess = surprise(self._motion, fit.step)
        if is_other:
            self._motion.doubt_time(error * self._clock.interval)
            expected = Prediction.of(self._window, self._motion).covariance
            self._stop = (self._pose, expected, self._motion.twist, self._course.tracked_at) if error < 0.0 else None
        elif excess > 1.0:
            self._motion.widen(excess)
        doubts.prediction_is_wrong = is_other or excess > 1.0
        self._had_other_times = self._had_other_times or (is_other and self._last_error != 0.0)
        if is_other or (expects and self._motion.widened > 1.0):
            doubts.add(Doubt.TIME)
            # The pose at the stamp is the prediction, as uncertain as it was before, and the image's is off by a way.
            doubts.published = doubts.published + Prediction.of(self._window, self._motion).covariance
        if self._stop is not None and not is_other:
            # An image that is delivered again, compressed anew, looks like a stop within a frame; so do those after it.
            pose, expected, _, since = self._stop
            if np.nanmedian(seen_apart(self._window, matches.views.landmark, pose, fit.pose)) < ACCEPTANCE.stands:
                doubts.add(Doubt.TIME)
                frames = 1.0 + (self._course.tracked_at - since) / self._clock.interval
                doubts.published = doubts.published + frames**2 * expected
            else:
                self._stop = None
        self._last_error = error


def _without_error(window: KeyframeWindow, fit: FrameFit, index: int) -> np.ndarray:
    """(6,) spread of a pose that stands on an error of the calibration which may as well stand for something else.

    With even odds that there is none the second moment about the pose is half of the squared step between the two.
    """
    change = fit.calibration[index] - window.expected[index]
    return np.sqrt(0.5) * step_with(fit.joint.covariance, slice(-6, None), index, change)
