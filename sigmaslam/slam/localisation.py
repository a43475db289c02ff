"""The pose of a frame in the window: near the prediction first, then anywhere."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.chi_square import CHI_SQUARE_9999_OF_6
from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.frame_clock import FrameClock
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.prediction_errors import surprise, time_error
from sigmaslam.frontend import StereoView
from sigmaslam.geometry.image_cells import explained_area, image_cells
from sigmaslam.geometry.se3 import se3_inverse, se3_log, turn_covariance
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatcher, GuidedMatches
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.landmark_following import LandmarkFollower
from sigmaslam.slam.landmark_places import seen_apart
from sigmaslam.slam.stopwatch import Stopwatch
from sigmaslam.slam.unguided_matching import UnguidedMatcher
from sigmaslam.two_view.scene_pose import are_one_place, is_rival


@dataclass(frozen=True, slots=True)
class Prediction:
    """A pose before its images.

    Attributes:
        pose: (4, 4) T_world_camera.
        covariance: (6, 6) of it relative to the last keyframe, perturbed from the left in the world.
    """

    pose: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of(cls, window: KeyframeWindow, motion: MotionFilter) -> Self:
        """The last keyframe of the window, moved on."""
        key = window.posterior.poses[-1]
        return cls(key @ motion.step, turn_covariance(key, motion.step_covariance))

    def squared_departure(self, pose: np.ndarray) -> float:
        """Squared sigmas by which a pose (4, 4) departs from this one."""
        departure = se3_log(pose @ se3_inverse(self.pose))
        return float(departure @ np.linalg.lstsq(self.covariance, departure, rcond=1e-14)[0])

    def excludes(self, pose: np.ndarray) -> bool:
        """Whether a pose (4, 4) departs from this one by more than its noise."""
        return self.squared_departure(pose) > CHI_SQUARE_9999_OF_6


@dataclass(frozen=True, slots=True)
class Localiser:
    """Matches a view with the landmarks of the window and estimates its pose.

    Attributes:
        window: of keyframes.
        motion: predicts; is widened where images say at once that it is off.
        update: estimates poses against it.
        guided: finds landmarks near a prediction.
        follower: finds them without features.
        unguided: finds keyframes anywhere.
        frame_clock: knows the interval of the frames.
    """

    window: KeyframeWindow
    motion: MotionFilter
    update: FrameUpdate
    guided: GuidedMatcher
    follower: LandmarkFollower
    unguided: UnguidedMatcher
    config: TrackerConfig
    frame_clock: FrameClock

    def follow(
        self, frame: Frame, keyframes: list[Keyframe], prediction: Prediction, clock: Stopwatch
    ) -> tuple[GuidedMatches, FrameFit | None]:
        """Matches and pose of a frame without features; no pose where that is doubtful.

        Nor beside a sensor after half a second: features are found by its prediction, and optical flow strays.

        Args:
            keyframes: of the window.
            prediction: of its pose.
            clock: takes the time of the stages `match` and `filter`.
        """
        measured, turn = prediction, self.motion.turn
        if turn is not None and self.frame_clock.is_slow:
            return GuidedMatches.empty(), None
        matches, excess = self.follower.follow(frame, keyframes, prediction.pose, prediction.covariance, turn)
        if excess > 1.0:
            self.motion.widen(excess)
            prediction = Prediction.of(self.window, self.motion)
        clock.lap("match")
        fit = self.fit_near(matches, prediction)
        if excess > 1.0 and turn is not None:
            fit = self._confirm(matches, fit, measured, excess)
        clock.lap("filter")
        if fit is None or self._is_doubtful(matches, fit) or self.follower.has_fallen(matches, fit.inliers):
            return matches, None
        return matches, fit

    def _confirm(
        self, matches: GuidedMatches, fit: FrameFit | None, measured: Prediction, excess: float
    ) -> FrameFit | None:
        """Takes back by what flow has widened the prediction of a sensor, unless the pose departs from it as well."""
        if fit is not None and measured.excludes(fit.pose) and not self._is_doubtful(matches, fit):
            return fit
        self.motion.widen(1.0 / excess)
        return None if fit is None else self.fit_again(matches, fit, measured)

    def localise(
        self, view: StereoView, keyframes: list[StereoView], prediction: Prediction, guided: bool, clock: Stopwatch
    ) -> tuple[GuidedMatches, FrameFit | None]:
        """Matches and pose of a view, first near the prediction, then anywhere; no pose where too little agrees.

        Args:
            keyframes: what the window's keyframes saw.
            prediction: of its pose.
            guided: the velocity is known, so that the prediction says where to search.
            clock: takes the time of the stages `match` and `filter`.
        """
        matches, fit = GuidedMatches.empty(), None
        if guided:
            matches = self.guided.match_guided(view, keyframes, prediction.pose, prediction.covariance)
            clock.lap("match")
            fit = self.fit_near(matches, prediction)
            clock.lap("filter")
        if fit is None or self._is_doubtful(matches, fit):
            other_matches, other = self._localise_anywhere(view, keyframes, prediction, matches, clock)
            if fit is None or (other is not None and self._is_better(other, fit)):
                matches, fit = other_matches, other
        if fit is not None and fit.count < ACCEPTANCE.doubtful_inliers * self.config.min_inliers:
            # Chance agreement of a few: in noise, or on repeated texture, where most do not agree. After a gap the
            # motion hardly says which of its periods it is.
            most = fit.count >= ACCEPTANCE.guided_share * len(matches.probability)
            largest = ACCEPTANCE.noise_nis if most else ACCEPTANCE.doubtful_nis
            if fit.nis_before_scaling > largest or (self.frame_clock.after_gap and not most):
                return matches, None
        return matches, fit

    def _is_reachable(self, matches: GuidedMatches, fit: FrameFit, prediction: Prediction) -> bool:
        """Whether the motion allows the pose, if in another moment, or most landmarks of earlier keyframes confirm it.

        Repeated texture of one keyframe agrees on wrong poses, hundreds of matches strong.
        """
        if prediction.squared_departure(fit.pose) <= ACCEPTANCE.jump**2:
            return True
        if time_error(self.motion, fit.step, self.frame_clock.interval) != 0.0:
            return True
        anchor = self.window.landmarks.anchor
        earlier = anchor[matches.searched] < len(self.window) - 1
        seen = anchor[matches.views.landmark[fit.inliers]] < len(self.window) - 1
        enough = max(ACCEPTANCE.jump_support * earlier.sum(), self.config.min_inliers)
        return len(self.window) == 1 or int(seen.sum()) >= enough

    def _is_doubtful(self, matches: GuidedMatches, fit: FrameFit) -> bool:
        """Whether the pose may sit in a wrong place, or so little is left of the last frame that the search was off.

        A sensor of motion knows how much of it is still in view.
        """
        is_sensed = self.motion.turn is not None
        before = len(matches.searched) if is_sensed else self.follower.count
        share = ACCEPTANCE.guided_share if self.frame_clock.differs and not is_sensed else ACCEPTANCE.left_over
        return fit.nis_per_dof > ACCEPTANCE.doubtful_nis or fit.count < share * before

    def _is_better(self, other: FrameFit, fit: FrameFit) -> bool:
        """Whether another pose fits better than a doubtful one, or more agrees with it."""
        if fit.nis_per_dof > ACCEPTANCE.doubtful_nis:
            return other.nis_per_dof < fit.nis_per_dof
        return other.nis_per_dof <= ACCEPTANCE.doubtful_nis and other.count > fit.count

    def fit_again(self, matches: GuidedMatches, fit: FrameFit, prediction: Prediction) -> FrameFit:
        """The pose of the same matches by a prediction that has become less certain; `fit` where there is none."""
        views, least = matches.views, self.config.min_inliers
        return self.update.fit(views, prediction.pose, prediction.covariance, least, fit.pose) or fit

    def fit_near(self, matches: GuidedMatches, prediction: Prediction) -> FrameFit | None:
        """Update from the prediction; most of what was found near it must agree."""
        count, least = len(matches.probability), self.config.min_inliers
        if count < least:
            return None
        fit = self.update.fit(matches.views, prediction.pose, prediction.covariance, least)
        return fit if fit is not None and fit.count >= ACCEPTANCE.guided_share * count else None

    def _localise_anywhere(
        self,
        view: StereoView,
        keyframes: list[StereoView],
        prediction: Prediction,
        near: GuidedMatches,
        clock: Stopwatch,
    ) -> tuple[GuidedMatches, FrameFit | None]:
        """Without a prediction: the pose relative to one of the last keyframes, then landmarks near there.

        The prediction gives way where it contradicts what the last keyframe says, and little of what was found `near`
        it agrees with it: behind a mover that fills the view, the scene does.
        """
        matches = GuidedMatches.empty()
        for back in range(1, min(ACCEPTANCE.last_keyframes, len(keyframes)) + 1):
            key, is_sensed = self.window.posterior.poses[-back], dead_reckoning(self.motion) is not None
            excludes = (lambda step, key=key: prediction.excludes(key @ step)) if is_sensed else None
            relative = self.unguided.relative_pose_to(keyframes[-back], view, excludes)
            clock.lap("match")
            if relative is None:
                continue
            start = key @ relative.T_key_camera
            share = ACCEPTANCE.unguided_margin
            margin = np.diag(np.repeat([share * self.window.depth, share], 3) ** 2)
            uncertain = turn_covariance(start, relative.covariance + margin)
            matches = self.guided.match_guided(view, keyframes, start, uncertain, -back, alone=True)
            clock.lap("match")
            fit = self.update.fit(
                matches.views, prediction.pose, prediction.covariance, self.config.min_inliers, start, relative.scale
            )
            clock.lap("filter")
            if back == 1 and prediction.excludes(start):
                alone = self._fit_alone(matches, near, prediction, start, relative.scale)
                if alone is not None and (fit is None or _gives_way(fit, alone)):
                    fit = alone
                clock.lap("filter")
            enough = fit is not None and fit.count >= ACCEPTANCE.unguided_share * len(matches.probability)
            if fit is not None and enough and self._is_reachable(matches, fit, prediction):
                return replace(matches, after_gap=self.frame_clock.after_gap), fit
        return matches, None

    def _fit_alone(
        self, matches: GuidedMatches, near: GuidedMatches, prediction: Prediction, start: np.ndarray, scale: float
    ) -> FrameFit | None:
        """The pose of what was found around `start` (4, 4), by a prediction as uncertain as it asks for.

        None where the prediction's pose explains a rival's part of the image beside it.
        """
        excess = surprise(self.motion, se3_inverse(self.window.posterior.poses[-1]) @ start)
        pose, covariance, least = prediction.pose, prediction.covariance, self.config.min_inliers
        fit = self.update.fit(matches.views, pose, excess * covariance, least, start, scale)
        rival = self.update.fit(near.views, pose, covariance, least) if len(near.probability) >= least else None
        if fit is None or rival is None or rival.nis_per_dof > ACCEPTANCE.doubtful_nis:
            return fit
        return None if is_rival(self._own_area(near, rival, fit), self._own_area(matches, fit, rival)) else fit

    def _own_area(self, matches: GuidedMatches, fit: FrameFit, other: FrameFit) -> float:
        """Share of the image that a pose explains and another one does not; 0 where that is too little for a pose.

        Far landmarks agree with both and tell nothing.
        """
        camera, places, rows = self.window.camera, matches.views.measurement[:, :2], matches.views.landmark
        apart = seen_apart(self.window, rows, fit.pose, other.pose)
        own = fit.inliers & np.isfinite(apart) & ~are_one_place(apart)
        cells = image_cells(places, camera.width, camera.height)
        return explained_area(cells, own, np.ones(len(own))) if own.sum() >= self.config.min_inliers else 0.0


def _gives_way(fit: FrameFit, alone: FrameFit) -> bool:
    """Whether the prediction's pose loses half of the landmarks that agree alone, or fits them badly."""
    fits_badly = fit.nis_per_dof > ACCEPTANCE.doubtful_nis >= alone.nis_per_dof
    return fits_badly or fit.count < ACCEPTANCE.guided_share * alone.count
