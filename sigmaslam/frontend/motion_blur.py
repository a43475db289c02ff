"""Motion blur: whether an image is streaked, and what matches are worth between two images of which only one is.

Where the sharp patch lies within its streak nobody knows. A patch that is aligned to the streak stays where the search
began, and so do all others: they agree with each other and not with the truth. Between images that are blurred alike
they do not.
"""

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE
from sigmaslam.frontend.image_sharpness import gradient_moments
from sigmaslam.frontend.patch_kernels import compiled

# In the mean of so many patches what single ones show of the scene evens out; more cost time.
_MOST, _FEWEST = 60, 8
# Width in pixels of an edge of a sharp image as `gradient_moments` sees it: 2 sqrt(pi) times the Gaussian's 1.2 pixels
# that lens (0.5), pixel (0.3), and the smoothing (0.7) and differences (0.8) of the gradients make together.
_SHARP_EDGE = 4.3
# Smoothing before second derivatives are compared, pixels of an image of half the size: without it noise hides the blur
# of dark rooms.
_SMOOTHER = cv2.getGaussianKernel(7, 0.75, cv2.CV_32F)
# Directions that are compared, and what derivatives need beside them, pixels.
_DIRECTIONS, _MARGIN = 12, 4
_ANGLE = np.arange(_DIRECTIONS) * np.pi / _DIRECTIONS
_COSINE, _SINE = np.cos(_ANGLE), np.sin(_ANGLE)
# First and second derivatives along them from those along the axes.
_ONCE, _TWICE = np.stack([_COSINE, _SINE]), np.stack([_COSINE**2, 2.0 * _COSINE * _SINE, _SINE**2])
# Where the products of these stand in a symmetric matrix.
_UPPER = np.triu_indices(2), np.triu_indices(3)


def is_blurred(image: np.ndarray) -> bool:
    """Whether an (H, W) uint8 image is blurred along one direction.

    Edges of any strength and number have the same width in all directions if it is not, but for stripes: these vary
    slowly across, but not as slowly as a streak does.
    """
    least, most = extreme_sharpness(image)
    return least < ACCEPTANCE.even_sharpness * most and least < ACCEPTANCE.streak_sharpness


def extreme_sharpness(image: np.ndarray) -> tuple[float, float]:
    """Sharpness of an (H, W) uint8 image in its least sharp direction and in its sharpest.

    The sharpness in a direction is the mean squared second derivative over that of the first, per squared pixel of half
    the image. Infinite where nothing varies.
    """
    half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    kernels = compiled()
    products = _products(half) if kernels is None else kernels.derivative_products(half, _SMOOTHER.ravel())
    first, second = np.zeros((2, 2)), np.zeros((3, 3))
    for matrix, values, (rows, columns) in ((first, products[:3], _UPPER[0]), (second, products[3:], _UPPER[1])):
        matrix[rows, columns] = matrix[columns, rows] = values
    energies = [np.einsum("id,ij,jd->d", each, moments, each) for each, moments in ((_ONCE, first), (_TWICE, second))]
    if not (np.array(energies) > 0.0).all():
        return np.inf, np.inf
    sharpness = energies[1] / energies[0]
    return float(sharpness.min()), float(sharpness.max())


def _products(half: np.ndarray) -> np.ndarray:
    """(9,) sums of the products of first derivatives, then of second ones; the compiled function's reference."""
    smooth = cv2.sepFilter2D(half, cv2.CV_32F, _SMOOTHER, _SMOOTHER)
    orders = ((1, 0), (0, 1)), ((2, 0), (1, 1), (0, 2))
    inner = slice(_MARGIN, -_MARGIN)
    maps = [
        np.stack([cv2.Sobel(smooth, cv2.CV_32F, *order, ksize=3)[inner, inner].ravel() for order in each])
        for each in orders
    ]
    return np.concatenate([(each @ each.T)[np.triu_indices(len(each))] for each in maps])


def streak_covariance(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray
) -> np.ndarray | None:
    """(2, 2) by how much matches are uncertain along the streak, all together, pixels squared.

    The mean squared gradient across an edge falls as the edge widens, so its quotient between the images says how wide
    edges of the blurred one are along the streak. A place anywhere within a streak of length L has the variance L^2/12.

    Args:
        image0, image1: (H, W) uint8.
        points0, points1: (M, 2) matched pixels.
    Returns:
        None where the images are blurred alike, as far as can be told.
    """
    if len(points0) < _FEWEST:
        return None
    chosen = np.linspace(0, len(points0) - 1, min(_MOST, len(points0))).astype(int)
    moments = np.stack([gradient_moments(image0, points0[chosen]), gradient_moments(image1, points1[chosen])])
    if not np.isfinite(moments).all() or not (np.linalg.det(moments) > 0.0).all():
        return None
    # Directions in which the gradients of image 1 are weakest and strongest beside those of image 0.
    root = np.linalg.inv(np.linalg.cholesky(moments[0]))
    quotients, directions = np.linalg.eigh(root @ moments[1] @ root.T)
    share = float(quotients[0] / quotients[1])
    if share >= ACCEPTANCE.equal_blur:
        return None
    # Of the two the streak is where the gradients changed by more: across it they hardly do.
    weakest = quotients[0] * quotients[1] < 1.0
    along = root.T @ directions[:, 0 if weakest else 1]
    along /= np.linalg.norm(along)
    return np.asarray(_SHARP_EDGE**2 * (share**-2 - 1.0) / 12.0 * np.outer(along, along))
