"""How much surfaces vary around keypoints: what a patch shows may be nearer or farther than its keypoint.

At the edge of a surface the patch moves with one side of the edge and the keypoint may lie on the other. Matches do not
tell: the patch fits well, in the other eye and from everywhere. Neighbouring keypoints are too few to say where
surfaces end; dense disparities do.
"""

import cv2
import numpy as np

from sigmaslam.frontend.types import StereoView

# All below at half the resolution, which is five times as fast and nearly as good.
# Of the patches that are aligned, 11 pixels wide, with what is smoothed into them.
_RADIUS = 3
# Of semi-global matching, the side of its blocks: the smallest that OpenCV recommends, for edges that stay sharp.
_BLOCK = 3
# What steps of disparity by one, and by more, cost: OpenCV's own rule for grey images.
_SMALL_STEP, _LARGE_STEP = 8 * _BLOCK**2, 32 * _BLOCK**2
# By how many percent the best must win, and how many pixels must depart together to be believed: OpenCV's advice.
_UNIQUE, _SPECKLE = 10, 50
# Disparities searched: from behind infinity, for the sake of a disparity offset, to nearer than all keypoints.
_LEAST, _BEYOND = -4, 8


def dense_disparity(view: StereoView) -> np.ndarray:
    """(H / 2, W / 2) disparities in pixels of half the left image by semi-global matching, NaN where there is none."""
    largest = 0.5 * float(np.max(view.disparity, initial=0.0, where=np.isfinite(view.disparity)))
    left, right = (
        cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for image in (view.left, view.right)
    )
    levels = 16 * int(np.ceil((largest + _BEYOND - _LEAST) / 16))
    costs = {"blockSize": _BLOCK, "P1": _SMALL_STEP, "P2": _LARGE_STEP}
    return semi_global(left, right, _LEAST, levels, **costs, uniquenessRatio=_UNIQUE, speckleWindowSize=_SPECKLE)


def semi_global(left: np.ndarray, right: np.ndarray, least: int, levels: int, **settings: int) -> np.ndarray:
    """(H, W) float32 disparities of a rectified pair in sixteenths of a pixel, NaN where there is none.

    Args:
        left, right: (H, W) uint8.
        least, levels: the smallest disparity, and how many are searched.
        **settings: further ones of OpenCV's matcher.
    """
    mode = cv2.STEREO_SGBM_MODE_SGBM_3WAY
    matcher = cv2.StereoSGBM.create(minDisparity=least, numDisparities=levels, speckleRange=1, mode=mode, **settings)
    # It gives none to columns that the whole range of disparities would leave.
    wide = [cv2.copyMakeBorder(image, 0, 0, levels, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    sixteenths = matcher.compute(*wide)[:, levels:]
    return np.where(sixteenths >= 16 * least, sixteenths / np.float32(16.0), np.float32(np.nan))


def patch_disparity_range(dense: np.ndarray, measured: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Range of the disparities within each keypoint's patch, the slope of its surface taken off; (K,) pixels.

    Args:
        dense: (H / 2, W / 2) as `dense_disparity` gives it.
        measured: (K, 3) (u, v, disparity) of the keypoints.
        slope: (K, 2) gradients of the disparity there, as of `disparity_slopes`.
    Returns:
        Zero where nothing is known around a keypoint.
    """
    if not len(measured):
        return np.zeros(0)
    height, width = dense.shape
    dv, du = np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1]
    u, v = np.round(0.5 * measured[:, :2] - 0.25).astype(int).T[..., None, None]
    u, v = np.clip(u + du, 0, width - 1), np.clip(v + dv, 0, height - 1)
    tilted = slope[:, 0, None, None] * u + slope[:, 1, None, None] * v
    untilted = (dense[v, u] - tilted).reshape(len(measured), -1)
    known = np.isfinite(untilted)
    most, least = np.where(known, untilted, -np.inf).max(axis=1), np.where(known, untilted, np.inf).min(axis=1)
    return np.where(known.any(axis=1), 2.0 * (most - least), 0.0)
