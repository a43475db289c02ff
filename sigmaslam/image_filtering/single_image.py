"""One image, freed of noise: the prior comes from the image itself, patch by patch."""

import cv2
import numpy as np

from sigmaslam.image_filtering.deblur import remove_blur
from sigmaslam.image_filtering.group_filter import filter_groups
from sigmaslam.image_filtering.noise import NoiseModel, mean_of_others, stuck_pixels
from sigmaslam.image_filtering.patch_filter import filter_patches

_IMPULSE_ROUNDS = 8
"""Rounds in which pixels that were not measured are guessed, from coarse to fine."""
_GROUP_ROUNDS = 2
"""Rounds of grouping, of which each takes the result of the one before as its pilot."""


def denoise_image(image: np.ndarray, noise: NoiseModel, thorough: bool = False) -> np.ndarray:
    """Bayesian estimate of what one image shows.

    Args:
        image: (H, W) uint8, or float in grey levels, which may leave 0 to 255; at least 32 x 32.
        noise: of its pixels, and blur of the lens.
        thorough: let groups of alike patches have priors of their own, which takes thirty times as long; not
            with a blur.
    Returns:
        (H, W) float32, in 0 to 255.
    Raises:
        ValueError: the image is smaller or no (H, W) array.
    """
    if image.ndim != 2 or min(image.shape) < 32:
        raise ValueError(f"the image has shape {image.shape}: give one (H, W) of 32 x 32 and more")
    measured = image.astype(np.float32)
    stuck = stuck_pixels(image, noise)
    if stuck.any():
        measured = _guess_missing(measured, stuck, noise)
    variance = noise.variance(cv2.GaussianBlur(measured, (0, 0), 2.0))
    if noise.blur > 0:
        sharp = remove_blur(measured, noise.blur, float(np.sqrt(variance.mean())))
        return np.asarray(np.clip(sharp, 0.0, 255.0))
    if float(variance.max()) <= 0:
        return np.asarray(np.clip(measured, 0.0, 255.0))
    estimate = filter_patches(measured, variance)
    if noise.gain > 0:
        variance = noise.variance(estimate)
        estimate = filter_patches(measured, variance)
    if thorough:
        for _ in range(_GROUP_ROUNDS):
            estimate = filter_groups(measured, variance, estimate)
    if noise.step > 0 and noise.sigma == 0 and noise.gain == 0:
        # The likelihood of a quantised value is zero outside its bin.
        inside = np.clip(estimate, measured - noise.step / 2, measured + noise.step / 2)
        estimate = np.where(stuck, estimate, inside)
    return np.asarray(np.clip(estimate, 0.0, 255.0), np.float32)


def _guess_missing(measured: np.ndarray, missing: np.ndarray, noise: NoiseModel) -> np.ndarray:
    """The image with its missing pixels filled in, by expectation and maximisation.

    A round takes the last guess for the missing pixels and the noise for that of all, and filters; the noise falls to
    that of the sensor. What was measured stays.
    """
    filled = np.where(missing, mean_of_others(measured, missing, 3), measured)
    lowest = max(float(np.sqrt(noise.variance(filled).mean())), 2.0)
    for sigma in np.geomspace(max(40.0, 2 * lowest), lowest, _IMPULSE_ROUNDS):
        guess = filter_patches(filled, np.full(filled.shape, sigma**2, np.float32))
        filled = np.where(missing, guess, measured)
    return np.asarray(filled, np.float32)
