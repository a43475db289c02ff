"""Rectification: from a calibrated pair to the parallel pair of (9.34)."""

import cv2
import numpy as np

from sigmaslam.errors import CalibrationError, FrameError
from sigmaslam.geometry.camera import CameraModel, RectifiedStereo, StereoCamera
from sigmaslam.geometry.se3 import rigid_motion

# The rectified image ends at 60 degrees from the axis, as a fisheye image would be stretched without limit.
MAX_TANGENT = float(np.tan(np.radians(60.0)))
# A rectified pixel is valid if its source is at least so many pixels from the image border.
VALID_MARGIN = 3
_BORDER_SAMPLES = 200
# Of an image, which fit into the cache with all that is computed of them.
_ROWS_AT_ONCE = 16


class StereoRectifier:
    """Warps image pairs so that a point has the same row in both; a pass-through for a rectified camera.

    The rotations are those of cv2.stereoRectify (Bouguet: each eye turns by half of the relative rotation,
    then the x axis goes along the baseline). The common focal length and principal point show only pixels
    that both eyes have (as alpha = 0) with zero disparity at infinity. The maps come from
    `CameraModel.project`, as OpenCV's ignore skew and have no pair of different lens models.

    Attributes:
        rectified: the geometry of the output pair.
        R_rectified_left, R_rectified_right: (3, 3) rotations from the original to the rectified eye.
        valid_mask: (H, W) uint8, 255 where the left rectified pixel comes from inside the left image, at
            least `VALID_MARGIN` px from its border; None for a pass-through.
        raised: rows by which right images are raised, as `raise_right` was told.

    Raises:
        CalibrationError: no rectangle of the scene is seen by both eyes.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self.camera, self.raised = camera, 0.0
        self.valid_mask: np.ndarray | None = None
        self._maps: tuple[tuple[np.ndarray, np.ndarray], ...] | None = None
        left = camera.left
        if camera.is_rectified:
            self.R_rectified_left, self.R_rectified_right = np.eye(3), np.eye(3)
            self.rectified = RectifiedStereo(
                left.fx, left.fy, left.cx, left.cy, camera.baseline, left.width, left.height
            )
            return
        self.R_rectified_left, self.R_rectified_right = _parallel_rotations(camera)
        self.rectified = _common_view(camera, self.R_rectified_left, self.R_rectified_right)
        self._maps = (
            _source_pixels(left, self.rectified, self.R_rectified_left),
            _source_pixels(camera.right, self.rectified, self.R_rectified_right),
        )
        self.valid_mask = _valid_mask(left, *self._maps[0])

    @property
    def T_rectified_left(self) -> np.ndarray:  # noqa: N802
        """(4, 4) takes points of the left camera into the rectified one: both eyes turn about their centres."""
        return rigid_motion(self.R_rectified_left, np.zeros(3))

    def describe(self) -> dict[str, np.ndarray]:
        """The rectified pair: intrinsics (5,) fx, fy, cx, cy, baseline, and R_rectified_left (3, 3)."""
        pair = self.rectified
        intrinsics = np.array([pair.fx, pair.fy, pair.cx, pair.cy, pair.baseline])
        return {"intrinsics": intrinsics, "R_rectified_left": self.R_rectified_left}

    def rectify(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rectified images, bilinear; the very same arrays if the camera is rectified already.

        Args:
            left, right: (H, W) or (H, W, C) images of the calibration's sizes.

        Raises:
            FrameError: an image has another size (the message gives both).
        """
        for eye, image, model in (("left", left, self.camera.left), ("right", right, self.camera.right)):
            if image.shape[:2] != (model.height, model.width):
                raise FrameError(
                    f"{eye} image is {image.shape[1]}x{image.shape[0]}, its calibration is for "
                    f"{model.width}x{model.height}; use the calibration made at this size"
                )
        if self._maps is None:
            return left, right
        right = cv2.remap(right, *self._maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return self.rectify_left(left), np.asarray(right)

    def rectify_left(self, image: np.ndarray) -> np.ndarray:
        """A left image alone, as `rectify` does it."""
        if self._maps is None:
            return image
        return np.asarray(cv2.remap(image, *self._maps[0], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT))

    def raise_right(self, rows: float) -> None:
        """From now on the right images, which a bump has lowered by so many rows, are raised by them."""
        self.raised += rows
        if self._maps is None:
            model = self.camera.right
            u, v = np.meshgrid(np.arange(model.width, dtype=np.float32), np.arange(model.height, dtype=np.float32))
            self._maps = (u, v), (u, v)
        left, (u, v) = self._maps
        self._maps = left, (u, v + np.float32(rows))

    def rectify_mask(self, mask: np.ndarray) -> np.ndarray:
        """(H, W) uint8 mask of the left image rectified, by the nearest pixel; 255 where there is none."""
        if self._maps is None:
            return mask
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.remap(mask, *self._maps[0], cv2.INTER_NEAREST, borderMode=border, borderValue=255))


def _parallel_rotations(camera: StereoCamera) -> tuple[np.ndarray, np.ndarray]:
    """Rotations from each eye to its rectified frame, as in cv2.stereoRectify."""
    R_left_right, position = camera.T_left_right[:3, :3], camera.T_left_right[:3, 3]
    half, _ = cv2.Rodrigues(0.5 * cv2.Rodrigues(R_left_right)[0])
    # The baseline is in the frame half-way between the eyes: half^T takes the left eye to it, half the right one.
    baseline = half.T @ position
    axis = np.cross(baseline, [1.0, 0.0, 0.0])
    length = np.linalg.norm(axis)
    if length > 0:
        align, _ = cv2.Rodrigues(axis * (np.arctan2(length, baseline[0]) / length))
    else:
        align = np.eye(3)
    return align @ half.T, align @ half


def _common_view(camera: StereoCamera, R_left: np.ndarray, R_right: np.ndarray) -> RectifiedStereo:
    views = np.array([_inner_rectangle(camera.left, R_left), _inner_rectangle(camera.right, R_right)])
    x_min, y_min = views[:, :2].max(axis=0)
    x_max, y_max = views[:, 2:].min(axis=0)
    if x_max <= x_min or y_max <= y_min:
        raise CalibrationError(
            "after rectification the two eyes share no rectangle of the scene "
            f"(x {x_min:.3g} to {x_max:.3g}, y {y_min:.3g} to {y_max:.3g} at unit depth); check the rotation "
            "in T_left_right and the distortion coefficients"
        )
    width, height = camera.left.width, camera.left.height
    focal = max((width - 1) / (x_max - x_min), (height - 1) / (y_max - y_min))
    return RectifiedStereo(
        fx=float(focal),
        fy=float(focal),
        cx=float((width - 1) / 2 - focal * (x_min + x_max) / 2),
        cy=float((height - 1) / 2 - focal * (y_min + y_max) / 2),
        baseline=camera.baseline,
        width=width,
        height=height,
    )


def _inner_rectangle(model: CameraModel, R: np.ndarray) -> np.ndarray:
    """(x_min, y_min, x_max, y_max) at unit depth of a rectangle inside the rotated image."""
    u, v = np.linspace(0, model.width - 1, _BORDER_SAMPLES), np.linspace(0, model.height - 1, _BORDER_SAMPLES)
    sides = (
        np.stack([np.zeros_like(v), v], axis=-1),
        np.stack([u, np.zeros_like(u)], axis=-1),
        np.stack([np.full_like(v, model.width - 1), v], axis=-1),
        np.stack([u, np.full_like(u, model.height - 1)], axis=-1),
    )
    bounds = np.array([-MAX_TANGENT, -MAX_TANGENT, MAX_TANGENT, MAX_TANGENT])
    for side, pixels in enumerate(sides):
        rays = model.unproject(pixels) @ R.T
        # Border pixels without a ray in front of the camera are beyond the limit.
        rays = rays[rays[:, 2] > 0]
        edge = rays[:, side % 2] / rays[:, 2]
        if len(edge):
            bounds[side] = max(bounds[side], edge.max()) if side < 2 else min(bounds[side], edge.min())
    return bounds


def _source_pixels(model: CameraModel, view: RectifiedStereo, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each rectified pixel, (H, W) float32 u and v of its place in the original image."""
    source = np.empty((2, view.height, view.width), np.float32)
    for top in range(0, view.height, _ROWS_AT_ONCE):
        rows = np.arange(top, min(top + _ROWS_AT_ONCE, view.height))
        rays = view.rays(np.stack(np.meshgrid(np.arange(view.width), rows), axis=-1)) @ R
        pixels = np.where(rays[..., 2:] > 0, model.project(rays), -1.0)
        source[:, rows] = np.moveaxis(pixels, -1, 0)
    return source[0], source[1]


def _valid_mask(model: CameraModel, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    inside_u = (u >= VALID_MARGIN) & (u <= model.width - 1 - VALID_MARGIN)
    inside_v = (v >= VALID_MARGIN) & (v <= model.height - 1 - VALID_MARGIN)
    return np.where(inside_u & inside_v, 255, 0).astype(np.uint8)
