"""Groups of alike patches with a Gaussian prior of their own.

Empirical Bayes after Lebrun, Buades and Morel, "A nonlocal Bayesian image denoising algorithm", 2013, second step.
"""

from itertools import product

import cv2
import numpy as np

from sigmaslam.image_filtering.patch_filter import pad

_SIZE = 7
"""Side of a patch, pixels."""
_REACH = 12
"""Alike patches are looked for so many pixels away, in each direction."""
_MEMBERS = 32
_STEP = 4
"""Pixels between the patches that gather groups."""
_CHUNK = 512


def filter_groups(image: np.ndarray, variance: np.ndarray, pilot: np.ndarray) -> np.ndarray:
    """Posterior mean of every patch under the Gaussian of the patches that are like it.

    Mean and covariance of a group are those of its patches in the pilot.

    Args:
        image: (H, W) grey levels.
        variance: (H, W) of the noise of each pixel; it is averaged over a group.
        pilot: (H, W) an estimate of the image.
    Returns:
        (H, W) float32.
    """
    border = _REACH + _SIZE
    padded, guide, noise = (pad(each, border) for each in (image, pilot, variance))
    height, width = guide.shape
    ys = _grid(border - _SIZE + 1, height - border)
    members = _alike(guide, ys, _grid(border - _SIZE + 1, width - border))
    noise = cv2.boxFilter(noise, -1, (_SIZE, _SIZE), anchor=(0, 0), borderType=cv2.BORDER_REFLECT).ravel()
    offsets = np.array([y * width + x for y, x in product(range(_SIZE), repeat=2)])
    total, weights = np.zeros((len(offsets), height * width)), np.zeros(height * width)
    for start in range(0, len(members), _CHUNK):
        chosen = members[start : start + _CHUNK]
        estimates, weight = _posterior(padded.ravel(), guide.ravel(), noise, chosen, offsets)
        places, weight = chosen.ravel(), np.repeat(weight, _MEMBERS)
        weights += np.bincount(places, weight, height * width)
        weighted = estimates.reshape(-1, len(offsets)) * weight[:, None]
        for k, column in enumerate(np.ascontiguousarray(weighted.T)):
            total[k] += np.bincount(places, column, height * width)
    result, share = np.zeros(height * width), np.zeros(height * width)
    for k, offset in enumerate(offsets):
        result += np.roll(total[k], offset)
        share += np.roll(weights, offset)
    result = (result / np.maximum(share, 1e-12)).reshape(height, width)
    return np.asarray(result[border:-border, border:-border], np.float32)


def _posterior(
    image: np.ndarray, guide: np.ndarray, noise: np.ndarray, members: np.ndarray, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Posterior means (G, M, n) of the patches of groups (G, M), and a weight (G,) for each group."""
    pixels = members[..., None] + offsets
    prior, measured = guide[pixels], image[pixels]
    mean = prior.mean(axis=1, keepdims=True)
    deviations = (prior - mean) / np.float32(np.sqrt(_MEMBERS - 1))
    power = noise[members].mean(axis=1)[:, None, None]
    # With deviations A and covariance C = A^T A, the gain C (C + s^2 I)^-1 is A^T (A A^T + s^2 I)^-1 A: a group has
    # fewer members than a patch has pixels.
    transposed = np.swapaxes(deviations, 1, 2)
    inverse = np.linalg.inv(deviations @ transposed + power * np.eye(_MEMBERS, dtype=np.float32))
    estimates = mean + (((measured - mean) @ transposed) @ inverse) @ deviations
    # Without their zeros, the gain has the eigenvalues of I - s^2 (A A^T + s^2 I)^-1.
    kept = np.eye(_MEMBERS, dtype=np.float32) - power * inverse
    weight = 1.0 / (power[:, 0, 0] * np.maximum(np.einsum("gij,gij->g", kept, kept), 1.0))
    return estimates, weight


def _alike(guide: np.ndarray, ys: np.ndarray, xs: np.ndarray) -> np.ndarray:
    """(G, M) places of the patches most like those at a grid, themselves among them."""
    height, width = guide.shape
    shifts = list(product(range(-_REACH, _REACH + 1), repeat=2))
    distances = np.empty((len(shifts), len(ys) * len(xs)), np.float32)
    reach = slice(_REACH, -_REACH)
    inner = np.ascontiguousarray(guide[reach, reach])
    at = np.ix_(ys - _REACH, xs - _REACH)
    for k, (y, x) in enumerate(shifts):
        moved = guide[_REACH + y : height - _REACH + y, _REACH + x : width - _REACH + x]
        squares = cv2.subtract(inner, moved)
        squares = cv2.boxFilter(cv2.multiply(squares, squares), -1, (_SIZE, _SIZE), anchor=(0, 0))
        distances[k] = squares[at].ravel()
    nearest = np.argpartition(np.ascontiguousarray(distances.T), _MEMBERS, axis=1)[:, :_MEMBERS]
    steps = np.array([y * width + x for y, x in shifts])
    return np.asarray((ys[:, None] * width + xs).ravel()[:, None] + steps[nearest])


def _grid(first: int, end: int) -> np.ndarray:
    """Every few pixels from the first on, and the last before the end."""
    return np.unique(np.r_[np.arange(first, end, _STEP), end - 1])
