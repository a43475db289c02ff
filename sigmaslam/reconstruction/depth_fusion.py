"""Depths of a keyframe, fused with those of the keyframes around it: one filter a pixel.

The state of a pixel is its inverse depth times focal length and baseline: the disparity that it has in truth, pixels.
Another keyframe measures it where the point appears there. The measurement is the difference of the disparity seen
there and the one predicted, both of which depend on the state and on the pose between the two keyframes; its update is
the scalar form of the Kalman filter in `sigmaslam_filters`, to which a test holds it.
"""

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.reconstruction.disparity import DisparityMap, kernels, pixel_grid, shrink, window_mean

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
# A coordinate of what is in no image.
_OUTSIDE = np.float32(-1e4)
# What a small step, translation before rotation, adds to normalised coordinates x, y and to the relative depth of a
# point (a, b, 1) of inverse depth q: linear in q, 1, a and b, the second axis.
_BY_STEP = np.zeros((3, 4, 6))
_BY_STEP[range(3), 0, range(3)] = 1.0
_BY_STEP[(0, 1, 1, 0, 2, 2), (1, 1, 2, 3, 3, 2), (4, 3, 5, 5, 3, 4)] = (1.0, -1.0, 1.0, -1.0, 1.0, -1.0)
# Confirmations that a point needs of the views that see its place, and of the nearer ones among them, where there are
# so many: what is wrong by far is seldom seen again from nearer, where a pixel is a smaller piece.
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
    def of(cls, image: np.ndarray, measured: DisparityMap) -> Self:
        """The view of a keyframe with such an image (H, W) uint8 and disparities."""
        if kernels is not None:
            sampled = kernels.sample_view(measured.disparity, measured.variance)
        else:
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
        is_seen_again: (H, W) bool, as many of those that see its place confirm it as should, and of the nearer ones.
    """

    disparity: np.ndarray
    variance: np.ndarray
    support: np.ndarray
    contradictions: np.ndarray
    is_seen_again: np.ndarray

    @property
    def is_confirmed(self) -> np.ndarray:
        """(H, W) bool: more keyframes confirm the point than contradict it. Where a body moved it is not."""
        return np.asarray(self.is_seen_again & (self.support > self.contradictions) & (self.disparity > 0.0))


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
        shared: of the variances this share is common to all of them.
    """
    shape = reference.disparity.shape
    known = np.flatnonzero(reference.disparity.ravel() > 0.0)
    u, v = (axis.ravel()[known] for axis in pixel_grid(*shape))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]).astype(np.float32)
    mean = reference.disparity.ravel()[known]
    common = np.float32(shared) * reference.variance.ravel()[known]
    variance = np.float32(1.0 - shared) * reference.variance.ravel()[known]
    support, contradictions, visible, nearer, nearer_support = np.zeros((5, len(known)), np.uint8)
    cost = np.zeros_like(mean)
    # Mean squared derivatives by u and v in the window of each pixel, grey values^2 / pixel^2.
    wide, step = image.astype(np.float32), np.array([[-0.5, 0.0, 0.5]], np.float32)
    texture = [window_mean(cv2.filter2D(wide, -1, each) ** 2).ravel()[known] for each in (step, step.T)]
    for view, pose, covariance in others:
        seen = _measure(view, pose, step_products(covariance), rays, mean, variance, camera)
        images = _compare(image, known, seen[0])
        states, before = (mean, variance, common, cost, support, contradictions), support
        is_visible = np.isfinite(seen[1])
        # Depth there over depth here.
        is_nearer = pose[2, :3].astype(np.float32) @ rays + np.float32(pose[2, 3] / camera.focal_baseline) * mean < 1.0
        mean, variance, cost, support, contradictions = _update(known, seen, *images, texture, shared, *states)
        visible, nearer = visible + is_visible, nearer + (is_visible & is_nearer)
        nearer_support = nearer_support + (support - before) * is_nearer
    enough, enough_nearer = np.minimum([visible, nearer], _MIN_SUPPORT)
    is_seen_again = (support >= enough) & (nearer_support >= enough_nearer)
    # Where the views differ by more than they should, or less, variances are scaled: the mean of the posterior of a
    # scale that has an inverse gamma distribution. That they agree says nothing of what they have in common.
    scale = (_FREEDOM + cost) / (_FREEDOM + support)
    fused = scale * variance + np.maximum(scale, np.float32(1.0)) * common
    return FusedDepth(
        _as_image(mean, known, shape, np.nan),
        _as_image(fused, known, shape, np.nan),
        _as_image(support, known, shape, 0),
        _as_image(contradictions, known, shape, 0),
        _as_image(is_seen_again, known, shape, False),
    )


def _update(
    known: np.ndarray,
    seen: np.ndarray,
    windows: list[np.ndarray],
    flow: list[np.ndarray],
    texture: list[np.ndarray],
    shared: float,
    *states: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Mean, variance, cost, support and contradictions (N,) after a view; `states` are those before, the third common.

    What moves along its own surface has the depth that is expected, and another texture. The variance of the difference
    is held against what noise, the resampling and an uncertain place make of the texture, scaled by the median pixel.
    """
    if kernels is not None:
        gates = shared, GATE, _GATE_2D, _FLOW_SCALE, _FLOW_VARIANCE
        return tuple(kernels.update(known, seen, windows, texture, flow, gates, _MEDIAN_STRIDE, _LEAST_SHARE, *states))
    mean, variance, common, cost, support, contradictions = states
    _, innovation, derivative, noise, by_pose, place_u, place_v = seen
    own = np.float32(1.0 - shared) * noise + by_pose
    # What is common does not cancel in the difference unless the views are alike: the gate allows for it.
    expected = derivative**2 * variance + own + np.float32(shared) * noise + common
    there = innovation**2 <= GATE * expected
    share, difference, square = (each.ravel()[known] for each in windows)
    share = np.maximum(share, np.float32(1e-3))
    place_u, place_v = place_u + _RESAMPLING, place_v + _RESAMPLING
    ratio = (square / share - (difference / share) ** 2) / (_ROUNDING + texture[0] * place_u + texture[1] * place_v)
    some = ratio[::_MEDIAN_STRIDE][np.isfinite(innovation[::_MEDIAN_STRIDE])]
    moved_u, moved_v = (_FLOW_SCALE * each.ravel()[known] for each in flow)
    rests = moved_u**2 / (place_u + _FLOW_VARIANCE) + moved_v**2 / (place_v + _FLOW_VARIANCE)
    agrees = there & (ratio <= GATE * (np.median(some) if len(some) else 0.0)) & (rests <= _GATE_2D)
    if np.count_nonzero(agrees) < _LEAST_SHARE * np.count_nonzero(there):
        # Most of the image moves against the pose: it is that of a moving body, and confirms nothing at rest.
        agrees[:] = False
    cost = cost + np.where(agrees, innovation**2 / expected, np.float32(0.0))
    contradictions = contradictions + np.where(there, ~agrees, innovation < 0.0)
    return *kalman_update(mean, variance, innovation, derivative, own, agrees), cost, support + agrees, contradictions


def kalman_update(
    mean: np.ndarray,
    variance: np.ndarray,
    innovation: np.ndarray,
    derivative: np.ndarray,
    noise: np.ndarray,
    agrees: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances (N,) of filters of one state, by one measurement each; where it does not agree, the priors.

    Args:
        mean, variance: (N,) of the priors.
        innovation: (N,) what was measured minus what was predicted.
        derivative: (N,) of the prediction by the state.
        noise: (N,) variance of the measurement.
        agrees: (N,) bool.
    """
    gain = derivative * variance / (derivative**2 * variance + noise)
    moved = np.where(agrees, mean + gain * innovation, mean)
    # Joseph's form in one state stays positive whatever the rounding.
    return moved, np.where(agrees, (1.0 - gain * derivative) ** 2 * variance + gain**2 * noise, variance)


def step_products(covariance: np.ndarray) -> np.ndarray:
    """(6, 10) float32 covariance of what `_BY_STEP` moves, xx to zz: factors of products of two of q, 1, a and b."""
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
) -> np.ndarray:
    """(7, N) grey value where a point appears in a view, or NaN; disparity there minus the predicted one, or NaN;
    derivative of the latter less the former by the state; variances of the disparity seen, of what the pose adds, and
    of the place u and v by state and pose, pixels squared."""
    fx, fy = np.float32(camera.fx), np.float32(camera.fy)
    focal_baseline = np.float32(camera.focal_baseline)
    # Point times inverse depth: the ray and what the step adds.
    R, shift = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32) / focal_baseline
    if kernels is not None:
        numbers = camera.fx, camera.fy, camera.cx, camera.cy, camera.focal_baseline, _MIN_DEPTH * camera.baseline
        step = np.r_[R.ravel(), shift]
        return np.asarray(kernels.measure(view.sampled, view.image, numbers, step, products, rays, state, variance))
    turned = R @ rays
    x, y, z = turned + shift[:, None] * state
    ahead = z * focal_baseline > _MIN_DEPTH * camera.baseline * state
    inverse = np.float32(1.0) / np.where(ahead, z, np.float32(np.inf))
    a, b = x * inverse, y * inverse
    u, v = np.where(ahead, fx * a + np.float32(camera.cx), _OUTSIDE), fy * b + np.float32(camera.cy)
    predicted = state * inverse
    disparity, noise, slope_u, slope_v, grey = _sample(np.dstack([view.sampled, view.image]), u, v)
    # By the state: of the predicted disparity, and of the one seen where the prediction moves to.
    moves_u, moves_v = fx * (shift[0] - a * shift[2]) * inverse, fy * (shift[1] - b * shift[2]) * inverse
    derivative = turned[2] * inverse**2 - slope_u * moves_u - slope_v * moves_v
    q, one = predicted / focal_baseline, np.ones_like(a)
    xx, xy, xz, yy, yz, zz = products @ np.stack([q * q, q, q * a, q * b, one, a, b, a * a, a * b, b * b])
    # The depth moves the place, too, and the slopes there the disparity: it changes by e x + f y + g z.
    e, f = fx * slope_u, fy * slope_v
    g = predicted - e * a - f * b
    by_pose = e * (e * xx + 2.0 * (f * xy + g * xz)) + f * (f * yy + 2.0 * g * yz) + g * g * zz
    place_u = moves_u**2 * variance + fx**2 * (xx + a * (a * zz - 2.0 * xz))
    place_v = moves_v**2 * variance + fy**2 * (yy + b * (b * zz - 2.0 * yz))
    return np.stack([grey, disparity - predicted, derivative, noise, by_pose, place_u, place_v])


def _compare(image: np.ndarray, known: np.ndarray, grey: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Means of weight, difference and its square in windows, and flow u and v, to a view with such grey values (N,)."""
    if kernels is not None:
        *windows, warped = kernels.compare(image, known, grey)
    else:
        there = np.isfinite(grey)
        pixels, grey = known[there], grey[there]
        (weight, difference), warped = np.zeros((2, *image.shape), np.float32), image.copy()
        weight.ravel()[pixels] = 1.0
        difference.ravel()[pixels] = image.ravel()[pixels] - grey
        warped.ravel()[pixels] = grey.clip(0, 255).astype(np.uint8)
        windows = [window_mean(each) for each in (weight, difference, difference**2)]
    # What the warp leaves of the motion: a window of a smooth texture looks alike after several pixels.
    small, moved = (shrink(each, _FLOW_SCALE) for each in (image, warped))
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    search.setFinestScale(0)
    flow = cv2.split(search.calc(small, moved, np.zeros((*small.shape, 2), np.float32)))
    return windows, [np.asarray(cv2.resize(each, image.shape[::-1])) for each in flow]


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(C, N) bilinear values of an image (H, W, C) at N pixels, NaN where one around is."""
    inside = (u >= 0) & (v >= 0) & (u < image.shape[1] - 1) & (v < image.shape[0] - 1)
    left, top = (np.where(inside, each, 0).astype(np.int64) for each in (u, v))
    right, low = (np.where(inside, each, np.float32(np.nan))[:, None] % 1 for each in (u, v))
    upper, lower = ((1 - right) * image[row, left] + right * image[row, left + 1] for row in (top, top + 1))
    return np.asarray(((1 - low) * upper + low * lower).T)


def _as_image(values: np.ndarray, known: np.ndarray, shape: tuple[int, ...], missing: float) -> np.ndarray:
    """Values of the known pixels as an image."""
    image = np.full(shape, missing, values.dtype)
    image.ravel()[known] = values
    return image
