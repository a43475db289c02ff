"""Two images and what is known to be true between them."""

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.geometry.se3 import skew

LONG_SIDE = 640


@dataclass(frozen=True, slots=True)
class Homography:
    """Both images show a plane, or come from one viewpoint.

    Attributes:
        H_1_0: (3, 3), takes pixels of image 0 to image 1.
    """

    H_1_0: np.ndarray

    def transfer(self, points0: np.ndarray) -> np.ndarray:
        """Places in image 1 of (N, 2) pixels of image 0; infinite where a point is behind the camera."""
        points1, behind = _apply(self.H_1_0, points0)
        return np.where(behind[:, None], np.inf, points1)


@dataclass(frozen=True, slots=True)
class Disparity:
    """Rectified images with dense disparity of the left one, which is image 0.

    Attributes:
        disparity: (H, W) u_left - u_right in pixels of the images as stored, NaN where unknown or occluded.
        S0, S1: (3, 3), take pixels of the images as stored to those of the resized left and right one.
    """

    disparity: np.ndarray
    S0: np.ndarray
    S1: np.ndarray

    def transfer(self, points0: np.ndarray) -> np.ndarray:
        """Places in image 1 of (N, 2) pixels of image 0; NaN where one of the four pixels around has no disparity,
        or where they lie on both sides of a depth edge (they differ by more than one pixel)."""
        stored, _ = _apply(np.linalg.inv(self.S0), points0)
        height, width = self.disparity.shape
        corner = np.floor(stored).astype(int)
        outside = (corner < 0).any(axis=1) | (corner[:, 0] >= width - 1) | (corner[:, 1] >= height - 1)
        u, v = np.where(outside[:, None], 0, corner).T
        around = np.stack([self.disparity[v + dv, u + du] for dv in (0, 1) for du in (0, 1)], axis=1)
        a, b = (stored - corner).T
        weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)
        disparity = (weights * around).sum(axis=1)
        disparity[outside | (np.ptp(around, axis=1) > 1.0)] = np.nan
        return _apply(self.S1, stored - np.stack([disparity, np.zeros_like(disparity)], axis=1))[0]


@dataclass(frozen=True, slots=True)
class SameRows:
    """Rectified images without disparity: matched points have the same row."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Two views of a rigid scene by one pinhole camera.

    Attributes:
        K: (3, 3) intrinsics of both images, pixels.
        T_1_0: (4, 4), takes points of camera 0 to camera 1, metres.
    """

    K: np.ndarray
    T_1_0: np.ndarray

    def epipolar_distance(self, points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
        """(N,) distance in pixels of (N, 2) `points1` from the epipolar lines of (N, 2) `points0`."""
        K_inverse = np.linalg.inv(self.K)
        F = K_inverse.T @ skew(self.T_1_0[:3, 3]) @ self.T_1_0[:3, :3] @ K_inverse
        lines = np.column_stack([points0, np.ones(len(points0))]) @ F.T
        residual = (np.column_stack([points1, np.ones(len(points1))]) * lines).sum(axis=1)
        return np.asarray(np.abs(residual) / np.maximum(np.hypot(lines[:, 0], lines[:, 1]), 1e-12))


Truth = Homography | Disparity | SameRows | Motion


@dataclass(frozen=True, slots=True)
class ImagePair:
    """Two images with the truth between them.

    Attributes:
        name: for messages.
        image0, image1: (H, W) uint8; the same array where several pairs share an image.
        truth: what relates them.
        part: part of the set that is averaged on its own, such as "gap1"; empty for the main part.
    """

    name: str
    image0: np.ndarray
    image1: np.ndarray
    truth: Truth
    part: str = ""


def resize(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """An (H, W) image shrunk to a long side of 640 pixels; smaller ones stay as they are.

    Returns:
        The resized image and (3, 3) S, which takes pixels of the given image to it (pixel centres are integers).
    """
    height, width = image.shape
    factor = min(1.0, LONG_SIDE / max(height, width))
    new_width, new_height = round(width * factor), round(height * factor)
    su, sv = new_width / width, new_height / height
    S = np.array([[su, 0.0, 0.5 * su - 0.5], [0.0, sv, 0.5 * sv - 0.5], [0.0, 0.0, 1.0]])
    if factor == 1.0:
        return image, S
    return cv2.resize(image, (new_width, new_height), interpolation=cv2.INTER_AREA), S


def _apply(H: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mapped points, and which of them are behind the camera."""
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    behind = mapped[:, 2] <= 0
    return mapped[:, :2] / np.where(behind, 1.0, mapped[:, 2])[:, None], behind
