"""Depths of a keyframe, fused with those of the keyframes around it: one filter a pixel.

The state of a pixel is its inverse depth times focal length and baseline: the disparity that it has in truth, pixels.
Another keyframe measures it where the point appears there. The measurement is the difference of the disparity seen
there and the one predicted, both of which depend on the state and on the pose between the two keyframes; its update is
the scalar form of the Kalman filter in `sigmaslam_filters`, to which a test holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.reconstruction.disparity import DisparityMap, pixel_grid, shrink, window_mean
from sigmaslam.table import Table

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
# Where images are compared: variance of what resampling moves them by, pixels squared, and of the rounding of two grey
# values.
_RESAMPLING, _ROUNDING = np.float32(1.0 / 12.0), np.float32(1.0 / 6.0)
# One of so many pixels is enough for a median.
_MEDIAN_STRIDE = 8
# Variance of each component of dense optical flow, pixels squared, of images so many times smaller, and 99 % of
# chi-square with two degrees of freedom.
_FLOW_VARIANCE, _FLOW_SCALE, _GATE_2D = np.float32(0.3**2), 4, 9.21
# Of the pixels whose depth is as expected, at least this share must also be where the pose says.
_LEAST_SHARE = 0.5
# Pixels that are measured at a time: arrays of them stay in the cache of a core.
_PART = 16384
# A coordinate of what is in no image.
_OUTSIDE = np.float32(-1e4)
# What a small step, translation before rotation, adds to normalised coordinates x, y and to the relative depth of a
# point (a, b, 1) of inverse depth q: linear in q, 1, a and b, the second axis.
_BY_STEP = np.zeros((3, 4, 6))
_BY_STEP[range(3), 0, range(3)] = 1.0
_BY_STEP[(0, 1, 1, 0, 2, 2), (1, 1, 2, 3, 3, 2), (4, 3, 5, 5, 3, 4)] = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
# Confirmations that a point needs where there are so many other views.
_MIN_SUPPORT = 2


@dataclass(frozen=True, slots=True)
class DepthView:
    """A keyframe as others are measured by it.

    Attributes:
        image: (H, W) float32 rectified left image.
        measured: disparities with the disparity offset taken off.
        sampled: (H, W, 4) float32 disparity, its variance, and its derivatives by u and v, zero where there are none.
    """

    image: np.ndarray
    measured: DisparityMap
    sampled: np.ndarray

    @classmethod
    def of(cls, image: np.ndarray, measured: DisparityMap) -> DepthView:
        """The view of a keyframe with such an image (H, W) uint8 and disparities."""
        sampled = cv2.merge([measured.disparity, measured.variance, *disparity_slope(measured.disparity)])
        return cls(image.astype(np.float32), measured, np.asarray(sampled))


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


def disparity_slope(disparity: np.ndarray) -> list[np.ndarray]:
    """Slopes (H, W) by u and v, least squares over the known pixels of a window, which must be of one surface."""
    radius = _SLOPE_RADIUS
    known = np.isfinite(disparity)
    weight, value = known.astype(np.float32), np.where(known, disparity, np.float32(0.0))
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
        slopes.append(np.where(known & (np.abs(slope) < 1.0), slope, np.float32(0.0)))
    return slopes


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
    texture = [each.ravel()[known] for each in _texture(image.astype(np.float32))]
    parts = [slice(first, first + _PART) for first in range(0, max(len(known), 1), _PART)]
    for view, pose, covariance in others:
        step = pose, step_products(covariance)
        seen = _Seen.concatenate([_measure(view, *step, rays[:, at], mean[at], variance[at], camera) for at in parts])
        noise = np.float32(1.0 - shared) * seen.noise + seen.pose
        # What is common does not cancel in the difference unless the views are alike: the gate allows for it.
        expected = seen.derivative**2 * variance + noise + np.float32(shared) * seen.noise + common
        squared = seen.innovation**2
        there = squared <= GATE * expected
        agrees = there & _looks_alike(image, texture, seen, known)
        if np.count_nonzero(agrees) < _LEAST_SHARE * np.count_nonzero(there):
            # Most of the image moves against the pose: it is that of a moving body, and confirms nothing at rest.
            agrees[:] = False
        cost += np.where(agrees, squared / expected, np.float32(0.0))
        support += agrees
        contradictions += np.where(there, ~agrees, seen.innovation < 0.0)
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
class _Seen(Table):
    """A measurement of N pixels by another view, with an innovation of NaN where no disparity is known there.

    Attributes:
        grey: (N,) grey value where the point appears; NaN where it is not in the view.
        innovation: (N,) that disparity minus the predicted one, pixels.
        derivative: (N,) of the latter less the former by the state.
        noise, pose: (N,) variance of the disparity seen, and of what the pose between the views adds, pixels squared.
        place_u, place_v: (N,) variance of u and v by the state and the pose, pixels squared.
    """

    grey: np.ndarray
    innovation: np.ndarray
    derivative: np.ndarray
    noise: np.ndarray
    pose: np.ndarray
    place_u: np.ndarray
    place_v: np.ndarray


def step_products(covariance: np.ndarray) -> np.ndarray:
    """(6, 10) float32 covariance of what `_BY_STEP` moves, xx to zz: factors of each product of two of q, 1, a and b.

    Args:
        covariance: (6, 6) of the step.
    """
    factors = np.einsum("kmi,ij,lnj->klmn", _BY_STEP, covariance, _BY_STEP)[*np.triu_indices(3)]
    twice = factors + factors.swapaxes(1, 2)
    twice[:, range(4), range(4)] /= 2.0
    return np.asarray(twice[:, *np.triu_indices(4)], np.float32)


def _measure(
    view: DepthView,
    pose: np.ndarray,
    products: np.ndarray,
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
    inverse = np.float32(1.0) / np.where(ahead, z, np.float32(np.inf))
    a, b = x * inverse, y * inverse
    u = np.where(ahead, camera.fx * a + np.float32(camera.cx), _OUTSIDE)
    v = camera.fy * b + np.float32(camera.cy)
    predicted = state * inverse
    disparity, noise, slope_u, slope_v, grey = _sample((view.sampled, view.image), u, v)
    # By the state: of the predicted disparity, and of the one seen where the prediction moves to.
    moves_u = np.float32(camera.fx) * (shift[0] - a * shift[2]) * inverse
    moves_v = np.float32(camera.fy) * (shift[1] - b * shift[2]) * inverse
    derivative = turned[2] * inverse**2 - slope_u * moves_u - slope_v * moves_v
    by_pose, place_u, place_v = _pose_variances(products, a, b, predicted, slope_u, slope_v, camera)
    place_u, place_v = moves_u**2 * variance + place_u, moves_v**2 * variance + place_v
    return _Seen(grey, disparity - predicted, derivative, noise, by_pose, place_u, place_v)


def _pose_variances(
    products: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    disparity: np.ndarray,
    slope_u: np.ndarray,
    slope_v: np.ndarray,
    camera: RectifiedStereo,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Variances (N,) of an innovation and of the place u and v by the step, pixels squared.

    Args:
        products: (6, 10) as of `step_products`.
        a, b: (N,) normalised coordinates of the place.
        disparity: (N,) predicted there.
        slope_u, slope_v: (N,) of the disparities seen there.
        camera: the rectified pair.
    """
    q, one = disparity / np.float32(camera.focal_baseline), np.ones_like(a)
    xx, xy, xz, yy, yz, zz = products @ np.stack([q * q, q, q * a, q * b, one, a, b, a * a, a * b, b * b])
    # The depth moves the place, too, and the slopes there the disparity: it changes by e x + f y + g z.
    e, f = np.float32(camera.fx) * slope_u, np.float32(camera.fy) * slope_v
    g = disparity - e * a - f * b
    innovation = e * (e * xx + 2.0 * (f * xy + g * xz)) + f * (f * yy + 2.0 * g * yz) + g * g * zz
    place_u = np.float32(camera.fx**2) * (xx + a * (a * zz - 2.0 * xz))
    place_v = np.float32(camera.fy**2) * (yy + b * (b * zz - 2.0 * yz))
    return innovation, place_u, place_v


def _looks_alike(image: np.ndarray, texture: list[np.ndarray], seen: _Seen, known: np.ndarray) -> np.ndarray:
    """(N,) bool, measured pixels whose windows show the same where the points appear in the other image.

    What moves along its own surface has the depth that is expected, and another texture. The variance of the difference
    is held against what noise, the resampling and an uncertain place make of the texture, scaled by the median pixel.

    Args:
        image: (H, W) uint8 of the reference.
        texture: (N,) each, as of `_texture`.
        seen: of the N points.
        known: (N,) their flat indices in the reference.
    """
    there = np.isfinite(seen.grey)
    pixels, grey = known[there], seen.grey[there]
    weight, difference = np.zeros((2, *image.shape), np.float32)
    weight.ravel()[pixels] = 1.0
    difference.ravel()[pixels] = image.ravel()[pixels] - grey
    share, mean, square = (window_mean(each) for each in (weight, difference, difference**2))
    share = np.maximum(share, np.float32(1e-3))
    place_u, place_v = seen.place_u + _RESAMPLING, seen.place_v + _RESAMPLING
    ratio = (square / share - (mean / share) ** 2).ravel()[known]
    ratio /= _ROUNDING + texture[0] * place_u + texture[1] * place_v
    some = ratio[::_MEDIAN_STRIDE][np.isfinite(seen.innovation[::_MEDIAN_STRIDE])]
    alike = ratio <= GATE * (np.median(some) if len(some) else 0.0)
    # What the warp leaves of the motion: a window of a smooth texture looks alike after several pixels.
    warped = image.copy()
    warped.ravel()[pixels] = grey.clip(0, 255).astype(np.uint8)
    small, moved = (shrink(each, _FLOW_SCALE) for each in (image, warped))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    search.setFinestScale(0)
    flow = cv2.split(search.calc(small, moved, np.zeros((*small.shape, 2), np.float32)))
    moved_u, moved_v = (_FLOW_SCALE * cv2.resize(each, image.shape[::-1]).ravel()[known] for each in flow)
    rests = moved_u**2 / (place_u + _FLOW_VARIANCE) + moved_v**2 / (place_v + _FLOW_VARIANCE)
    return np.asarray(alike & (rests <= _GATE_2D))


def _texture(image: np.ndarray) -> np.ndarray:
    """Mean squared derivatives by u and v in the window of each pixel, (2, H, W), grey values^2 / pixel^2."""
    step = np.array([[-0.5, 0.0, 0.5]], np.float32)
    return np.stack([window_mean(cv2.filter2D(image, -1, kernel) ** 2) for kernel in (step, step.T)])


def _sample(images: Sequence[np.ndarray], u: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
    """Bilinear values of images (H, W) or (H, W, C) at N pixels, NaN where one around is; (N,) of each channel."""
    # OpenCV takes maps of at most 32767 columns, and none without a row.
    columns = 1024
    rows = max(-(-len(u) // columns), 1)
    maps = np.full((2, rows * columns), _OUTSIDE, np.float32)
    maps[0, : len(u)], maps[1, : len(u)] = u, v
    map_u, map_v = maps.reshape(2, rows, columns)
    sampled = []
    for image in images:
        found = cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR, borderValue=(np.nan,) * 4)
        sampled += [each.ravel()[: len(u)] for each in cv2.split(found)]
    return sampled


def _spread(values: np.ndarray, known: np.ndarray, shape: tuple[int, ...], missing: float) -> np.ndarray:
    """Values of the known pixels as an image."""
    image = np.full(shape, missing, values.dtype)
    image.ravel()[known] = values
    return image
