"""Whether the right camera was bumped: it sees the landmarks elsewhere than before, all by the same."""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.frontend.lucas_kanade import in_light_of, lucas_kanade
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.keyframes import Keyframes
from sigmaslam.slam.landmark_places import seen_from
from sigmaslam.slam.localisation import Localiser, Prediction

# Of the optical flow from eye to eye: side of its patches, pixels, and levels above the image; it reaches some 20 px.
_WINDOW, _LEVELS = 21, 3
# From the spread of right matches to their standard deviation, by the median.
_ROBUST = 1.4826


@dataclass(frozen=True, slots=True)
class RigChange:
    """A bump of the right camera.

    Attributes:
        fit: pose of the left camera by its own image alone.
        columns, rows: by how much disparities are larger, and right places lower than before, pixels.
    """

    fit: FrameFit
    columns: float
    rows: float


@dataclass(frozen=True, slots=True)
class RigWatch:
    """Looks for bumps where a frame does not fit what was known."""

    window: KeyframeWindow
    localiser: Localiser
    keyframes: Keyframes

    def find_change(self, frame: Frame, matches: GuidedMatches, prediction: Prediction) -> RigChange | None:
        """The bump before a frame; None where the left image gives no pose, or the right one fits it as before.

        Args:
            matches: landmarks that were followed to it, with disparities that may be wrong.
            prediction: of its pose.
        """
        matches = replace(matches, views=replace(matches.views, measurement=matches.views.measurement * (1, 1, np.nan)))
        fit = self.localiser.fit_near(matches, prediction)
        if fit is None:
            return None
        chosen, camera = matches.views.select(fit.inliers), self.window.camera
        expected = seen_from(self.window, chosen.landmark, fit.pose)[:, 2] + self.window.posterior.calibration[0]
        moved, places = _follow(frame.left, frame.right, np.column_stack([chosen.measurement[:, :2], expected]))
        before = self.keyframes.active[-1].view
        usual, _ = _follow(before.left, before.right, before.measured(np.isfinite(before.disparity)))
        if min(len(moved), len(usual)) < self.localiser.config.min_inliers:
            return None
        # Of a camera that was turned what is at the border moves farther.
        middle, rays = np.median(moved, axis=0), (places - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        ways = np.stack([moved, moved - (rays @ middle)[:, None] * rays])
        spread = _ROBUST * np.median(np.abs(ways - np.median(ways, axis=1, keepdims=True)), axis=1).max(axis=1)
        # Rows that were off before are an error of the calibration, and no change.
        shift = middle - (0.0, np.median(usual[:, 1]))
        if np.linalg.norm(shift) < ACCEPTANCE.bump or spread.min() > ACCEPTANCE.bump:
            return None
        return RigChange(fit, -float(shift[0]), float(shift[1]))


def _follow(left: np.ndarray, right: np.ndarray, uvd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, 2) each: by how much right places depart from where (u, v, disparity) (K, 3) put those on the left; these."""
    uvd = uvd[np.isfinite(uvd).all(axis=1)]
    expected, right = RectifiedStereo.right_pixels(uvd), in_light_of(left, right)
    found, ended = lucas_kanade(left, right, uvd[:, :2], expected, _WINDOW, _LEVELS)
    back, returned = lucas_kanade(right, left, found, uvd[:, :2], _WINDOW, 0)
    good = ended & returned & (np.linalg.norm(back - uvd[:, :2], axis=1) < 1.0)
    return (found - expected)[good], expected[good]
