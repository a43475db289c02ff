"""Whether the matches that disagree with a pose agree with another one: something else moves, or the image is torn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.geometry.image_cells import explained_area, image_cells
from sigmaslam.slam.guided_matching import CONFIRMED, GuidedMatches
from sigmaslam.slam.landmark_places import seen_from
from sigmaslam.two_view.scene_pose import see_the_same, stands_before
from sigmaslam.two_view.stereo_pose import MIN_POINTS, estimate_relative_pose


@dataclass(frozen=True, slots=True)
class SecondMotion:
    """Another pose that a part of the matches asks for.

    Attributes:
        pose: (4, 4) T_world_camera as if these landmarks stood still.
        stands_before: they stand before what the first pose explains.
        stood_still: most of them agreed with earlier poses.
    """

    pose: np.ndarray
    stands_before: bool
    stood_still: bool


def find_second_motion(window: KeyframeWindow, matches: GuidedMatches, fit: FrameFit) -> SecondMotion | None:
    """The pose of most matches that disagree with `fit`.

    None where they have none in common, or one like that of it, or where it explains too little of the image.
    They are held against where the fit's pose sees the landmarks, as if that were a keyframe: `estimate_relative_pose`.
    """
    views, camera = matches.views, window.camera
    rows = views.landmark
    if len(rows) - fit.count < MIN_POINTS:
        return None
    expected = seen_from(window, rows, fit.pose)
    others = np.flatnonzero(~fit.inliers & np.isfinite(expected).all(axis=1))
    if len(others) < MIN_POINTS:
        return None
    cells, equal = image_cells(views.measurement[:, :2], camera.width, camera.height), np.ones(len(rows))
    # What the other pose explains of the image must be so much, for each that the first one explains.
    least = ACCEPTANCE.second_motion / (1.0 - ACCEPTANCE.second_motion) * explained_area(cells, fit.inliers, equal)
    if explained_area(cells, _among(others, len(rows)), equal) < least:
        return None
    covariance = window.landmarks.covariance[rows[others], :3, :3]
    relative = estimate_relative_pose(
        camera,
        expected[others],
        np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)),
        views.measurement[others],
        views.covariance[others],
        matches.probability[others],
    )
    if relative is None:
        return None
    agreeing = others[relative.inliers]
    apart = np.linalg.norm(views.measurement[agreeing, :2] - expected[agreeing, :2], axis=1)
    if see_the_same(apart) or explained_area(cells, _among(agreeing, len(rows)), equal) < least:
        return None
    nearer = stands_before(*(float(np.median(expected[chosen, 2])) for chosen in (agreeing, fit.inliers)))
    stood_still = bool(np.median(window.landmarks.views[rows[agreeing]]) >= CONFIRMED)
    return SecondMotion(fit.pose @ relative.T_key_camera, nearer, stood_still)


def _among(chosen: np.ndarray, count: int) -> np.ndarray:
    """(count,) bool of indices."""
    return np.isin(np.arange(count), chosen)
