"""Landmarks followed from frame to frame, without features of the frame."""

from functools import partial

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.frontend.followed_patches import follow_flow
from sigmaslam.geometry.se3 import rotation_log
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatcher, GuidedMatches
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.mapping import KeyframeTracks

# Radians. Optical flow takes patches for shifted alone; turned by more, their corners are a pixel off.
_LARGE_TURN = 0.1


class LandmarkFollower:
    """Remembers where landmarks were in the last frame, and finds them in the next one."""

    def __init__(self, guided: GuidedMatcher) -> None:
        self._guided = guided
        self._left: np.ndarray | None = None
        self._usual: float | None = None

    @property
    def is_ready(self) -> bool:
        """There is a last frame with a pose."""
        return self._left is not None

    @property
    def count(self) -> int:
        """Landmarks that were seen in the last frame; 0 where it had no pose."""
        return 0 if self._left is None else len(self._id)

    def forget(self) -> None:
        """There is no last frame with a pose."""
        self._left = None

    def remember(self, left: np.ndarray, landmark_id: np.ndarray, places: np.ndarray) -> None:
        """Takes the frame that has been tracked.

        Args:
            left: (H, W) uint8.
            landmark_id: (M,) of the landmarks that were seen.
            places: (M, 2) pixels.
        """
        order = np.argsort(landmark_id)
        self._left, self._id, self._places = left, landmark_id[order], places[order]

    def remember_frame(
        self, left: np.ndarray, matches: GuidedMatches, fit: FrameFit | None, tracks: KeyframeTracks | None
    ) -> None:
        """Takes note of where landmarks are in the frame, so that the next one can be followed.

        Args:
            left: (H, W) uint8.
            matches, fit: of the frame; None: it has no pose.
            tracks: what it saw where it became a keyframe.
        """
        if tracks is not None:
            self.remember(left, tracks.landmark_id, tracks.measurement[:, :2])
        elif fit is not None:
            seen = matches.views.select(fit.inliers)
            self.remember(left, self._guided.window.landmarks.id[seen.landmark], seen.measurement[:, :2])
        else:
            self.forget()

    def follow(
        self,
        frame: Frame,
        keyframes: list[Keyframe],
        pose: np.ndarray,
        covariance: np.ndarray,
        turn: np.ndarray | None = None,
    ) -> tuple[GuidedMatches, float]:
        """Finds the window's landmarks by optical flow from the last frame, aligned to their keyframes' patches.

        Args:
            keyframes: of the window.
            pose, covariance: predicted, as of `GuidedMatcher.match_guided`.
            turn: (3, 3) rotation R_last_current that a sensor has measured; None: unknown.
        Returns:
            As of `GuidedMatcher.follow`.
        """
        views = [keyframe.view for keyframe in keyframes]
        return self._guided.follow(frame, views, pose, covariance, partial(self._carry, turn))

    def has_fallen(self, matches: GuidedMatches, inliers: np.ndarray) -> bool:
        """Whether suddenly fewer of the landmarks have a disparity than usual.

        How many landmarks are found does not matter: where something covers half the image the rest is still right.

        Args:
            matches: as `follow` gives them.
            inliers: (M,) bool, those that agree with the pose.
        """
        stereo = np.isfinite(matches.views.measurement[inliers, 2])
        share = float(stereo.mean()) if len(stereo) else 0.0
        usual = share if self._usual is None else self._usual
        # Also after a fall, so that what stays so becomes usual.
        self._usual = usual + ACCEPTANCE.stereo_usual_gain * (share - usual)
        return share < ACCEPTANCE.stereo_fall * usual

    def _carry(
        self, turn: np.ndarray | None, left: np.ndarray, landmark_id: np.ndarray, predicted: np.ndarray
    ) -> np.ndarray:
        """(K, 2) where optical flow takes landmarks; NaN for those that the last frame did not see."""
        start = np.full(predicted.shape, np.nan)
        if self._left is None or not len(self._id):
            return start
        at = np.minimum(np.searchsorted(self._id, landmark_id), len(self._id) - 1)
        rows = np.flatnonzero(self._id[at] == landmark_id)
        height, width = left.shape
        guess = np.clip(predicted[rows], 0, (width - 1, height - 1))
        last, before = self._left, self._places[at[rows]]
        if turn is not None and np.linalg.norm(rotation_log(turn)) > _LARGE_TURN:
            K = self._guided.camera.matrix
            homography = K @ turn.T @ np.linalg.inv(K)
            last = cv2.warpPerspective(last, homography, (width, height))
            before = cv2.perspectiveTransform(before[:, None], homography)[:, 0]
        places, found = follow_flow(last, left, before, guess)
        start[rows[found]] = places[found]
        return start
