"""The image before a lens that is out of focus blurred it: maximum a posteriori with the patches' prior."""

import numpy as np

from sigmaslam.image_filtering.patch_filter import filter_patches

# Rounds, from a prior as loose as the first figure (grey levels) to one as tight as the noise, and the weight of the
# prior: Zhang et al., "Plug-and-play image restoration with deep denoiser prior", PAMI 2021, of which they are.
_ROUNDS, _LOOSEST, _PRIOR_WEIGHT = 8, 49.0, 0.23
# Grey levels: what rounding to 8 bits and a blur that is not quite Gaussian leave, whatever the sensor's noise.
_LEAST_SIGMA = 1.0


def remove_blur(image: np.ndarray, blur: float, sigma: float) -> np.ndarray:
    """MAP estimate of the image that a Gaussian blur and white noise made this one of.

    Half-quadratic splitting: in turn the image that fits what was measured and a guess (in closed form by Fourier's
    transform), and the guess that the patches' prior makes of it, as of noise that falls round by round.

    Args:
        image: (H, W) grey levels, at least 32 x 32.
        blur: standard deviation of the blur, pixels.
        sigma: of the noise that came after it, grey levels.
    Returns:
        (H, W) float32.
    """
    height, width = image.shape
    sigma = max(sigma, _LEAST_SIGMA)
    # Beyond its border the image is its own mirror image.
    response = np.outer(_response(2 * height, blur), _response(2 * width, blur)[: width + 1])
    measured = response * np.fft.rfft2(_mirrored(image))
    guess = image.astype(np.float32)
    for level in np.geomspace(max(_LOOSEST, 2.0 * sigma), sigma, _ROUNDS).tolist():
        weight = _PRIOR_WEIGHT * sigma**2 / level**2
        spectrum = (measured + weight * np.fft.rfft2(_mirrored(guess))) / (response**2 + weight)
        fitted = np.fft.irfft2(spectrum, s=(2 * height, 2 * width))[:height, :width]
        guess = filter_patches(fitted, np.full(image.shape, level**2, np.float32))
    return guess


def _response(size: int, blur: float) -> np.ndarray:
    """(size,) what a Gaussian blur leaves of the frequencies of Fourier's transform."""
    return np.asarray(np.exp(-2.0 * (np.pi * blur * np.fft.fftfreq(size)) ** 2))


def _mirrored(image: np.ndarray) -> np.ndarray:
    return np.block([[image, image[:, ::-1]], [image[::-1], image[::-1, ::-1]]])
