"""The same matches as other mistakes of the user would have them: eyes exchanged, no rectification, a vertical rig."""

from dataclasses import replace

import numpy as np

from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.geometry.camera import CameraModel, RectifiedStereo
from sigmaslam.geometry.rectification import StereoRectifier


def stored_places(matches: EyeMatches, rectifier: StereoRectifier) -> tuple[np.ndarray, np.ndarray]:
    """Left and right places (M, 2) in the images as they are stored, pixels."""
    if rectifier.camera.is_rectified:
        return matches.left, matches.right
    return (
        rectifier.camera.left.project(rectifier.rectified.rays(matches.left) @ rectifier.R_rectified_left),
        rectifier.camera.right.project(rectifier.rectified.rays(matches.right) @ rectifier.R_rectified_right),
    )


def rectified_places(
    matches: EyeMatches, stored: tuple[np.ndarray, np.ndarray], rectifier: StereoRectifier
) -> EyeMatches:
    """The matches with left and right places (M, 2) of the stored images as a rectifier sees them."""
    left, right = stored
    if not rectifier.camera.is_rectified:
        left = _rectified(left, rectifier.camera.left, rectifier.R_rectified_left, rectifier.rectified)
        right = _rectified(right, rectifier.camera.right, rectifier.R_rectified_right, rectifier.rectified)
    return _finite(replace(matches, left=left, right=right))


def exchange_eyes(matches: EyeMatches, rectifier: StereoRectifier) -> EyeMatches:
    """What the matches would be if the left images were given as the right ones and the other way round."""
    return rectified_places(matches, stored_places(matches, rectifier)[::-1], rectifier)


def leave_unrectified(matches: EyeMatches, rectifier: StereoRectifier) -> EyeMatches:
    """What the matches are in the images as they are stored."""
    left, right = stored_places(matches, rectifier)
    return _finite(replace(matches, left=left, right=right))


def stand_upright(matches: EyeMatches) -> EyeMatches:
    """Rows for columns: what a vertical rig would be if both cameras were turned by 90 degrees; disparity is positive.

    A camera below the left one, or above it.
    """
    left, right = matches.left[:, ::-1], matches.right[:, ::-1]
    if np.median(left[:, 0] - right[:, 0]) < 0:
        left, right = -left, -right
    return replace(matches.unfollowed(), left=left, right=right)


def _rectified(pixels: np.ndarray, model: CameraModel, R: np.ndarray, view: RectifiedStereo) -> np.ndarray:
    return view.project(model.unproject(pixels) @ R.T)[:, :2]


def _finite(matches: EyeMatches) -> EyeMatches:
    return matches.select(np.isfinite(matches.left).all(axis=1) & np.isfinite(matches.right).all(axis=1))
