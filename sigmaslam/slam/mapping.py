"""New keyframes and landmarks."""

from dataclasses import dataclass, field, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.calibration_correction import foresee
from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.feature_spacing import select_spaced
from sigmaslam.frontend.image_sharpness import is_defocused
from sigmaslam.frontend.plane_alignment import disparity_slopes
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse, turn_covariance
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.doubt import Doubts
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_admission import LandmarkAdmission
from sigmaslam.slam.measurement_noise import MeasurementNoise
from sigmaslam.table import Table

# Images of fewer pixels have landmarks closer together than the setting says, down to this share of it.
_FULL_SPACING_FROM, _LEAST_SPACING = 640 * 480, 2 / 3
# The scene is no farther away than where its disparity is this, pixels.
_MIN_DISPARITY = 0.5


def _in_all_directions(spread: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A covariance (6, 6) with the same traces, alike in all directions of the camera: what moves drew it on since."""
    own = np.diag(turn_covariance(se3_inverse(pose), spread)).reshape(2, 3)
    return turn_covariance(pose, np.diag(np.repeat(own.mean(axis=1), 3)))


@dataclass(frozen=True, slots=True)
class KeyframeTracks(Table):
    """What one keyframe saw.

    Attributes:
        landmark_id: (M,) number that no other landmark of the run has.
        measurement: (M, 3) (u, v, disparity) in the rectified pair; the disparity may be NaN.
        covariance: (M, 3, 3) of it, places relative to those in the landmark's first keyframe.
    """

    landmark_id: np.ndarray
    measurement: np.ndarray
    covariance: np.ndarray


@dataclass(frozen=True, slots=True)
class NewKeyframe:
    """A view that becomes a keyframe.

    Attributes:
        view: with disparities where landmarks may be.
        timestamp: seconds.
        pose: (4, 4) estimate of T_world_camera.
        step: (4, 4) T_last_new as expected without its images; of the first keyframe T_world_camera.
        step_covariance: (6, 6) of that, perturbed from the left in the last keyframe.
        views: of the window's landmarks.
        origin: of the first one, the past pose relative to which `step_covariance` is.
        blur: of its image, as of `Keyframes.blur`.
        rig_changed: the disparity offset is as unknown as at the start.
        spreads: as of `Keyframes.append`; with an `origin` as that is drawn unless given.
    """

    view: StereoView
    timestamp: float
    pose: np.ndarray
    step: np.ndarray
    step_covariance: np.ndarray
    views: LandmarkViews = field(default_factory=LandmarkViews.empty)
    origin: int | None = None
    blur: float = 1.0
    rig_changed: bool = False
    spreads: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(slots=True)
class Mapper:
    """Makes views keyframes of the window.

    Attributes:
        camera: the rectified pair.
        window: takes keyframes and landmarks.
        keyframes: of the window.
        motion: is relative to the last keyframe.
        noise: of what is measured.
        admission: what may become a landmark.
        config: settings.
    """

    camera: RectifiedStereo
    window: KeyframeWindow
    keyframes: Keyframes
    motion: MotionFilter
    noise: MeasurementNoise
    admission: LandmarkAdmission
    config: TrackerConfig
    _landmarks_in_keyframe: int = field(default=0, init=False)
    _fitted: int = field(default=0, init=False)

    def insert_if_due(
        self,
        frame: Frame,
        timestamp: float,
        fit: FrameFit,
        blur: float,
        matches: GuidedMatches,
        expected: tuple[np.ndarray, np.ndarray],
        doubts: Doubts,
    ) -> KeyframeTracks | None:
        """Makes a tracked frame a keyframe when the landmarks of the last one fade, and the frame can replace it.

        Args:
            timestamp: seconds.
            blur: of its image, as of `Keyframes.blur`.
            expected: step (4, 4) from the last keyframe without its images, and its covariance (6, 6).
            doubts: in the pose, which something that moves may have drawn.
        """
        share = fit.count / max(self._landmarks_in_keyframe, 1)
        step, covariance = expected
        if self.motion.is_inertial:
            # Its velocity is that of the images, and off alike in all steps of a window: together they know one way.
            alike = np.sqrt(np.repeat([self.config.window, 1.0], 3))
            covariance = alike[:, None] * covariance * alike
            if doubts.prediction_is_wrong:  # as after a sample gone wrong: it would bend the window
                step = fit.step
        # What neighbours share counts in what is published: here, it misses the truth by more where the calibration is
        # off. After a gap they err alike in this view and in all to come: it counts, and they are asked no more.
        shared = 1.0 if matches.after_gap else fit.clustering
        moved = turn_covariance(self.window.posterior.poses[-1], covariance)
        if share >= self.config.keyframe_ratio and not foresee(self.window, fit, step, moved, fit.inflation / shared):
            return None
        # A blurred or spoilt keyframe would spoil what comes after it, too few landmarks spoil more. A sharp view
        # that scatters is one: no keyframes at all for 20 frames lost the KITTI drive.
        is_bad = doubts.spoils_keyframe or (blur > 1.0 and fit.nis_before_scaling > ACCEPTANCE.scattered_nis)
        has_few, last = share < ACCEPTANCE.bad_keyframe_landmarks, self.keyframes.active[-1].view.left
        if not has_few and (is_bad or frame.is_blurred):
            return None
        # A sensor of motion goes on better without what little such images show.
        if has_few and dead_reckoning(self.motion) is not None and is_defocused(frame.left, last):
            return None
        view = frame.view
        admitted = view.only(self.admission.admit(view, fit.pose, self.window))
        if not admitted.has_stereo(self.admission.min_points, self.config.min_inliers):
            return None
        self._fitted += 1
        self.window.clustering += (fit.clustering - self.window.clustering) / self._fitted
        views = matches.views.select(fit.inliers).inflated(fit.noise_scale * fit.inflation / shared)
        if matches.after_gap:
            self.window.landmarks.misses[:] = self.config.max_misses
        # What moves draws the pose, hidden by streaks or not: frames that see the keyframe's landmarks share that.
        drawn = _in_all_directions(self._mean([each.drawn for each in self.keyframes.active], views), fit.pose)
        drawn = drawn + (matches.streaked or doubts.is_ambiguous) * doubts.spread
        spread = drawn + matches.streaked * (1.0 - 1.0 / fit.clustering) * (fit.relative - self.spread(views))
        spreads = spread, drawn
        return self.insert(
            NewKeyframe(admitted, timestamp, fit.pose, step, covariance, views, blur=blur, spreads=spreads)
        )

    def spread(self, seen: LandmarkViews) -> np.ndarray:
        """(6, 6) by which a pose is less certain than its views say, as the keyframes of their landmarks are."""
        return self._mean([each.spread for each in self.keyframes.active], seen)

    def _mean(self, spreads: list[np.ndarray], seen: LandmarkViews) -> np.ndarray:
        """(6, 6) mean of matrices of the window's keyframes, by what views of their landmarks weigh."""
        weight = 1.0 / np.trace(seen.noise[:, :2, :2], axis1=1, axis2=2)
        share = np.bincount(self.window.landmarks.anchor[seen.landmark], weight, len(spreads)) / weight.sum()
        return np.asarray(np.tensordot(share, spreads, 1))

    def insert(self, new: NewKeyframe) -> KeyframeTracks:
        """Makes a view a keyframe: what it has in stereo beside the views of known landmarks is new.

        Returns:
            What the keyframe saw, known landmarks before new ones.
        """
        window, keyframes, views = self.window, self.keyframes, new.views
        if len(window) == self.config.window:
            views = views.renumber(keyframes.marginalise_oldest())
        step_covariance = new.step_covariance
        if len(window):
            step_covariance = turn_covariance(window.posterior.poses[-1], step_covariance)
        since = new.timestamp - keyframes.active[-1].timestamp if keyframes.active else 0.0
        walk = np.zeros(CALIBRATION_SIZE)
        if window.held_offset.is_moving:
            walk[0] = self.config.offset_walk**2 * since
        if new.rig_changed:
            walk[0] += self.config.offset_sigma**2
        disparity = max(float(np.nanmedian(new.view.disparity)), _MIN_DISPARITY)
        depth = self.camera.focal_baseline / disparity
        window.add_keyframe(new.pose, new.step, step_covariance, walk, depth, new.origin)
        window.add_views(views)
        index = self._add_landmarks(new.view, views, new.blur)
        slope = disparity_slopes(new.view.features.keypoints, new.view.disparity, index)
        spreads = new.spreads
        if spreads is None and new.origin is not None:
            spreads = 2 * (keyframes.remembered[new.origin].drawn,)
        keyframes.append(replace(new.view, slope=slope), new.timestamp, new.blur, index, spreads)
        seen = LandmarkViews.concatenate([views, window.landmarks.anchor_views(len(window) - 1)])
        window.solve()
        self.motion.start_keyframe()
        self._landmarks_in_keyframe = len(seen)
        return KeyframeTracks(window.landmarks.id[seen.landmark], seen.measurement, seen.covariance)

    def _add_landmarks(self, view: StereoView, views: LandmarkViews, blur: float) -> np.ndarray:
        """Makes landmarks of features (K,) at which none has been found, less certain where the view is blurred."""
        index = np.flatnonzero(np.isfinite(view.disparity))
        taken = views.measurement[:, :2]
        scale = np.clip(np.sqrt(view.left.size / _FULL_SPACING_FROM), _LEAST_SPACING, 1.0)
        spacing = float(scale) * self.config.spacing
        index = index[select_spaced(view.features.select(index), taken, spacing, view.left.shape)]
        self.window.add_landmarks(index, view.measured(index), blur * self.noise.of_keypoints(view, index))
        return index
