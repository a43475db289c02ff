"""How sharp images are."""

import cv2
import numpy as np

from sigmaslam.frontend.patch_kernels import compiled

# Smoothing before derivatives are taken: standard deviation and reach, pixels.
_BLUR, _REACH = 0.7, 3
# Half the side of patches that are compared, as those that are aligned, and what derivatives need beside them, pixels.
_RADIUS, _MARGIN = 7, _REACH + 1
# Defocus by 2 to 3 pixels leaves a quarter; within twenty frames eight good recordings and renders have 0.44 at least.
_DEFOCUSED = 0.25


def sharpness(image: np.ndarray) -> float:
    """Mean squared second derivative of an (H, W) uint8 image over that of the first, 1 / pixels squared.

    It falls with blur of any kind, and depends on neither contrast nor brightness.
    """
    smooth = cv2.sepFilter2D(image, cv2.CV_32F, _KERNEL, _KERNEL)
    first = sum(cv2.norm(cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=1)) ** 2 for axes in ((1, 0), (0, 1)))
    return float(cv2.norm(cv2.Laplacian(smooth, cv2.CV_32F)) ** 2 / max(first, 1.0))


def is_defocused(image: np.ndarray, reference: np.ndarray) -> bool:
    """Whether edges of an (H, W) uint8 image are far wider than those of one of about the same scene, in any light."""
    return _edge_density(image) < _DEFOCUSED * _edge_density(reference)


def _edge_density(image: np.ndarray) -> float:
    """Mean squared first derivative over the variance: in `sharpness` noise makes up for what strong blur takes."""
    squares = sum(cv2.norm(cv2.Sobel(image, cv2.CV_32F, *axes, ksize=3)) ** 2 for axes in ((1, 0), (0, 1)))
    return float(squares / max(image.var() * image.size, 1.0))


def patch_energies(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(M, 2) energies of the first and second derivatives in patches of an image, grey values squared.

    The sum of the second over that of the first is the sharpness of all patches together.

    Args:
        image: (H, W) uint8.
        places: (M, 2) centres of the patches, pixels.
    """
    if not len(places):
        return np.zeros((0, 2))
    kernels = compiled()
    if kernels is not None:
        return np.asarray(kernels.energies(image, _pixels(image, places), _KERNEL))
    patches, smooth = _smooth_patches(image, places)
    across, down = (cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=1) for axes in ((1, 0), (0, 1)))
    maps = across * across + down * down, cv2.Laplacian(smooth, cv2.CV_32F) ** 2
    return np.column_stack([_inner_mean(each, patches) for each in maps])


def gradient_moments(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(2, 2) second moments of the grey values' gradients in patches of an image, over the patches' variance.

    1 / pixels squared; infinite where nothing varies.

    Args:
        image: (H, W) uint8.
        places: (M, 2) centres of the patches, pixels; at least one.
    """
    patches, smooth = _smooth_patches(image, places)
    gradient = [0.5 * cv2.Sobel(smooth, cv2.CV_32F, *axes, ksize=1) for axes in ((1, 0), (0, 1))]
    uu, uv, vv = (float(_inner_mean(gradient[k] * gradient[j], patches).mean()) for k, j in ((0, 0), (0, 1), (1, 1)))
    variance = float(patches.var(axis=(1, 2)).mean())
    return np.array([[uu, uv], [uv, vv]]) / variance if variance > 0.0 else np.full((2, 2), np.inf)


def _smooth_patches(image: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(M, S, S) grey values around places with what derivatives need, and the same smoothed, (M S, S) in one column."""
    reach = _RADIUS + _MARGIN
    framed = cv2.copyMakeBorder(image, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    windows = np.lib.stride_tricks.sliding_window_view(framed, (2 * reach + 1, 2 * reach + 1))
    patches = windows[tuple(_pixels(image, places)[:, ::-1].T)]
    # One below the other, so that one call filters all; what their margins share is cut off.
    return patches, cv2.sepFilter2D(patches.reshape(-1, 2 * reach + 1), cv2.CV_32F, _KERNEL, _KERNEL)


def _pixels(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(M, 2) whole numbers: the pixels of the image next to places (M, 2)."""
    height, width = image.shape
    return np.clip(np.rint(places), 0, (width - 1, height - 1)).astype(np.int32)


def _inner_mean(values: np.ndarray, patches: np.ndarray) -> np.ndarray:
    """(M,) means of values like `_smooth_patches` gives them, without the patches' margins."""
    inner = slice(_MARGIN, -_MARGIN)
    return np.asarray(values.reshape(patches.shape)[:, inner, inner].mean(axis=(1, 2)))


# Of a Gaussian.
_WEIGHTS = np.exp(-0.5 * (np.arange(-_REACH, _REACH + 1) / _BLUR) ** 2)
_KERNEL = np.asarray((_WEIGHTS / _WEIGHTS.sum()).astype(np.float32))
