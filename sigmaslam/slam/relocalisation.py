"""Relocalisation: a lost view is found in the last keyframe, among those that left the window, or in a map."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.constant_velocity import MotionFilter, dead_reckoning
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend import StereoView
from sigmaslam.geometry.se3 import nearest_rigid
from sigmaslam.slam.keyframe import KnownKeyframe, from_origin
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_admission import LandmarkAdmission
from sigmaslam.slam.localisation import Prediction
from sigmaslam.slam.place_recognition import retrieve
from sigmaslam.slam.unguided_matching import UnguidedMatcher

# A view is compared with so many remembered keyframes, the ones most like it.
_RETRIEVED = 3


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """Where a view was found.

    Attributes:
        view: with disparities where landmarks may be.
        pose: (4, 4) T_world_camera.
        covariance: (6, 6) of the pose relative to that of the keyframe's origin, perturbed from the right.
        keyframe: that it was found by.
    """

    view: StereoView
    pose: np.ndarray
    covariance: np.ndarray
    keyframe: KnownKeyframe


@dataclass(frozen=True, slots=True)
class Relocaliser:
    """Finds views in the last keyframe and among remembered ones.

    Attributes:
        window: of the tracker.
        keyframes: of the window and its past.
        motion: predicts the view while the window has keyframes.
        matcher: finds keyframes in views.
        admission: what may become a landmark.
        min_inliers: fewer are no pose.
    """

    window: KeyframeWindow
    keyframes: Keyframes
    motion: MotionFilter
    matcher: UnguidedMatcher
    admission: LandmarkAdmission
    min_inliers: int

    def relocalise(self, view: StereoView, after_gap: bool) -> Relocalisation | None:
        """Finds the view; None if it is nowhere.

        Args:
            after_gap: in time, or in what images show: the last keyframe is asked, too. Without one, its landmarks are
                lost because the rig has changed.
        """
        if not self.is_enough(view):
            return None
        # Features of the last one may be many where none of its landmarks is found again.
        last = self.keyframes.active[-1:] if after_gap else []
        for keyframe in [*last, *retrieve(view, _RETRIEVED, self.keyframes.left_long_ago(), self.keyframes.appearance)]:
            relative, is_last = self.matcher.confirmed_pose_to(keyframe.view, view), keyframe in last
            if relative is None:
                continue
            pose = nearest_rigid(self.keyframes.poses([keyframe])[0] @ relative.T_key_camera)
            # Repeated texture agrees on other places: by a few dozens of matches, which the motion since the last image
            # excludes if that was guessed, or by hundreds, which it excludes if that was measured. Landmarks of the
            # last one spoke against its pose: both must speak for it.
            is_clear = self.matcher.is_beyond_chance(relative)
            excludes = len(self.window) > 0 and Prediction.of(self.window, self.motion).excludes(pose)
            trusts_motion = dead_reckoning(self.motion) is not None or not is_clear or is_last
            if (trusts_motion and excludes) or (is_last and not is_clear):
                continue
            admitted = view.only(self.admission.admit(view, pose, self.window))
            if not self.is_enough(admitted):
                continue
            return Relocalisation(admitted, pose, from_origin(keyframe, relative).covariance, keyframe)
        return None

    def is_enough(self, view: StereoView) -> bool:
        """Whether a view has enough in stereo to be a keyframe."""
        return view.has_stereo(self.admission.min_points, self.min_inliers)
