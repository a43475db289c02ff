"""How much surfaces vary around keypoints: what a patch shows may be nearer or farther than its keypoint.

At the edge of a surface the patch moves with one side of the edge and the keypoint may lie on the other. Matches do not
tell: the patch fits well, in the other eye and from everywhere. Neighbouring keypoints are too few to say where
surfaces end; dense disparities do.
"""

import cv2
import numpy as np

# All below at half the resolution, which is five times as fast and nearly as good.
# Of the patches that are aligned, 11 pixels wide, with what is smoothed into them; and what is matched beside them for
# the sake of smoothness: NEES of rendered points 1.8, 1.5, 1.3, 1.2 with 1, 2, 4, 6, and with the whole images 1.6.
_RADIUS, _MARGIN = 3, 4
# Of semi-global matching, the side of its blocks: the smallest that OpenCV recommends, for edges that stay sharp.
_BLOCK = 3
# What steps of disparity by one, and by more, cost: OpenCV's own rule for grey images.
_SMALL_STEP, _LARGE_STEP = 8 * _BLOCK**2, 32 * _BLOCK**2
# By how many percent the best must win: OpenCV's advice.
_UNIQUE = 10
# Disparities searched, half of them below the keypoint's: a surface 32 pixels nearer or farther is another one's edge.
_LEVELS = 32


def semi_global(left: np.ndarray, right: np.ndarray, least: int, levels: int, **settings: int) -> np.ndarray:
    """(H, W) float32 disparities of a rectified pair in sixteenths of a pixel, NaN where there is none.

    Args:
        left, right: (H, W) uint8.
        least, levels: the smallest disparity, and how many are searched.
        **settings: further ones of OpenCV's matcher.
    """
    # It gives none to columns that the whole range of disparities would leave.
    wide = [cv2.copyMakeBorder(image, 0, 0, levels, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    return _match(wide, least, levels, **settings)[:, levels:]


def _match(pair: list[np.ndarray], least: int, levels: int, **settings: int) -> np.ndarray:
    """The same without the columns whose range of disparities leaves the images."""
    mode = cv2.STEREO_SGBM_MODE_SGBM_3WAY
    matcher = cv2.StereoSGBM.create(minDisparity=least, numDisparities=levels, speckleRange=1, mode=mode, **settings)
    sixteenths = matcher.compute(*pair)
    return np.where(sixteenths >= 16 * least, sixteenths / np.float32(16.0), np.float32(np.nan))


def patch_disparity_range(left: np.ndarray, right: np.ndarray, measured: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Range of the disparities within each keypoint's patch, the slope of its surface taken off; (K,) pixels.

    Windows around the keypoints, those of the right image moved by their disparities, are matched one below the other.

    Args:
        left, right: (H, W) uint8, a rectified pair.
        measured: (K, 3) (u, v, disparity) of the keypoints.
        slope: (K, 2) gradients of the disparity there, as of `disparity_slopes`.
    Returns:
        Zero where nothing is known around a keypoint.
    """
    if not len(measured):
        return np.zeros(0)
    reach, beside = _RADIUS + _MARGIN, _RADIUS + _MARGIN + _BLOCK + _LEVELS // 2
    u, v, disparity = np.round(0.5 * measured - (0.25, 0.25, 0.0)).astype(int).T
    windows = []
    for image, column in ((left, u), (right, u - disparity)):
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        rows = np.clip(v[:, None] + np.arange(-reach, reach + 1), 0, half.shape[0] - 1)
        columns = np.clip(column[:, None] + np.arange(-beside, beside + 1), 0, half.shape[1] - 1)
        windows.append(half[rows[:, :, None], columns[:, None, :]].reshape(-1, 2 * beside + 1))
    costs = {"blockSize": _BLOCK, "P1": _SMALL_STEP, "P2": _LARGE_STEP, "uniquenessRatio": _UNIQUE}
    dense = _match(windows, -_LEVELS // 2, _LEVELS, **costs).reshape(len(measured), 2 * reach + 1, -1)
    dv, du = np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1]
    tilted = slope[:, 0, None, None] * du + slope[:, 1, None, None] * dv
    untilted = (dense[:, reach + dv, beside + du] - tilted).reshape(len(measured), -1)
    known = np.isfinite(untilted)
    most, least = np.where(known, untilted, -np.inf).max(axis=1), np.where(known, untilted, np.inf).min(axis=1)
    return np.where(known.any(axis=1), 2.0 * (most - least), 0.0)
