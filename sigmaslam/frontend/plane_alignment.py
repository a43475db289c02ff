"""Matches refined as planes see them: patches warped by the surface's slope and the motion of the camera.

Between two views a patch is not only shifted. Approached, it grows; the road, seen at a grazing angle, grows more at
its near side. Lucas-Kanade over a shift takes the average of that for the keypoint's motion: errors that are alike in
all views, and alike for all patches of one surface, so that many matches do not average them out.
"""

from dataclasses import replace

import numpy as np

from sigmaslam.frontend.affine_alignment import align_patches
from sigmaslam.frontend.knn import nearest_points
from sigmaslam.frontend.lucas_kanade import refine
from sigmaslam.frontend.patch_kernels import compiled
from sigmaslam.frontend.types import PatchMaps, Refinement
from sigmaslam.geometry.camera import RectifiedStereo

# With 15 pixels in place of 11 streets are 1.1 times worse (docs/notebook, following).
_RADIUS = 5
# Patches come from where shifted ones agree: the first steps do most of the way (docs/notebook, following).
_ITERATIONS = 3
# A window that hardly falls off: with less of a patch a still image drifts by its noise.
_TAPER = 1.0
# Longest move of a shifted patch, pixels.
_REACH = 2.0
# More know a large surface better, and reach over the edge of a small one: the worst tenth has 1.4 times the error with
# 24, the median 1.15 times with 12 (docs/notebook, following).
_NEIGHBOURS = 16
# Of a disparity about the plane through its neighbours, and of a slope beforehand: standard deviations, pixels, 1.
_ROUGH, _STEEP = 0.2, 0.5
# Scales of the robust weight, sigmas, fit by fit. They have come down after three; eight fits are no better.
_SCALES = (8.0, 4.8, 2.88, 2.0, 2.0)
# Of what is seen from elsewhere, over its depth in the keyframe.
_MIN_DEPTH = 1e-3


def disparity_slopes(points: np.ndarray, disparity: np.ndarray, wanted: np.ndarray | None = None) -> np.ndarray:
    """Gradients (N, 2) of the disparity around (N, 2) points, from their neighbours on the same surface.

    Args:
        points: pixels of the left image.
        disparity: (N,) there, NaN where there is none; the slope is zero there.
        wanted: (K,) ascending, of which points; it is zero at the others. None: of all.
    """
    slope = np.zeros((len(points), 2))
    known = np.flatnonzero(np.isfinite(disparity))
    if len(known) < 4:
        return slope
    points, disparity = points[known].astype(np.float64), disparity[known]
    chosen = np.arange(len(known)) if wanted is None else np.flatnonzero(np.isin(known, wanted))
    neighbours, kernels = min(_NEIGHBOURS, len(points) - 1), compiled()
    if kernels is not None:
        slope[known[chosen]] = kernels.fit_slopes(points, disparity, chosen, neighbours, _ROUGH, _STEEP, _SCALES)
        return slope
    near = nearest_points(points, points[chosen], neighbours + 1)[:, 1:]
    apart, rise = points[near] - points[chosen, None], disparity[near] - disparity[chosen, None]
    fitted = np.zeros((len(chosen), 2))
    for scale in _SCALES:
        rest = (rise - (apart @ fitted[..., None])[..., 0]) / _ROUGH
        # Geman-McClure: neighbours on another surface do not tilt this one.
        weighted = apart / ((1.0 + (rest / scale) ** 2) ** 2 * _ROUGH**2)[..., None]
        normal = weighted.transpose(0, 2, 1) @ apart + np.eye(2) / _STEEP**2
        fitted = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ rise[..., None])[..., 0]
    slope[known[chosen]] = fitted
    return slope


def plane_maps(camera: RectifiedStereo, measured: np.ndarray, slope: np.ndarray, T_view_key: np.ndarray) -> PatchMaps:
    """How patches of planes look from elsewhere: their homographies about the keypoints.

    Args:
        camera: the rectified pair.
        measured: (M, 3) (u, v, disparity) in the keyframe, the disparity without what the calibration adds.
        slope: (M, 2) gradients of the disparity there.
        T_view_key: (4, 4), or (M, 4, 4) of each.
    """
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    rotation, nearness = T_view_key[..., :3, :3], T_view_key[..., :3, 3] / (camera.fx * camera.baseline)
    ray = np.column_stack([(measured[:, :2] - centre) / focal, np.ones(len(measured))])
    # A point of inverse depth rho on a ray r is seen along R r + rho t, and rho is linear in the pixels of a plane.
    seen = (rotation @ ray[..., None])[..., 0] + measured[:, 2:] * nearness
    by_pixel = (rotation[..., :2] / focal) + nearness[..., None] * slope[:, None, :]
    depth = np.maximum(seen[:, 2:], _MIN_DEPTH)
    tilt = by_pixel[:, 2] / depth
    A = focal[:, None] * (by_pixel[:, :2] / depth[..., None] - (seen[:, :2] / depth)[..., None] * tilt[:, None, :])
    return PatchMaps(A, tilt)


def refine_on_planes(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, maps: PatchMaps
) -> Refinement:
    """Matched points moved to where the patches agree, those of image 0 warped by their maps.

    Args:
        image0, image1: (H, W) uint8.
        points0, points1: (M, 2) matched pixels.
        maps: of the M patches.
    """
    return _align(image0, image1, points0, refine(image0, image1, points0, points1), maps)


def refine_in_rows(
    left: np.ndarray, right: np.ndarray, points0: np.ndarray, points1: np.ndarray, reach: float = _REACH
) -> tuple[Refinement, np.ndarray]:
    """The same for the eyes of a rectified pair: how surfaces slope is known from the disparities themselves.

    The maps are near the identity and not handed on: the verifier judges such pairs as if they were shifted only.

    Args:
        left, right: (H, W) uint8.
        points0, points1: (M, 2) matched pixels.
        reach: longest move, pixels.
    Returns:
        The refined matches, and the slopes (M, 2) as of `disparity_slopes`.
    """
    shifted = refine(left, right, points0, points1, reach=reach)
    slope = disparity_slopes(points0, points0[:, 0] - shifted.places[:, 0])
    # The right eye sees u - disparity.
    A = np.tile(np.eye(2), (len(slope), 1, 1))
    A[:, 0] -= slope
    return replace(_align(left, right, points0, shifted, PatchMaps(A, np.zeros_like(slope))), A=None), slope


def _align(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, shifted: Refinement, maps: PatchMaps
) -> Refinement:
    """From where patches that are only shifted agree to where the warped ones do."""
    points = points0.astype(np.float64), shifted.places, maps.A, maps.tilt
    aligned = align_patches(image0, image1, *points, radius=_RADIUS, iterations=_ITERATIONS, taper=_TAPER)
    return Refinement(shifted.start, aligned.places, aligned.moved | shifted.moved, maps.A)
