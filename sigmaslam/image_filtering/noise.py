"""What a sensor adds to an image: Gaussian and shot noise, quantisation, pixels that are stuck; and how to tell."""

from dataclasses import dataclass

import cv2
import numpy as np

_BLOCK = 8
# Of the cosine coefficients (row i, column j) of a block these are all but noise in quiet blocks.
_HIGH = np.add.outer(np.arange(_BLOCK), np.arange(_BLOCK)) >= 9
# Share of the blocks that are taken for quiet: those with the least low-frequency energy.
_QUIET = 0.1
_MIN_QUIET = 6
_MAX_BINS = 8
# An image with fewer stuck pixels is left as it is: they may be its own.
_LEAST_IMPULSES = 1e-3
# Grey levels between a pixel and its neighbours' mean that make it unlike them.
_OUTLIER = 64.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Noise of a pixel whose true grey level is x: variance sigma^2 + gain x + step^2 / 12, and a chance to be stuck.

    Attributes:
        sigma: standard deviation of what does not depend on the signal, grey levels.
        gain: variance per grey level of the signal: shot noise; 255 / photons at white.
        step: grey levels between the levels of the quantiser; 0 where they are not to be told apart from sigma.
        impulses: probability that a pixel is black or white whatever it sees.
        blur: standard deviation of the Gaussian by which the lens blurred the image before all that, pixels.

    Raises:
        ValueError: a value is negative or not finite, or `impulses` is not below 1.
    """

    sigma: float
    gain: float = 0.0
    step: float = 0.0
    impulses: float = 0.0
    blur: float = 0.0

    def __post_init__(self) -> None:
        for name in ("sigma", "gain", "step", "impulses", "blur"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0):
                raise ValueError(f"{name} is {value}; give a finite number of 0 or more")
        if self.impulses >= 1:
            raise ValueError(f"impulses is {self.impulses}; it is a probability below 1")

    def variance(self, signal: np.ndarray) -> np.ndarray:
        """Variance of pixels, in the shape of the signal; float32."""
        return np.asarray(self.sigma**2 + self.step**2 / 12.0 + self.gain * np.maximum(signal, 0.0), np.float32)


def estimate_noise(image: np.ndarray) -> NoiseModel:
    """The noise of one image, from its quietest blocks at each brightness; blur is not found.

    The variance of the high cosine frequencies of the blocks with the least energy in the low ones is fitted by
    sigma^2 + gain x. Texture of the finest scale that is everywhere is taken for noise.

    Args:
        image: (H, W) grey levels, at least 32 x 32.
    Raises:
        ValueError: the image is smaller.
    """
    if min(image.shape) < 4 * _BLOCK:
        raise ValueError(f"the image is {image.shape[1]}x{image.shape[0]}: noise is estimated from 32 x 32 and more")
    step = quantiser_step(image)
    impulses = impulse_share(image)
    saturated = (image <= 0) | (image >= 255)
    measured = image.astype(np.float32)
    if impulses > 0:
        stuck = stuck_pixels(image, NoiseModel(0.0, impulses=impulses))
        measured, saturated = np.where(stuck, mean_of_others(image, stuck, 5), measured), saturated & ~stuck
    mean, low, high, whole = _block_energies(measured, saturated)
    high = high / (1.0 - impulses)  # pixels that were filled in have next to no noise
    if whole.sum() >= _MIN_QUIET:  # blocks with saturated pixels have less noise than there was
        mean, low, high = mean[whole], low[whole], high[whole]
    bins = int(np.clip(len(mean) // 60, 1, _MAX_BINS))
    order = np.argsort(mean)
    signal, variance, count = [], [], []
    for part in np.array_split(order, bins):
        quiet = part[np.argsort(low[part])[: max(_MIN_QUIET, round(_QUIET * len(part)))]]
        signal.append(mean[quiet].mean())
        variance.append(np.median(high[quiet]))
        count.append(len(quiet))
    constant, gain = _fit_line(np.array(signal), np.array(variance), np.array(count))
    return NoiseModel(float(np.sqrt(max(constant - step**2 / 12.0, 0.0))), gain, step, impulses)


def quantiser_step(image: np.ndarray) -> float:
    """Grey levels between those of a coarse quantiser of 1 to 7 bits, in (H, W) uint8; 0 without, as in float."""
    if image.dtype != np.uint8:
        return 0.0
    used = np.flatnonzero(np.bincount(image.ravel(), minlength=256))
    for bits in range(1, 8):
        steps = 2**bits - 1
        if np.isin(used, np.rint(np.arange(steps + 1) * 255.0 / steps)).all():
            return 255.0 / steps
    return 0.0


def impulse_share(image: np.ndarray) -> float:
    """Share of pixels that are stuck at black or white, alike often; 0 where there is no sign of any.

    Pixels that are unlike their neighbours are stuck if they lie at the very ends of the scale, and next to none lie
    near them: noise that saturates, and points of light, have values near the ends as well.
    """
    difference = np.abs(image - mean_of_others(image, (image <= 0) | (image >= 255), 5))
    outlier = difference > _OUTLIER
    black, white = (float((outlier & (image == end)).mean()) for end in (0, 255))
    near = float((outlier & (((image > 0) & (image < 16)) | ((image > 239) & (image < 255)))).mean())
    share = black + white
    balanced = min(black, white) > 0.25 * max(black, white)
    if not balanced or share < max(_LEAST_IMPULSES, 4 * near):
        return 0.0
    # One end stands out where neighbours are at the other one alone: what is counted there holds for both.
    signal = mean_of_others(image, outlier, 5)
    seen = float(((signal > _OUTLIER).mean() + (signal < 255 - _OUTLIER).mean()) / 2)
    return min(share / max(seen, 0.5), 0.95)


def stuck_pixels(image: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """(H, W) bool: pixels at 0 or 255 that are more probably stuck than right.

    What they would be if they were right is a Gaussian about the mean of their neighbours, with the spread of those.
    Where most of a window is at the same end the scene is saturated there.
    """
    black, white = image <= 0, image >= 255
    at_end = black | white
    if noise.impulses <= 0 or not at_end.any():
        return np.zeros(image.shape, bool)
    mean = mean_of_others(image, at_end, 5)
    spread = mean_of_others((image - mean) ** 2, at_end, 5) + noise.variance(mean) + 1.0
    log_right = -0.5 * ((image - mean) ** 2 / spread + np.log(2 * np.pi * spread)) + np.log1p(-noise.impulses)
    saturated = np.zeros(image.shape, bool)
    for end in (black, white):
        saturated |= end & (cv2.boxFilter(end.astype(np.float32), -1, (5, 5)) > 0.5 * (1.0 + noise.impulses))
    return np.asarray(at_end & ~saturated & (np.log(0.5 * noise.impulses) > log_right))


def mean_of_others(image: np.ndarray, left_out: np.ndarray, size: int) -> np.ndarray:
    """(H, W) float32 mean of the pixels in a window that are not left out; the image's own mean where all are."""
    kept = (~left_out).astype(np.float32)
    total = cv2.boxFilter(image.astype(np.float32) * kept, -1, (size, size), normalize=False)
    count = cv2.boxFilter(kept, -1, (size, size), normalize=False)
    overall = float((image * kept).sum() / max(float(kept.sum()), 1.0))
    return np.asarray(np.where(count > 0.5, total / np.maximum(count, 1.0), overall), np.float32)


def _block_energies(image: np.ndarray, saturated: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Of blocks (B,): mean, energy of low frequencies, variance of high ones, and whether no pixel is saturated."""
    blocks, whole = _cut(image), np.asarray(~_cut(saturated).any(axis=(1, 2)))
    line = cv2.dct(np.eye(_BLOCK), flags=cv2.DCT_ROWS).T.astype(np.float32)
    coefficients = line @ blocks @ line.T
    low = ~_HIGH
    low[0, 0] = False
    high = (coefficients[:, _HIGH] ** 2).mean(axis=1)
    return blocks.mean(axis=(1, 2)), (coefficients[:, low] ** 2).mean(axis=1), high, whole


def _cut(image: np.ndarray) -> np.ndarray:
    """(B, 8, 8) blocks side by side."""
    height, width = (n // _BLOCK * _BLOCK for n in image.shape)
    blocks = image[:height, :width].reshape(height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK)
    return blocks.swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)


def _fit_line(signal: np.ndarray, variance: np.ndarray, count: np.ndarray) -> tuple[float, float]:
    """Constant and slope, neither negative, of variances whose errors are in proportion to themselves."""
    weight = np.sqrt(count) / np.maximum(variance, 1e-3)
    if np.ptp(signal) > 1.0:
        design = np.column_stack([np.ones_like(signal), signal])
        constant, slope = np.linalg.lstsq(design * weight[:, None], variance * weight, rcond=None)[0]
        if constant >= 0 and slope >= 0:
            return float(constant), float(slope)
        if constant < 0:
            # Through the origin.
            return 0.0, float((weight**2 * signal * variance).sum() / (weight**2 * signal**2).sum())
    return float((weight**2 * variance).sum() / (weight**2).sum()), 0.0
