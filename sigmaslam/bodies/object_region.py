"""Where a followed body is in the image: what the user says of the first frame, and the body's own points later."""

import re
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_inverse, transform_points
from sigmaslam.readers.masks import read_mask

_NUMBER = r"\s*([-+]?(?:[0-9]{1,9}(?:\.[0-9]{0,9})?|\.[0-9]{1,9}))\s*"
_BOX = re.compile(",".join([_NUMBER] * 4))
# Points further from the middle of a body than so many median distances are not taken for its outline.
_FARTHEST = 4.0
# What borders on the known outline may be the body's, too: it turns. Share of the outline's size, and pixels at least.
_MARGIN, _MIN_MARGIN = 0.1, 8.0
# A body is so much deeper than its known points, as a share of their size, and of their distance at least.
_DEPTH_SLACK, _MIN_DEPTH_SLACK = 0.25, 0.03
_MIN_POINTS = 3


def read_region(text: str, width: int, height: int) -> np.ndarray:
    """The region that `--track-object` names, (height, width) bool, in the raw left image.

    Args:
        text: "x,y,width,height" in pixels, or the path of an image of that size whose pixels are not zero on the body.
        width, height: of the raw left image.
    Raises:
        InputError: it is neither, or reaches beyond the image, or is empty.
    """
    box = _BOX.fullmatch(text)
    if box:
        x, y, across, down = (float(value) for value in box.groups())
        if across < 1 or down < 1:
            raise InputError(f"--track-object {shorten(text)}: width and height of the box must be 1 pixel or more")
        if x < 0 or y < 0 or x + across > width or y + down > height:
            raise InputError(
                f"--track-object {shorten(text)}: the box (x, y, width, height) reaches beyond the left image of "
                f"{width}x{height} pixels; give one inside it"
            )
        region = np.zeros((height, width), bool)
        region[round(y) : max(round(y + down), round(y) + 1), round(x) : max(round(x + across), round(x) + 1)] = True
        return region
    path = Path(text)
    if not _is_there(path):
        raise InputError(
            f"--track-object {shorten(text)}: neither a box nor an image file; give x,y,width,height in pixels of the "
            "first left image, or a mask of its size that is not zero on the body"
        )
    return read_mask(path, width, height)


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # no file can have such a name
        return False


def inner_half(region: np.ndarray) -> np.ndarray:
    """The inside of a region (H, W) bool: what is at least half as far from its border as its innermost pixel."""
    distance = cv2.distanceTransform(np.pad(region.astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    return np.asarray(distance >= 0.5 * distance.max())


class BodyShape:
    """Points that have moved with the body, and where it must be in an image because of them."""

    def __init__(self, camera: RectifiedStereo) -> None:
        self._camera = camera
        self._points: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._points)

    def add(self, numbers: np.ndarray, points: np.ndarray) -> None:
        """Takes points (K, 3) in the body's frame, or better estimates of known ones, by number (K,)."""
        self._points.update(zip(numbers.tolist(), points, strict=True))

    def points(self) -> np.ndarray:
        """(M, 3) in the body's frame, without those far off."""
        every = np.array(list(self._points.values())).reshape(-1, 3)
        if len(every) < _MIN_POINTS:
            return every
        away = np.linalg.norm(every - np.median(every, axis=0), axis=1)
        return np.asarray(every[away <= _FARTHEST * np.median(away)])

    def holds(self, pose: np.ndarray, uvd: np.ndarray) -> np.ndarray:
        """Which places in an image may be on the body; (N,) bool.

        They are inside the convex hull of its points as they are projected, grown by a margin, and as far away.

        Args:
            pose: (4, 4) of the rectified camera in the body's frame.
            uvd: (N, 3) left pixel and disparity.
        """
        points = self.points()
        seen = transform_points(se3_inverse(pose), points)
        seen = seen[seen[:, 2] > 1e-6]
        if len(seen) < _MIN_POINTS:
            return np.zeros(len(uvd), bool)
        camera = self._camera
        u = camera.fx * seen[:, 0] / seen[:, 2] + camera.cx
        v = camera.fy * seen[:, 1] / seen[:, 2] + camera.cy
        hull = cv2.convexHull(np.column_stack([u, v]).astype(np.float32))
        margin = max(_MIN_MARGIN, _MARGIN * float(np.sqrt(cv2.contourArea(hull))))
        inside = [cv2.pointPolygonTest(hull, (float(x), float(y)), True) >= -margin for x, y in uvd[:, :2]]
        slack = _DEPTH_SLACK * float(np.ptp(points, axis=0).max()) + _MIN_DEPTH_SLACK * float(np.median(seen[:, 2]))
        focal = camera.focal_baseline
        lowest, highest = focal / (seen[:, 2].max() + slack), focal / max(seen[:, 2].min() - slack, 1e-6)
        return np.array(inside, bool).reshape(-1) & (uvd[:, 2] >= lowest) & (uvd[:, 2] <= highest)
