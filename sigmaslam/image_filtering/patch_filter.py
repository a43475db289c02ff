"""Every overlapping patch of an image estimated in the basis of the cosine transform, and the estimates averaged."""

from functools import cache

import cv2
import numpy as np

SIZE = 8
"""Side of a patch, pixels."""
# A coefficient below so many sigmas is taken for noise; of Dabov et al., "Image denoising by sparse 3-D
# transform-domain collaborative filtering", 2007. It is the MAP under a spike at zero and a wide slab.
_SPIKE_SIGMAS = 2.7
# Rows of patches at a time, so that the coefficients stay in the cache.
_STRIP = 16
_STEP = 2
"""Pixels between neighbouring patches, in both directions: 16 patches see each pixel."""


def filter_patches(image: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """MAP estimate of an image: first with a sparse prior, then with the Gaussian one that the first result gives.

    The second prior of each coefficient is N(0, c^2), where c is the coefficient of the first estimate: empirical
    Bayes. Its posterior mean is Wiener's filter.

    Args:
        image: (H, W) grey levels, at least 8 x 8.
        variance: (H, W) of the noise of each pixel; it is averaged over a patch.
    Returns:
        (H, W) float32.
    """
    return _filter(image, variance, _filter(image, variance, None))


def _filter(image: np.ndarray, variance: np.ndarray, pilot: np.ndarray | None) -> np.ndarray:
    border = SIZE - 1
    padded = pad(image, border)
    pilot = None if pilot is None else pad(pilot, border)
    # Of the patch that begins at a pixel.
    noise = cv2.boxFilter(pad(variance, border), -1, (SIZE, SIZE), anchor=(0, 0), borderType=cv2.BORDER_REFLECT)
    basis = _cosines()
    height, width = padded.shape
    total, weights = np.zeros_like(padded), np.zeros_like(padded)
    columns = (width - border + _STEP - 1) // _STEP
    for top in range(0, height - border, _STEP * _STRIP):
        rows = min(_STRIP, (height - border - top + _STEP - 1) // _STEP)
        power = noise[_window(top, 0, rows, columns)].reshape(1, -1)
        coefficients = basis @ _patches(padded, top, rows, columns)
        if pilot is None:
            kept = (coefficients**2 > _SPIKE_SIGMAS**2 * power).astype(np.float32)
            kept[0] = 1.0
        else:
            prior = (basis @ _patches(pilot, top, rows, columns)) ** 2
            kept = prior / (prior + power)
        # Posterior variance of a patch over that of its noise, in all.
        left_over = np.einsum("kn,kn->n", kept, kept) if pilot is not None else kept.sum(axis=0)
        weight = 1.0 / (np.maximum(left_over, 1.0) * np.maximum(power[0], 1e-6))
        estimates = basis.T @ (coefficients * kept)
        estimates *= weight
        weight = weight.reshape(rows, columns)
        for k, estimate in enumerate(estimates.reshape(-1, rows, columns)):
            y, x = divmod(k, SIZE)
            window = _window(top + y, x, rows, columns)
            total[window] += estimate
            weights[window] += weight
    inner = slice(border, -border)
    return np.asarray(total[inner, inner] / weights[inner, inner])


def pad(image: np.ndarray, border: int) -> np.ndarray:
    """An image (H, W) as float32 with its mirror image beyond its border, so many pixels."""
    return np.asarray(
        cv2.copyMakeBorder(image.astype(np.float32), border, border, border, border, cv2.BORDER_REFLECT_101)
    )


def _patches(image: np.ndarray, top: int, rows: int, columns: int) -> np.ndarray:
    """(64, rows x columns) pixels of the patches that begin in some rows."""
    patches = np.empty((SIZE * SIZE, rows, columns), np.float32)
    for k in range(SIZE * SIZE):
        y, x = divmod(k, SIZE)
        patches[k] = image[_window(top + y, x, rows, columns)]
    return patches.reshape(SIZE * SIZE, -1)


def _window(top: int, left: int, rows: int, columns: int) -> tuple[slice, slice]:
    """One pixel of each patch of some rows of them."""
    return slice(top, top + _STEP * (rows - 1) + 1, _STEP), slice(left, left + _STEP * (columns - 1) + 1, _STEP)


@cache
def _cosines() -> np.ndarray:
    """(64, 64) orthonormal transform of a patch, row by row."""
    line = cv2.dct(np.eye(SIZE, dtype=np.float64), flags=cv2.DCT_ROWS).T
    return np.kron(line, line).astype(np.float32)
