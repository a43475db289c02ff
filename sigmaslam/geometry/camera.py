"""Cameras: interior orientation (9.28)-(9.30), the stereo pair, and the rectified pair of (9.34)."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self, get_args

import numpy as np

from sigmaslam.bounded_files import shorten
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.checked_yaml import CalibrationYaml

DistortionModel = Literal["none", "radtan", "equidistant"]

COEFFICIENT_COUNTS: dict[str, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5, 8), "equidistant": (4,)}

# Rotations may deviate so much from orthonormal, as files have six or seven digits.
ORTHONORMAL_TOLERANCE = 1e-4
# A pair counts as rectified when rows agree to about 0.01 px. Angles are in radians, offsets relative to the baseline.
RECTIFIED_ANGLE = 1e-5
RECTIFIED_OFFSET = 1e-4
# Pixels; OpenCV's maps address no more.
MAX_SIDE = 32_767
# Pixels, of focal lengths, principal point and skew: squares of larger ones overflow in the end.
_MAX_PIXELS = 1e9

_NEWTON_STEPS = 50
_NEWTON_RESIDUAL = 1e-11


@dataclass(frozen=True, slots=True)
class CameraModel:
    """One camera: K of eq. (9.29) with shear, and lens distortion by OpenCV's models, eq. (9.30).

    Attributes:
        width, height: image size, pixels.
        fx, fy, cx, cy: focal lengths and principal point, pixels; (0, 0) is the centre of the top-left pixel.
        skew: K[0, 1], pixels.
        distortion_model: 'none', 'radtan' (OpenCV's) or 'equidistant' (cv2.fisheye's).
        distortion: coefficients: k1 k2 p1 p2 [k3 [k4 k5 k6]] for 'radtan', k1 k2 k3 k4 for 'equidistant'.

    Raises:
        CalibrationError: a size or focal length is not positive or too large, a size not whole, a value not finite, or
            the number of coefficients does not fit the model.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    skew: float = 0.0
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        _check_numbers((self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.skew), "width to skew")
        _check_numbers(self.distortion, "distortion")
        object.__setattr__(self, "distortion", tuple(float(value) for value in self.distortion))
        if not all(0 < side <= MAX_SIDE and side % 1 == 0 for side in (self.width, self.height)):
            size = f"{self.width:.6g}x{self.height:.6g}"
            raise CalibrationError(f"image size is {size}; sides must be whole numbers from 1, and at most {MAX_SIDE}")
        for name in ("width", "height", "fx", "fy", "cx", "cy", "skew"):  # YAML cannot write numpy's numbers
            object.__setattr__(self, name, (int if name in ("width", "height") else float)(getattr(self, name)))
        numbers = (self.fx, self.fy, self.cx, self.cy, self.skew, *self.distortion)
        if not np.all(np.isfinite(numbers)):
            raise CalibrationError(f"fx, fy, cx, cy, skew, distortion must be finite numbers, got {numbers}")
        if self.fx <= 0 or self.fy <= 0:
            raise CalibrationError(f"focal lengths must be positive pixels, got fx={self.fx}, fy={self.fy}")
        if max(map(abs, numbers[:5])) > _MAX_PIXELS:
            raise CalibrationError(f"fx, fy, cx, cy, skew must be at most {_MAX_PIXELS:g} pixels, got {numbers[:5]}")
        if not isinstance(self.distortion_model, str) or self.distortion_model not in COEFFICIENT_COUNTS:
            names = ", ".join(get_args(DistortionModel))
            raise CalibrationError(f"distortion_model is {self.distortion_model!r}; use one of {names}")
        counts = COEFFICIENT_COUNTS[self.distortion_model]
        if len(self.distortion) not in counts:
            raise CalibrationError(
                f"distortion has {len(self.distortion)} coefficients; model {self.distortion_model!r} "
                f"takes {' or '.join(map(str, counts))}"
            )

    def scaled(self, factor: float) -> Self:
        """Of images that are so many times as large, rounded to whole pixels."""
        width, height = (max(round(factor * size), 1) for size in (self.width, self.height))
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=x * self.fx,
            fy=y * self.fy,
            # (0, 0) is the centre of a pixel, whose corner stays where it is.
            cx=x * (self.cx + 0.5) - 0.5,
            cy=y * (self.cy + 0.5) - 0.5,
            skew=x * self.skew,
        )

    @property
    def matrix(self) -> np.ndarray:
        """K, (3, 3) float64."""
        return np.array([[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, points: np.ndarray) -> np.ndarray:
        """Pixels of points in the camera frame.

        Args:
            points: (..., 3) metres. Only points with Z > 0 have a meaning. This is not checked, so that whole clouds
                can be projected and masked afterwards.

        Returns:
            (..., 2) pixels (u, v), in the floating type of `points`.
        """
        points, dtype = _as_float64(points, 3, "points")
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            x, y = self._distort_rays(points)
            pixels = np.stack([self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy], axis=-1)
        return pixels.astype(dtype)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Rays of unit depth through pixels; the inverse of `project` to 1e-6 px, by Newton's method.

        Args:
            pixels: (..., 2) pixels (u, v).

        Returns:
            (..., 3) points with Z = 1 in the camera frame, in the floating type of `pixels`; NaN for pixels that no
            ray in front of the camera has (beyond the fold of the distortion, or 90 degrees).
        """
        pixels, dtype = _as_float64(pixels, 2, "pixels")
        y = (pixels[..., 1] - self.cy) / self.fy
        x = (pixels[..., 0] - self.cx - self.skew * y) / self.fx
        if self.distortion_model == "radtan":
            x, y = _undistort_radtan(x, y, self.distortion)
        elif self.distortion_model == "equidistant":
            x, y = _undistort_equidistant(x, y, self.distortion)
        return np.stack([x, y, np.ones_like(x)], axis=-1).astype(dtype)

    def _distort_rays(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        if self.distortion_model == "equidistant":
            radius = np.hypot(X, Y)
            theta_d, _ = _equidistant_polynomial(np.arctan2(radius, Z), self.distortion)
            # The ratio is 0 / 0 on the axis; its limit is 1 / Z.
            scale = np.where(radius > 0, theta_d / radius, 1.0 / Z)
            return X * scale, Y * scale
        x, y = X / Z, Y / Z
        if self.distortion_model == "radtan":
            x, y, _ = _distort_radtan(x, y, self.distortion)
        return x, y


def _check_numbers(values: Any, name: str) -> None:
    kinds = int | float | np.integer | np.floating
    ok = isinstance(values, Sequence | np.ndarray) and all(isinstance(v, kinds) and type(v) is not bool for v in values)
    if not ok:
        raise CalibrationError(f"{name} must be numbers, got {shorten(repr(values))}")


def _as_float64(array: np.ndarray, last: int, name: str) -> tuple[np.ndarray, np.dtype]:
    array = np.asarray(array)
    if array.ndim == 0 or array.shape[-1] != last:
        raise ValueError(f"{name} must have shape (..., {last}), got {array.shape}")
    dtype = array.dtype if np.issubdtype(array.dtype, np.floating) else np.dtype(np.float64)
    return array.astype(np.float64), dtype


def _distort_radtan(
    x: np.ndarray, y: np.ndarray, coefficients: Sequence[float]
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Distorted normalised coordinates and the Jacobian's (0, 0), (0, 1) = (1, 0) and (1, 1) entries."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *(0.0,) * (8 - len(coefficients)))
    r2 = x * x + y * y
    top, bottom = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    slope = (k1 + r2 * (2 * k2 + 3 * k3 * r2) - radial * (k4 + r2 * (2 * k5 + 3 * k6 * r2))) / bottom
    x_distorted = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y_distorted = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    jacobian = (
        radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x,
        2 * x * y * slope + 2 * p1 * x + 2 * p2 * y,
        radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x,
    )
    return x_distorted, y_distorted, jacobian


def _undistort_radtan(
    x_distorted: np.ndarray, y_distorted: np.ndarray, coefficients: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    x, y = x_distorted.copy(), y_distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            x_now, y_now, (a, b, d) = _distort_radtan(x, y, coefficients)
            error_x, error_y = x_now - x_distorted, y_now - y_distorted
            determinant = a * d - b * b
            x = x - (d * error_x - b * error_y) / determinant
            y = y - (a * error_y - b * error_x) / determinant
            if not np.any(np.hypot(error_x, error_y) > 1e-15):
                break
        x_now, y_now, (a, b, d) = _distort_radtan(x, y, coefficients)
        residual = np.hypot(x_now - x_distorted, y_now - y_distorted)
        # Both eigenvalues of the Jacobian are positive up to the fold, beyond which the image is mirrored.
        valid = (residual < _NEWTON_RESIDUAL) & (a * d - b * b > 0) & (a + d > 0)
    return np.where(valid, x, np.nan), np.where(valid, y, np.nan)


def _equidistant_polynomial(theta: np.ndarray, coefficients: Sequence[float]) -> tuple[np.ndarray, np.ndarray]:
    """Distorted angle theta (1 + k1 theta^2 + ...) and its derivative."""
    k1, k2, k3, k4 = coefficients
    t2 = theta * theta
    value = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    return value, 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))


def _undistort_equidistant(
    x_distorted: np.ndarray, y_distorted: np.ndarray, coefficients: Sequence[float]
) -> tuple[np.ndarray, np.ndarray]:
    theta_d = np.hypot(x_distorted, y_distorted)
    theta = theta_d.copy()
    with np.errstate(all="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, slope = _equidistant_polynomial(theta, coefficients)
            theta = theta - (value - theta_d) / slope
            if not np.any(np.abs(value - theta_d) > 1e-15):
                break
        value, slope = _equidistant_polynomial(theta, coefficients)
        valid = (np.abs(value - theta_d) < _NEWTON_RESIDUAL) & (slope > 0) & (theta >= 0) & (theta < np.pi / 2)
        scale = np.where(theta_d > 0, np.tan(theta) / theta_d, 1.0)
    scale = np.where(valid, scale, np.nan)
    return x_distorted * scale, y_distorted * scale


@dataclass(frozen=True, slots=True, eq=False)
class StereoCamera:
    """A stereo pair as calibrated.

    Attributes:
        left, right: the two cameras.
        T_left_right: (4, 4) float64, read-only; maps right-camera points into the left frame, metres. Its
            translation is the position of the right camera in the left frame.
        sigmas: how well all this is known.
        covariance: the same, measured and joint; what it names is not taken from `sigmas`.

    Raises:
        CalibrationError: T_left_right is no rigid transformation, or the right camera is not to the right.
    """

    left: CameraModel
    right: CameraModel
    T_left_right: np.ndarray
    sigmas: CalibrationSigmas = field(default_factory=CalibrationSigmas)
    covariance: CalibrationCovariance | None = None

    def __post_init__(self) -> None:
        try:
            T = np.array(self.T_left_right, dtype=np.float64)
        except (TypeError, ValueError):
            text = shorten(repr(self.T_left_right))
            raise CalibrationError(f"T_left_right must be a 4x4 matrix of numbers, got {text}") from None
        if T.shape != (4, 4):
            raise CalibrationError(f"T_left_right must be a 4x4 matrix, got shape {T.shape}")
        if not np.all(np.isfinite(T)):
            raise CalibrationError(f"T_left_right must be finite, got\n{T}")
        if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
            raise CalibrationError(f"the last row of T_left_right must be 0 0 0 1, got {T[3]}")
        defect = float(np.abs(T[:3, :3].T @ T[:3, :3] - np.eye(3)).max())
        if defect > ORTHONORMAL_TOLERANCE or np.linalg.det(T[:3, :3]) < 0:
            raise CalibrationError(
                f"the rotation in T_left_right is not orthonormal with determinant +1 (off by {defect:.2g}):\n{T}"
            )
        x, y, z = T[:3, 3]
        if not T[:3, 3].any():
            raise CalibrationError("the baseline is zero: T_left_right must give where the right camera is, in metres")
        if abs(y) > abs(x):
            raise CalibrationError(
                f"one camera stands above the other: T_left_right puts the right camera at ({x:.4g}, {y:.4g}, {z:.4g}) "
                "m in the left frame; turn images and calibration by 90 degrees, as only horizontal pairs are supported"
            )
        if x <= 0:
            raise CalibrationError(
                f"left and right look swapped: T_left_right puts the right camera at x = {x:.6g} m in the "
                "left frame, it must be positive; swap the cameras or invert the matrix"
            )
        if max(abs(y), abs(z)) > x:
            raise CalibrationError(
                f"the right camera lies at ({x:.4g}, {y:.4g}, {z:.4g}) m in the left frame: not beside the "
                "left camera; only horizontal stereo pairs are supported"
            )
        T.setflags(write=False)
        object.__setattr__(self, "T_left_right", T)

    @property
    def baseline(self) -> float:
        """Distance between the two centres of projection, metres."""
        return float(np.linalg.norm(self.T_left_right[:3, 3]))

    def scaled(self, factor: float) -> Self:
        """Of images that are so many times as large."""
        return replace(self, left=self.left.scaled(factor), right=self.right.scaled(factor))

    @property
    def is_rectified(self) -> bool:
        """Whether the images need no rectification: equal K, no distortion, parallel axes, a baseline along x."""
        left, right = self.left, self.right
        if left.distortion_model != "none" or right.distortion_model != "none" or left.skew or right.skew:
            return False
        K_left, K_right = left.matrix, right.matrix
        return bool(
            (left.width, left.height) == (right.width, right.height)
            and np.allclose(K_left, K_right, rtol=0, atol=1e-6 * left.fx)
            and np.abs(self.T_left_right[:3, :3] - np.eye(3)).max() < RECTIFIED_ANGLE
            and np.abs(self.T_left_right[1:3, 3]).max() < RECTIFIED_OFFSET * self.baseline
        )

    @classmethod
    def from_yaml(cls, path: str | os.PathLike[str]) -> Self:
        """Read a calibration file of our own form; `sigmaslam.readers.read_calibration` takes others, too.

        The form (sizes and K in pixels, lengths in metres; what `calibrate` writes beside is left alone)::

            left: {width: 752, height: 480, fx: 458.654, fy: 457.296, cx: 367.215, cy: 248.375,
                   skew: 0.0,                      # optional, 0
                   distortion_model: radtan,       # optional, none | radtan | equidistant
                   distortion: [-0.283, 0.0740, 0.0002, 0.00002]}   # optional, []
            right: {...}
            T_left_right: [[1, 0, 0, 0.11], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
            sigmas: {focal: 0.003}                 # optional, see `CalibrationSigmas`; 0: without errors
            covariance: {names: [focal, yaw], matrix: [[1e-6, 0], [0, 1e-8]]}   # optional, `CalibrationCovariance`

        Raises:
            CalibrationError: the file cannot be read, a key is missing or wrong; names file, key and value.
        """
        content = CalibrationYaml.read(path)
        content.reject_unknown(("left", "right", "T_left_right", "sigmas", "covariance", "residuals", "parameters"))
        left, right = (_camera_from_yaml(content.section(eye)) for eye in ("left", "right"))
        T_left_right, sigmas = content.numbers("T_left_right", (4, 4)), CalibrationSigmas.from_yaml(content)
        covariance = CalibrationCovariance.from_yaml(content)
        try:
            return cls(left, right, T_left_right, sigmas, covariance)
        except CalibrationError as error:
            raise content.error(str(error)) from None


def _camera_from_yaml(section: CalibrationYaml) -> CameraModel:
    required = ("fx", "fy", "cx", "cy")
    section.reject_unknown(("width", "height", *required, "skew", "distortion_model", "distortion"))
    values: dict[str, Any] = {key: section.integer(key) for key in ("width", "height")}
    values |= {key: section.number(key) for key in required}
    values["skew"] = section.number("skew", 0.0)
    values["distortion_model"] = section.text("distortion_model", "none")
    values["distortion"] = tuple(section.numbers("distortion", (None,), []).tolist())
    try:
        return CameraModel(**values)
    except CalibrationError as error:
        raise section.error(str(error)) from None


@dataclass(frozen=True, slots=True)
class RectifiedStereo:
    """A parallel pair with the same pinhole camera in both eyes, the geometry of (9.34).

    Attributes:
        fx, fy, cx, cy: intrinsics, pixels.
        baseline: metres.
        width, height: image size, pixels.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    width: int
    height: int

    @property
    def matrix(self) -> np.ndarray:
        """K of both eyes, (3, 3) float64."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def focal_baseline(self) -> float:
        """fx times the baseline: disparity times depth, pixels metres."""
        return self.fx * self.baseline

    @staticmethod
    def right_pixels(uvd: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of the right image that show what the left one has at (u, v, disparity) (..., 3)."""
        return np.stack([uvd[..., 0] - uvd[..., 2], uvd[..., 1]], axis=-1)

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Rays (..., 3) of unit depth in the left camera frame through pixels (..., 2)."""
        u, v = pixels[..., 0], pixels[..., 1]
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)

    def project(self, points: np.ndarray) -> np.ndarray:
        """(u_left, v, disparity) (..., 3), pixels, of points (..., 3) in the left camera, metres; Z > 0: unchecked."""
        points = np.asarray(points)
        X, Y, Z = points[..., 0], points[..., 1], points[..., 2]
        u, v = self.fx * X / Z + self.cx, self.fy * Y / Z + self.cy
        return np.stack([u, v, self.focal_baseline / Z], axis=-1)

    def triangulate(self, uvd: np.ndarray) -> np.ndarray:
        """Points from a rectified pair, eq. (9.34).

        Args:
            uvd: (..., 3) (u_left, v, disparity), pixels; disparity u_left - u_right must be positive.

        Returns:
            (..., 3) points in the left camera frame, metres.

        Raises:
            ValueError: a disparity is not positive (the message gives how many and the first index).
        """
        uvd = np.asarray(uvd)
        disparity = uvd[..., 2]
        wrong = ~(disparity > 0)
        if np.any(wrong):
            first = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"{np.count_nonzero(wrong)} of {disparity.size} disparities are not positive; the first is "
                f"{disparity[first]} at index {first if len(first) != 1 else first[0]}; drop those points"
            )
        Z = self.focal_baseline / disparity
        return np.stack([(uvd[..., 0] - self.cx) * Z / self.fx, (uvd[..., 1] - self.cy) * Z / self.fy, Z], axis=-1)
