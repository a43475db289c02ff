"""A Kalman filter for every pixel of a sequence, whose state moves along with what the pixel shows."""

from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from sigmaslam.image_filtering.noise import NoiseModel, estimate_noise, mean_of_others, stuck_pixels
from sigmaslam.image_filtering.patch_filter import filter_patches

_DRIFT = 2.0
"""Grey levels by which a point of a surface changes between frames, as light and view do."""
_FLOW_SIGMA = 0.3
"""Error of the optical flow, pixels, where it is right."""
# Windows in which innovations are compared with what they should be, from what is small to what is faint.
_WINDOWS = (5, 11)
# Sigmas up to which a window's statistic is chance.
_GATE = 1.5
# Frames that are filtered backwards at once, and later ones from which that begins: a state has settled after four.
_AT_ONCE, _LATER = 8, 4
# An image that varies by fewer grey levels shows a lens cap, or nothing, and says little of the noise.
_BLANK = 4.0
# Variance of what nothing is known of, grey levels squared.
_UNKNOWN = np.float32(1e6)


class SequenceFilter:
    """Filters the images of one camera, one after the other.

    The state of a pixel is its grey level, mean and variance. It moves by dense optical flow. Its process noise is the
    drift of light, what the flow's error makes of the image's gradient, and by how much the innovations around exceed
    what they should be: a pixel that shows something else than before starts anew. What noise is left, which the
    variance tells, the patches of the image take out; the state keeps it, so that no blur piles up.

    Args:
        noise: of the images; None to estimate it from the first one that shows something.

    Attributes:
        prior: mean and variance (H, W) of the state before the last frame was taken in.
    """

    prior: tuple[np.ndarray, np.ndarray]

    def __init__(self, noise: NoiseModel | None = None) -> None:
        self.noise, self._is_blank = noise, False  # the image that it is of
        self._flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        self._mean: np.ndarray | None = None
        self._variance: np.ndarray | None = None
        self._shown: np.ndarray | None = None

    @property
    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance (H, W) of the grey level of each pixel after the last frame, grey levels and squared.

        Raises:
            ValueError: there was no frame.
        """
        if self._mean is None or self._variance is None:
            raise ValueError("there is no state before the first frame: call step")
        return self._mean, self._variance

    def step(self, image: np.ndarray) -> np.ndarray:
        """The estimate of one frame from it and those before it.

        Args:
            image: (H, W) uint8 or float, of the same size as those before, at least 32 x 32.
        Returns:
            (H, W) float32, in 0 to 255.
        Raises:
            ValueError: the size is another one.
        """
        if self._mean is not None and image.shape != self._mean.shape:
            raise ValueError(f"the image is {image.shape[::-1]}, those before {self._mean.shape[::-1]} (width, height)")
        if self.noise is None or self._is_blank:
            self.noise, self._is_blank = estimate_noise(image), float(image.std()) < _BLANK
        stuck = stuck_pixels(image, self.noise)
        measured = image.astype(np.float32)
        if stuck.any():
            measured = np.where(stuck, mean_of_others(image, stuck, 3), measured)
        noise = self.noise.variance(cv2.GaussianBlur(measured, (0, 0), 2.0)) + np.float32(1e-3)
        # A pixel that is stuck measures nothing; its neighbours, less than they would.
        noise = np.where(stuck, np.float32(255.0**2), noise)
        if self._mean is None:
            self.prior = measured, np.full_like(measured, _UNKNOWN)
            self._mean, self._variance = measured, noise
        else:
            self.prior = self._predict(measured, noise)
            self._mean, self._variance = _combine(*self.prior, measured, noise)
        self._shown = self.show(self._mean, self._variance)
        return self._shown

    def show(self, mean: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """(H, W) float32, a state without the noise that its variance tells of."""
        assert self.noise is not None
        # What is stuck was filled in from neighbours: it is no worse than they are.
        left_over = np.minimum(variance, self.noise.variance(mean) + np.float32(1e-3))
        return np.asarray(np.clip(filter_patches(mean, left_over), 0.0, 255.0))

    def _predict(self, measured: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of the pixels' state before this frame is taken in."""
        assert self._mean is not None
        assert self._variance is not None
        assert self._shown is not None
        now = filter_patches(measured, np.minimum(noise, np.median(noise)))
        map_x, map_y = self._correspondence(now, self._shown)
        mean = cv2.remap(self._mean, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        variance = cv2.remap(self._variance, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        gradient_x, gradient_y = (cv2.Scharr(now, cv2.CV_32F, *axis, scale=1 / 32) for axis in ((1, 0), (0, 1)))
        variance = variance + _DRIFT**2 + _FLOW_SIGMA**2 * (gradient_x**2 + gradient_y**2)
        variance = variance + _excess(measured - mean, variance + noise, noise)
        height, width = measured.shape
        outside = (map_x < 0) | (map_y < 0) | (map_x > width - 1) | (map_y > height - 1)
        variance = np.where(outside, _UNKNOWN, variance)
        return mean, variance

    def _correspondence(self, now: np.ndarray, before: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the pixels of this frame were in the one before: (H, W) u and v."""
        # The whole range of grey levels, as a dark image has few.
        low, high = np.percentile(now, (1, 99))
        scale = 255.0 / max(float(high - low), 16.0)
        stretched = [np.clip((each - low) * scale, 0, 255).astype(np.uint8) for each in (now, before)]
        height, width = now.shape
        flow = self._flow.calc(stretched[0], stretched[1], np.zeros((height, width, 2), np.float32))
        columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        return columns + flow[..., 0], rows + flow[..., 1]


def filter_both_ways(images: Iterable[np.ndarray], forward: SequenceFilter) -> Iterator[np.ndarray]:
    """Estimates (H, W) of all frames from those before and those after them, up to twelve frames late.

    Args:
        images: in their order, as `SequenceFilter.step` takes them, whose errors it raises.
        forward: a new filter.
    """
    passed: list[tuple[np.ndarray, ...]] = []
    for image in images:
        forward.step(image)
        passed.append((image, *forward.state))
        if len(passed) == _AT_ONCE + _LATER:
            yield from _with_later(passed, forward)[:_AT_ONCE]
            del passed[:_AT_ONCE]
    yield from _with_later(passed, forward)


def _with_later(passed: list[tuple[np.ndarray, ...]], forward: SequenceFilter) -> list[np.ndarray]:
    """Estimates of frames, images with mean and variance by those before."""
    backward, estimates = SequenceFilter(forward.noise), []
    for image, mean, variance in reversed(passed):
        backward.step(image)
        estimates.append(backward.show(*_combine(mean, variance, *backward.prior)))
    return estimates[::-1]


def _combine(
    mean: np.ndarray, variance: np.ndarray, other: np.ndarray, other_variance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance (H, W) of what two independent sources say."""
    gain = variance / (variance + other_variance)
    return mean + gain * (other - mean), gain * other_variance


def _excess(innovation: np.ndarray, expected: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """(H, W) variance that innovations have beyond their own, from their mean square and their mean in windows.

    Args:
        innovation: (H, W) measured minus predicted.
        expected: (H, W) its variance.
        noise: (H, W) the part of it that is white.
    """
    most = np.zeros_like(innovation)
    for size in _WINDOWS:
        count = size * size
        typical = cv2.boxFilter(expected, -1, (size, size))
        square = cv2.boxFilter(innovation * innovation, -1, (size, size))
        mean = cv2.boxFilter(innovation, -1, (size, size))
        spread = square - typical * np.float32(1.0 + _GATE * np.sqrt(2.0 / count))
        # The mean of a window; errors of the prediction are alike in neighbours, those of the measurement are not.
        white = cv2.boxFilter(noise, -1, (size, size))
        # Where it is off, all pixels of the window say so: together they weigh as many times as much.
        bias = mean * mean - np.float32(_GATE**2) * (white * np.float32(2.0 / count) + np.float32(_DRIFT**2))
        most = np.maximum(most, np.maximum(spread, bias * np.float32(count)))
    return most
