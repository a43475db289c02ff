"""What the patches of a match say of it: how well they agree, and how sharply that fixes the place."""

from dataclasses import dataclass

import numpy as np

from sigmaslam.frontend.patch_kernels import Images, examine, invert_maps
from sigmaslam.table import Table

# Of a patch in samples, and of its Gaussian window in radii: those that the verifiers were trained on.
_RADIUS, _TAPER = 5, 0.6
# Variance of grey values that a flat patch is taken to have.
_MIN_VARIANCE = 1.0


@dataclass(frozen=True, slots=True)
class Evidence(Table):
    """Of each match, from patches of 11 x 11 samples, a pixel of the coarser image apart.

    Attributes:
        correlation: (M,) in [-1, 1], normalised, window-weighted.
        contrast0, contrast1: (M,) standard deviation of the patches' grey values.
        sharpness: (M, 2) mean squared gradient of the patches along `axes` over their variance, the larger first,
            1 / pixels squared of image 1.
        axes: (M, 2, 2) unit vectors in image 1 as columns: the first across the strongest edge, the second along it.
        spacing: (M,) of the samples in pixels of image 1.
        zoom: (M,) scale of image 1 over image 0 around the match.
    """

    correlation: np.ndarray
    contrast0: np.ndarray
    contrast1: np.ndarray
    sharpness: np.ndarray
    axes: np.ndarray
    spacing: np.ndarray
    zoom: np.ndarray


def examine_patches(
    image0: Images,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    A: np.ndarray | None = None,
    source: np.ndarray | None = None,
) -> Evidence:
    """Compares the patches around matched points.

    Args:
        image0, image1: (H, W) uint8; of image 0 there may be several.
        points0, points1: (M, 2) pixels.
        A: (M, 2, 2), the affine map of image 0 to image 1 around each match; None, or entries that no surface shows
            (mirrored, or a zoom beyond 5), stand for the identity.
        source: (M,) which of the images 0 each match comes from; None: there is one.
    """
    count = len(points0)
    zoom, back = np.ones(count), np.tile(np.eye(2), (count, 1, 1))
    if A is not None:
        determinant, back = invert_maps(A)
        zoom = np.sqrt(np.nan_to_num(determinant, nan=1.0))
    # The finer image is smoothed as the coarser one's pixels do it.
    half_octaves = np.round(2.0 * np.log2(zoom)).astype(np.int32)
    spacing = np.maximum(1.0, 2.0 ** (0.5 * half_octaves))
    found = examine(image0, image1, points0, points1, back, half_octaves, _RADIUS, _TAPER, _MIN_VARIANCE, source)
    correlation, variance0, variance1 = found[:, :3].T
    uu, uv, vv = found[:, 3:].T / spacing**2
    middle, half = 0.5 * (uu + vv), np.hypot(0.5 * (uu - vv), uv)
    angle = 0.5 * np.arctan2(2.0 * uv, uu - vv)
    cosine, sine = np.cos(angle), np.sin(angle)
    axes = np.stack([cosine, -sine, sine, cosine], axis=1).reshape(-1, 2, 2)
    sharpness = np.stack([middle + half, np.maximum(middle - half, 0.0)], axis=1)
    return Evidence(correlation, np.sqrt(variance0), np.sqrt(variance1), sharpness, axes, spacing, zoom)
