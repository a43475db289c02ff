"""Stereo odometry as one writes it from OpenCV in an afternoon: points of a keyframe, then the pose by PnP.

Two matchers, SIFT with Lowe's ratio test and pyramidal Lucas-Kanade, under one odometry. The landmarks count as known:
the covariance of a pose is that of one pixel of noise in its own image, added along the chain of keyframes. The
settings are common ones, the same for every sequence.
"""

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.geometry.se3 import rotation_exp, se3_adjoint, se3_inverse, se3_log, skew
from sigmaslam_benchmarks.tracking.peer_run import PeerStep

_KEYPOINTS = 1500  # as many as the tracker asks for
_PIXEL_SIGMA = 1.0
_RATIO = 0.8
_ROW_TOLERANCE = 2.0
# Smaller disparities, in pixels, carry no depth, and the pose takes landmarks as exact.
_MIN_DISPARITY = 1.0
_FORWARD_BACKWARD = 1.0
_REPROJECTION = 2.0
_RANSAC_ROUNDS, _CONFIDENCE = 500, 0.999
_MIN_INLIERS = 15
# Insert a keyframe when the inliers fall below this share of those of the first view after the last keyframe.
_KEYFRAME_RATIO = 0.6


@dataclass(frozen=True, slots=True)
class PnpPose:
    """A pose relative to known points.

    Attributes:
        T_key_camera: (4, 4) camera in the frame of the points.
        covariance: (6, 6) in the camera's own frame, translation first, metres and radians.
        inliers: (M,) bool, points that agree.
    """

    T_key_camera: np.ndarray
    covariance: np.ndarray
    inliers: np.ndarray


class Matcher(Protocol):
    """Finds the points of a keyframe again; a view is whatever `look` makes of a rectified pair."""

    def look(self, left: np.ndarray, right: np.ndarray) -> Any:
        """A view."""

    def start(self, view: Any) -> None:
        """Takes a view as the keyframe."""

    def find(self, view: Any) -> tuple[np.ndarray, np.ndarray]:
        """Points (M, 3) of the keyframe in its frame, metres, and their pixels (M, 2) in the view."""

    def keep(self, inliers: np.ndarray) -> None:
        """Is told which (M,) of the points found last were right."""


def pose_from_points(points: np.ndarray, pixels: np.ndarray, camera: RectifiedStereo) -> PnpPose | None:
    """PnP by RANSAC, refined on its inliers, which are chosen anew and refined once more.

    Args:
        points: (M, 3) metres; pixels: (M, 2) where the left eye sees them.
        camera: of the pixels.
    Returns:
        None when fewer than 15 points agree.
    """
    if len(points) < _MIN_INLIERS:
        return None
    points, pixels = points.astype(np.float64), pixels.astype(np.float64)
    # With flags for P3P the pose of all inliers would come from EPnP, which on far points is off by tens of pixels.
    found, turn, shift, index = cv2.solvePnPRansac(
        points,
        pixels,
        camera.matrix,
        None,
        iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=_REPROJECTION,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_ITERATIVE,
    )
    if not found or index is None:
        return None
    inliers = np.zeros(len(points), bool)
    inliers[index.ravel()] = True
    for last in (False, True):
        if inliers.sum() < _MIN_INLIERS:
            return None
        turn, shift = cv2.solvePnPRefineLM(points[inliers], pixels[inliers], camera.matrix, None, turn, shift)
        if not last:
            inliers = _agreeing(points, pixels, turn, shift, camera)
    T_camera_key = np.eye(4)
    T_camera_key[:3, :3], T_camera_key[:3, 3] = rotation_exp(turn.ravel()), shift.ravel()
    seen = points[inliers] @ T_camera_key[:3, :3].T + T_camera_key[:3, 3]
    information = _pose_information(seen, camera) / _PIXEL_SIGMA**2
    if not np.isfinite(information).all() or np.linalg.cond(information) > 1e15:
        return None
    return PnpPose(se3_inverse(T_camera_key), np.linalg.inv(information), inliers)


class PnpOdometry:
    """Poses relative to the points of a keyframe, chained.

    Args:
        camera: calibration of the raw images; they are rectified here.
        matcher: "sift" or "klt".
    """

    version = ""

    def __init__(self, camera: StereoCamera, matcher: str) -> None:
        self._rectifier = StereoRectifier(camera)
        self._camera = self._rectifier.rectified
        self._matcher: Matcher = SiftMatcher(self._camera) if matcher == "sift" else KltMatcher(self._camera)
        self._T_rectified_left = np.eye(4)
        self._T_rectified_left[:3, :3] = self._rectifier.R_rectified_left
        # Pose of the rectified left camera; the world is its first frame.
        self._key_pose, self._key_covariance = np.eye(4), np.zeros((6, 6))
        self._pose, self._covariance = np.eye(4), np.zeros((6, 6))
        self._step = np.eye(4)
        self._view: Any = None
        self._key_is_last = False
        self._reference: int | None = None  # inliers of the first view after the keyframe

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float = 0.0) -> PeerStep:
        """Takes one stereo pair, raw images (H, W) uint8; it knows no time. A lost pose is a guess."""
        view = self._matcher.look(*self._rectifier.rectify(left, right))
        if self._view is None:
            self._view = view
            self._start_keyframe(view)
            return self._report("starting", 0, 0)
        matches, fit = self._locate(view)
        if fit is None and not self._key_is_last:
            # The view before is nearer than the keyframe.
            self._start_keyframe(self._view)
            matches, fit = self._locate(view)
        self._view = view
        if fit is None:
            self._guess()
            self._start_keyframe(view)
            return self._report("lost", matches, 0)
        self._take(fit)
        inliers = int(fit.inliers.sum())
        self._matcher.keep(fit.inliers)
        self._key_is_last = False
        if self._reference is None:
            self._reference = inliers
        elif inliers < _KEYFRAME_RATIO * self._reference:
            self._start_keyframe(view)
        return self._report("tracking", matches, inliers)

    def close(self) -> None:
        """It needs no end."""

    def _locate(self, view: Any) -> tuple[int, PnpPose | None]:
        points, pixels = self._matcher.find(view)
        return len(points), pose_from_points(points, pixels, self._camera)

    def _take(self, fit: PnpPose) -> None:
        pose = self._key_pose @ fit.T_key_camera
        adjoint = se3_adjoint(se3_inverse(fit.T_key_camera))
        self._step = se3_inverse(self._pose) @ pose
        self._pose = pose
        self._covariance = adjoint @ self._key_covariance @ adjoint.T + fit.covariance

    def _guess(self) -> None:
        """Without a pose: the last step again, and as uncertain as it is long."""
        adjoint, step = se3_adjoint(se3_inverse(self._step)), se3_log(self._step)
        self._pose = self._pose @ self._step
        self._covariance = adjoint @ self._covariance @ adjoint.T + np.outer(step, step)

    def _start_keyframe(self, view: Any) -> None:
        """`view` has the last pose."""
        self._matcher.start(view)
        self._key_pose, self._key_covariance = self._pose, self._covariance
        self._key_is_last, self._reference = True, None

    def _report(self, status: str, matches: int, inliers: int) -> PeerStep:
        T = self._T_rectified_left
        adjoint = se3_adjoint(se3_inverse(T))
        covariance = adjoint @ self._covariance @ adjoint.T
        return PeerStep(se3_inverse(T) @ self._pose @ T, status, matches, inliers, covariance)


@dataclass(frozen=True, slots=True)
class _SiftView:
    right: np.ndarray
    pixels: np.ndarray
    descriptors: np.ndarray


class SiftMatcher:
    """SIFT by brute force with Lowe's ratio test; between the eyes only along rows."""

    def __init__(self, camera: RectifiedStereo) -> None:
        self._camera = camera
        self._sift = cv2.SIFT.create(nfeatures=_KEYPOINTS)
        self._brute_force = cv2.BFMatcher(cv2.NORM_L2)

    def look(self, left: np.ndarray, right: np.ndarray) -> _SiftView:
        """Features of the left image; those of the right one when it becomes a keyframe."""
        return _SiftView(right, *self._detect(left))

    def start(self, view: _SiftView) -> None:
        """Triangulates the keyframe."""
        pixels, descriptors = self._detect(view.right)
        shift = view.pixels[:, None] - pixels
        near = (np.abs(shift[..., 1]) <= _ROW_TOLERANCE) & (shift[..., 0] >= _MIN_DISPARITY)
        left, right = self._match(view.descriptors, descriptors, near)
        self._points = _triangulate(view.pixels[left], pixels[right], self._camera)
        self._descriptors = view.descriptors[left]

    def find(self, view: _SiftView) -> tuple[np.ndarray, np.ndarray]:
        """Points of the keyframe anywhere in the view."""
        key, now = self._match(self._descriptors, view.descriptors, None)
        return self._points[key], view.pixels[now]

    def keep(self, inliers: np.ndarray) -> None:
        """Every view is matched afresh."""

    def _detect(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        keypoints, descriptors = self._sift.detectAndCompute(image, None)
        if not keypoints:
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
        return np.array([keypoint.pt for keypoint in keypoints], np.float32), descriptors

    def _match(
        self, descriptors0: np.ndarray, descriptors1: np.ndarray, allowed: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows of 0 and of 1 whose second neighbour is clearly further; a row that is alone has none."""
        if not len(descriptors0) or not len(descriptors1):
            return np.zeros(0, int), np.zeros(0, int)
        mask = None if allowed is None else allowed.astype(np.uint8)
        pairs = [
            (found[0].queryIdx, found[0].trainIdx)
            for found in self._brute_force.knnMatch(descriptors0, descriptors1, 2, mask)
            if len(found) == 2 and found[0].distance < _RATIO * found[1].distance
        ]
        index = np.array(pairs, int).reshape(-1, 2)
        return index[:, 0], index[:, 1]


class KltMatcher:
    """Shi-Tomasi corners of a keyframe, followed from frame to frame by pyramidal Lucas-Kanade and back."""

    def __init__(self, camera: RectifiedStereo) -> None:
        self._camera = camera

    def look(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The pair itself."""
        return left, right

    def start(self, view: tuple[np.ndarray, np.ndarray]) -> None:
        """Finds corners and follows them into the right image."""
        left, right = view
        corners = cv2.goodFeaturesToTrack(left, _KEYPOINTS, 0.01, 8)
        pixels = np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)
        places, found = _follow(left, right, pixels)
        shift = pixels - places
        found &= (np.abs(shift[:, 1]) <= _ROW_TOLERANCE) & (shift[:, 0] >= _MIN_DISPARITY)
        self._points = _triangulate(pixels[found], places[found], self._camera)
        self._pixels, self._image = pixels[found], left

    def find(self, view: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The corners that are left, from where the last view had them."""
        places, found = _follow(self._image, view[0], self._pixels)
        self._found = self._points[found], places[found], view[0]
        return self._found[:2]

    def keep(self, inliers: np.ndarray) -> None:
        """Goes on with the inliers."""
        points, pixels, self._image = self._found
        self._points, self._pixels = points[inliers], pixels[inliers]


def _follow(image0: np.ndarray, image1: np.ndarray, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (M, 2) in image 1, and whether the way back ends where it began."""
    if not len(pixels):
        return pixels, np.zeros(0, bool)
    nothing: Any = None  # as a guess
    places, there, _ = cv2.calcOpticalFlowPyrLK(image0, image1, pixels, nothing)
    back, again, _ = cv2.calcOpticalFlowPyrLK(image1, image0, places, nothing)
    height, width = image1.shape
    inside = ((places >= 0) & (places <= (width - 1, height - 1))).all(axis=1)
    returned = np.linalg.norm(back - pixels, axis=1) <= _FORWARD_BACKWARD
    return places, there.ravel().astype(bool) & again.ravel().astype(bool) & inside & returned


def _triangulate(left: np.ndarray, right: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    left, right = left.astype(np.float64), right.astype(np.float64)
    return camera.triangulate(np.column_stack([left, left[:, 0] - right[:, 0]]))


def _agreeing(
    points: np.ndarray, pixels: np.ndarray, turn: np.ndarray, shift: np.ndarray, camera: RectifiedStereo
) -> np.ndarray:
    """(M,) bool: in front of the camera and seen where they should be."""
    seen = points @ rotation_exp(turn.ravel()).T + shift.ravel()
    in_front = seen[:, 2] > 0
    seen[~in_front] = 1.0
    error = np.linalg.norm(camera.project(seen)[:, :2] - pixels, axis=1)
    return np.asarray(in_front & (error <= _REPROJECTION))


def _pose_information(seen: np.ndarray, camera: RectifiedStereo) -> np.ndarray:
    """J^T J (6, 6) of the left pixels of points (M, 3) in the camera frame by the camera's pose, in its own frame."""
    x, y, z = seen.T
    zero = np.zeros_like(z)
    by_point = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=-1),
            np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=-1),
        ],
        axis=-2,
    )
    # A camera that moves by (rho, phi) sees a point p at p - rho + p x phi.
    by_pose = np.concatenate([np.broadcast_to(-np.eye(3), (len(seen), 3, 3)), skew(seen)], axis=-1)
    jacobian = (by_point @ by_pose).reshape(-1, 6)
    return np.asarray(jacobian.T @ jacobian)
