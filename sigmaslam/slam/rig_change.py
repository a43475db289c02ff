"""Whether the right camera was bumped: it sees the landmarks elsewhere than before, all by the same."""

from dataclasses import dataclass, replace

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.gaussian import robust_sigma
from sigmaslam.frontend import StereoView
from sigmaslam.frontend.lucas_kanade import follow_both_ways, in_light_of
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.landmark_places import seen_from
from sigmaslam.slam.localisation import Localiser, Prediction

# Of the optical flow from eye to eye: side of its patches, pixels, levels above the image, there and back, and pixels
# that the way back may miss by; it reaches some 20 px.
_FLOW = 21, (3, 0), 1.0


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


def find_change(
    localiser: Localiser, before: StereoView, frame: Frame, matches: GuidedMatches, prediction: Prediction
) -> RigChange | None:
    """The bump before a frame; None where the left image gives no pose, or the right one fits it as before or is late.

    Args:
        before: the last keyframe's.
        matches: landmarks that were followed to it, with disparities that may be wrong.
    """
    matches = replace(matches, views=replace(matches.views, measurement=matches.views.measurement * (1, 1, np.nan)))
    fit = localiser.fit_near(matches, prediction)
    if fit is None:
        return None
    chosen, window = matches.views.select(fit.inliers), localiser.window
    offset = (0.0, 0.0, window.posterior.calibration[0])
    # An eye becomes late by an image that comes twice, without a pose: half of what surprises was there by then.
    surprise = se3_log(fit.step @ se3_inverse(localiser.motion.step))
    way = localiser.motion.way(localiser.frame_clock.interval) + 0.5 * surprise
    poses = fit.pose, *(fit.last @ se3_exp(moment) @ fit.step for moment in (-way, way))
    expected, *others = (seen_from(window, chosen.landmark, pose) + offset for pose in poses)
    expected[:, :2] = chosen.measurement[:, :2]
    moved = _moved(frame.left, frame.right, expected)
    usual = _moved(before.left, before.right, before.measured(np.isfinite(before.disparity)))
    if min(np.isfinite(each[:, 0]).sum() for each in (moved, usual)) < localiser.config.min_inliers:
        return None
    # Rows that were off before are an error of the calibration, and no change.
    moved -= (0.0, np.nanmedian(usual[:, 1]))
    places, camera = RectifiedStereo.right_pixels(expected), window.camera
    rays = (places - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    shift, spread = np.nanmedian(moved, axis=0), _spread(moved, rays)
    if np.linalg.norm(shift) < ACCEPTANCE.bump or spread > ACCEPTANCE.bump:
        return None
    # A late eye sees what is near move farther; a bump moves all alike, also if that is by chance the motion's median.
    # Twice as near to the other moment's places: where the camera stands both moments have the same.
    for other in others:
        apart = moved + places - RectifiedStereo.right_pixels(other)
        if 2.0 * np.linalg.norm(np.nanmedian(apart, axis=0)) < np.linalg.norm(shift) and _spread(apart, rays) < spread:
            return None
    return RigChange(fit, -float(shift[0]), float(shift[1]))


def _spread(moved: np.ndarray, rays: np.ndarray) -> float:
    """Standard deviation of ways (M, 2), pixels, or of what a turn leaves of them, which moves the border farther."""
    ways = np.stack([moved, moved - (rays @ np.nanmedian(moved, axis=0))[:, None] * rays])
    return float(robust_sigma(ways - np.nanmedian(ways, axis=1, keepdims=True), axis=1).max(axis=1).min())


def _moved(left: np.ndarray, right: np.ndarray, uvd: np.ndarray) -> np.ndarray:
    """(K, 2) by how much right places depart from where (u, v, disparity) (K, 3) put those on the left, or NaN."""
    moved, usable = np.full((len(uvd), 2), np.nan), np.isfinite(uvd).all(axis=1)
    places, right = uvd[usable, :2], in_light_of(left, right)
    expected = RectifiedStereo.right_pixels(uvd[usable])
    found, good = follow_both_ways(left, right, places, expected, *_FLOW)
    moved[usable] = np.where(good[:, None], found - expected, np.nan)
    return moved
