"""Depths of a keyframe, fused with those of the keyframes around it: one filter a pixel.

The state of a pixel is its inverse depth times focal length and baseline: the disparity that it has in truth, pixels.
Another keyframe measures it where the point appears there. The measurement is the difference of the disparity seen
there and the one predicted, both of which depend on the state and on the pose between the two keyframes; its update is
the scalar form of the Kalman filter in `sigmaslam_filters`, to which a test holds it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.reconstruction.disparity import DisparityMap, pixel_grid

GATE = 6.635
"""99 % of chi-square with one degree of freedom: disparities that differ by more are of different surfaces."""
# Of the variance of a disparity this share is the same in all keyframes that see the point, as texture and window are.
# Raised by hand on the same renders as the variance, from 0.5 until the intervals on streets held nearly 90 %.
SHARED = 0.8
# Slopes of the disparity are of a plane fitted over so many pixels.
_SLOPE_RADIUS = 3
# Points nearer to another camera's plane than this share of the baseline are behind it for all purposes.
_MIN_DEPTH = 1e-2
# The variances themselves count as so many measurements of their scale.
_FREEDOM = np.float32(4.0)
# Windows in which images are compared: side, variance of what resampling moves them by, pixels squared, and of the
# rounding of two grey values.
_WINDOW, _RESAMPLING, _ROUNDING = 7, np.float32(1.0 / 12.0), np.float32(1.0 / 6.0)
# Variance of each component of dense optical flow, pixels squared, and 99 % of chi-square with two degrees of freedom.
_FLOW_VARIANCE, _GATE_2D = np.float32(0.3**2), 9.21
# Of the pixels whose depth is as expected, at least this share must also be where the pose says.
_LEAST_SHARE = 0.5
# Pixels whose derivatives by a pose are computed at a time.
_PART = 8192
# Confirmations that a point needs where there are so many other views.
_MIN_SUPPORT = 2


@dataclass(frozen=True, slots=True)
class DepthView:
    """A keyframe as others are measured by it.

    Attributes:
        image: (H, W) float32 rectified left image.
        measured: disparities with the disparity offset taken off.
        slope: (H, W, 2) float32 derivatives of the disparity by u and v; zero where there are none.
    """

    image: np.ndarray
    measured: DisparityMap
    slope: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, measured: DisparityMap) -> DepthView:
        """The view of a keyframe with such an image (H, W) uint8 and disparities."""
        return cls(image.astype(np.float32), measured, disparity_slope(measured.disparity))


@dataclass(frozen=True, slots=True)
class FusedDepth:
    """Depths of a keyframe after fusion.

    Attributes:
        disparity: (H, W) float32 inverse depth times focal length and baseline, pixels; NaN where there is none.
        variance: (H, W) float32 pixels squared, without the part of the disparity offset; NaN where there is none.
        support: (H, W) uint8 other keyframes that confirm it.
        contradictions: (H, W) uint8 other keyframes that see something behind it, in its direction, or another
            texture in its place.
        least_support: confirmations that a point needs.
    """

    disparity: np.ndarray
    variance: np.ndarray
    support: np.ndarray
    contradictions: np.ndarray
    least_support: int = 1

    @property
    def is_confirmed(self) -> np.ndarray:
        """(H, W) bool: more keyframes confirm the point than contradict it. Where a body moved it is not."""
        enough = (self.support >= self.least_support) & (self.support > self.contradictions)
        return np.asarray(enough & (self.disparity > 0.0))


def disparity_slope(disparity: np.ndarray) -> np.ndarray:
    """Slopes (H, W, 2) by least squares over the known pixels of a window, which must be of one surface."""
    radius = _SLOPE_RADIUS
    known = np.isfinite(disparity)
    weight, value = known.astype(np.float32), np.where(known, disparity, 0.0).astype(np.float32)
    steps = np.arange(-radius, radius + 1, dtype=np.float32)
    ones = np.ones_like(steps)

    def moment(image: np.ndarray, horizontal: np.ndarray, vertical: np.ndarray) -> np.ndarray:
        return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, horizontal, vertical, borderType=cv2.BORDER_CONSTANT))

    count, mean = np.maximum(moment(weight, ones, ones), 1.0), moment(value, ones, ones)
    slopes = []
    for horizontal, vertical in ((steps, ones), (ones, steps)):
        lever, product = moment(weight, horizontal, vertical), moment(value, horizontal, vertical)
        squared = moment(weight, horizontal**2, vertical**2) - lever**2 / count
        slope = (product - lever * mean / count) / np.maximum(squared, 1.0)
        slopes.append(np.where(known & (np.abs(slope) < 1.0), slope, 0.0))
    return np.stack(slopes, axis=-1).astype(np.float32)


def fuse_depth(
    image: np.ndarray,
    reference: DisparityMap,
    others: list[tuple[DepthView, np.ndarray, np.ndarray]],
    camera: RectifiedStereo,
    shared: float = SHARED,
) -> FusedDepth:
    """Fuses the disparities of a keyframe with those of others.

    Args:
        image: (H, W) uint8 rectified left image of the keyframe.
        reference: its disparities.
        others: of each other keyframe its view, T_other_reference (4, 4), and the covariance (6, 6) of that,
            perturbed from the left: translation (metres) before rotation (radians).
        camera: the rectified pair.
        shared: of the variances this share is common to all of them.
    """
    shape = reference.disparity.shape
    known = np.flatnonzero(reference.disparity.ravel() > 0.0)
    u, v = (axis.ravel()[known] for axis in pixel_grid(*shape))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]).astype(np.float32)
    mean = reference.disparity.ravel()[known]
    common = np.float32(shared) * reference.variance.ravel()[known]
    variance = np.float32(1.0 - shared) * reference.variance.ravel()[known]
    support, contradictions = np.zeros((2, len(known)), np.uint8)
    cost = np.zeros_like(mean)
    grey = image.astype(np.float32)
    texture = _texture(grey)
    for view, pose, covariance in others:
        seen = _measure(view, pose, covariance, rays, mean, variance, camera)
        noise = np.float32(1.0 - shared) * seen.noise + seen.pose
        # What is common does not cancel in the difference unless the views are alike: the gate allows for it.
        spread = seen.derivative**2 * variance + noise
        expected = spread + np.float32(shared) * seen.noise + common
        squared = seen.innovation**2
        there = squared <= GATE * expected
        agrees = there & _looks_alike(grey, texture, view.image, seen, known)
        if np.count_nonzero(agrees) < _LEAST_SHARE * np.count_nonzero(there):
            # Most of the image moves against the pose: it is that of a moving body, and confirms nothing at rest.
            agrees[:] = False
        cost += np.where(agrees, squared / expected, 0.0)
        support += agrees
        contradictions += (there & ~agrees) | ((squared > GATE * expected) & (seen.innovation < 0.0))
        mean, variance = kalman_update(mean, variance, seen.innovation, seen.derivative, noise, agrees)
    # Where the views differ by more than they should, or less, variances are scaled: the mean of the posterior of a
    # scale that has an inverse gamma distribution. That they agree says nothing of what they have in common.
    scale = (_FREEDOM + cost) / (_FREEDOM + support)
    fused = scale * variance + np.maximum(scale, np.float32(1.0)) * common
    return FusedDepth(
        _spread(mean, known, shape, np.nan),
        _spread(fused, known, shape, np.nan),
        _spread(support, known, shape, 0),
        _spread(contradictions, known, shape, 0),
        min(_MIN_SUPPORT, max(len(others), 1)),
    )


def kalman_update(
    mean: np.ndarray,
    variance: np.ndarray,
    innovation: np.ndarray,
    derivative: np.ndarray,
    noise: np.ndarray,
    agrees: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior of filters of one state each, by one measurement each; where it does not agree, the prior.

    Args:
        mean, variance: (N,) of the priors.
        innovation: (N,) what was measured minus what was predicted.
        derivative: (N,) of the prediction by the state.
        noise: (N,) variance of the measurement.
        agrees: (N,) bool.
    Returns:
        (N,) means and variances.
    """
    gain = derivative * variance / (derivative**2 * variance + noise)
    moved = np.where(agrees, mean + gain * innovation, mean)
    # Joseph's form in one state stays positive whatever the rounding.
    left = (1.0 - gain * derivative) ** 2 * variance + gain**2 * noise
    return moved, np.where(agrees, left, variance)


@dataclass(frozen=True, slots=True)
class _Seen:
    """A measurement of N pixels by another view; NaN where the point is not in it, or nothing is known there.

    Attributes:
        innovation: (N,) disparity seen there minus the predicted one, pixels.
        derivative: (N,) of the latter less the former by the state.
        noise, pose: (N,) variance of the disparity seen, and of what the pose between the views adds, pixels squared.
        u, v: (N,) where the point appears, pixels.
        place: (2, N) variance of u and v by the state and the pose, pixels squared.
    """

    innovation: np.ndarray
    derivative: np.ndarray
    noise: np.ndarray
    pose: np.ndarray
    u: np.ndarray
    v: np.ndarray
    place: np.ndarray


def _measure(
    view: DepthView,
    pose: np.ndarray,
    covariance: np.ndarray,
    rays: np.ndarray,
    state: np.ndarray,
    variance: np.ndarray,
    camera: RectifiedStereo,
) -> _Seen:
    focal_baseline = np.float32(camera.focal_baseline)
    R, t = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
    turned = R @ rays
    # Point times inverse depth: the ray and what the step adds.
    shift = t / focal_baseline
    x, y, z = turned + shift[:, None] * state
    ahead = z * focal_baseline > _MIN_DEPTH * camera.baseline * state
    inverse = np.where(ahead, 1.0, np.nan).astype(np.float32) / np.where(ahead, z, 1.0)
    a, b = x * inverse, y * inverse
    u, v = camera.fx * a + np.float32(camera.cx), camera.fy * b + np.float32(camera.cy)
    predicted = state * inverse
    disparity, noise = (_sample(image, u, v) for image in (view.measured.disparity, view.measured.variance))
    slope_u, slope_v = _sample(np.ascontiguousarray(view.slope), u, v).T
    # By the state: of the predicted disparity, and of the one seen where the prediction moves to.
    moves_u = np.float32(camera.fx) * (shift[0] - a * shift[2]) * inverse
    moves_v = np.float32(camera.fy) * (shift[1] - b * shift[2]) * inverse
    derivative = turned[2] * inverse**2 - slope_u * moves_u - slope_v * moves_v
    place = np.stack([moves_u**2 * variance, moves_v**2 * variance])
    values, vectors = np.linalg.eigh(covariance)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))).T.astype(np.float32)
    pose_variance = np.empty_like(state)
    for part in _parts(len(state)):
        by_pose, du, dv = _moved_by_pose(a[part], b[part], predicted[part], slope_u[part], slope_v[part], camera)
        pose_variance[part] = _squared_length(root @ by_pose)
        place[0, part] += _squared_length(root @ du)
        place[1, part] += _squared_length(root @ dv)
    return _Seen(disparity - predicted, derivative, noise, pose_variance, u, v, place)


def _moved_by_pose(
    a: np.ndarray,
    b: np.ndarray,
    disparity: np.ndarray,
    slope_u: np.ndarray,
    slope_v: np.ndarray,
    camera: RectifiedStereo,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives (6, N) of an innovation and of the place (u, v) by the step, translation before rotation.

    Args:
        a, b: (N,) normalised coordinates of the place.
        disparity: (N,) predicted there.
        slope_u, slope_v: (N,) of the disparities seen there.
        camera: the rectified pair.
    """
    inverse_depth = disparity / np.float32(camera.focal_baseline)
    none, product = np.zeros_like(a), a * b
    dz = np.stack([none, none, inverse_depth, b, -a, none])
    du = np.stack([inverse_depth, none, -a * inverse_depth, -product, 1.0 + a * a, -b])
    dv = np.stack([none, inverse_depth, -b * inverse_depth, -1.0 - b * b, product, a])
    du *= np.float32(camera.fx)
    dv *= np.float32(camera.fy)
    return disparity * dz + slope_u * du + slope_v * dv, du, dv


def _squared_length(vectors: np.ndarray) -> np.ndarray:
    """(N,) of the columns (K, N)."""
    return np.asarray(np.einsum("kn,kn->n", vectors, vectors))


def _parts(count: int) -> list[slice]:
    """Slices of so many pixels that temporary arrays of them stay in the cache of a core."""
    return [slice(first, first + _PART) for first in range(0, count, _PART)]


def _looks_alike(
    image: np.ndarray, texture: np.ndarray, other: np.ndarray, seen: _Seen, known: np.ndarray
) -> np.ndarray:
    """(N,) bool, pixels whose windows show the same where the points appear in the other image.

    What moves along its own surface has the depth that is expected, and another texture. The variance of the difference
    is held against what noise, the resampling and an uncertain place make of the texture, scaled by the median pixel.

    Args:
        image: (H, W) float32 of the reference.
        texture: (2, H, W) as of `_texture`.
        other: (H, W) float32.
        seen: of the N points.
        known: (N,) their flat indices in the reference.
    """
    shape = image.shape
    inside = np.isfinite(seen.u) & np.isfinite(seen.v)
    u, v = (_spread(np.where(inside, each, -1e4).astype(np.float32), known, shape, -1e4) for each in (seen.u, seen.v))
    warped = cv2.remap(other, u, v, cv2.INTER_LINEAR, borderValue=np.nan)
    there = np.isfinite(warped)
    weight = there.astype(np.float32)
    share = np.maximum(_mean(weight), 1e-3)
    difference = np.where(there, image - warped, 0.0).astype(np.float32)
    varies = (_mean(difference**2) / share - (_mean(difference) / share) ** 2).ravel()[known]
    place = np.where(np.isfinite(seen.place), seen.place, 0.0) + _RESAMPLING
    expected = _ROUNDING + (texture.reshape(2, -1)[:, known] * place).sum(axis=0)
    ratio = np.where(there.ravel()[known], varies / expected, np.inf)
    finite = ratio[np.isfinite(ratio)]
    alike = ratio <= GATE * (float(np.median(finite)) if len(finite) else 0.0)
    # What the warp leaves of the motion: a window of a smooth texture looks alike after several pixels.
    warped_grey = np.where(there, warped, image).clip(0, 255).astype(np.uint8)
    nothing = np.zeros((*shape, 2), np.float32)
    flow = _optical_flow().calc(image.astype(np.uint8), warped_grey, nothing).reshape(-1, 2)[known]
    rests = (flow.T**2 / (place + _FLOW_VARIANCE)).sum(axis=0) <= _GATE_2D
    return np.asarray(alike & rests)


def _optical_flow() -> cv2.DISOpticalFlow:
    """Dense flow between an image and the warped other one, which differ by little where all is at rest."""
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)


def _texture(image: np.ndarray) -> np.ndarray:
    """Mean squared derivatives by u and v in the window of each pixel, (2, H, W), grey values^2 / pixel^2."""
    step = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return np.stack([_mean(cv2.filter2D(image, -1, kernel) ** 2) for kernel in (step, step.T)])


def _mean(values: np.ndarray) -> np.ndarray:
    """Means over the window of each pixel."""
    return np.asarray(cv2.blur(values, (_WINDOW, _WINDOW)))


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear values of (H, W) or (H, W, C) at N pixels, NaN where one around is; (N,) or (N, C)."""
    # OpenCV takes maps of at most 32767 columns.
    columns = 1024
    rows = -(-len(u) // columns)
    maps = np.full((2, rows * columns), -1e4, np.float32)
    maps[:, : len(u)] = np.where(np.isfinite(u) & np.isfinite(v), [u, v], -1e4)
    map_u, map_v = maps.reshape(2, rows, columns)
    nothing = (np.nan,) * 4
    sampled = cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR, borderValue=nothing)
    return np.asarray(sampled.reshape(rows * columns, *image.shape[2:])[: len(u)])


def _spread(values: np.ndarray, known: np.ndarray, shape: tuple[int, ...], missing: float) -> np.ndarray:
    """Values of the known pixels as an image."""
    image = np.full(shape, missing, values.dtype)
    image.ravel()[known] = values
    return image
