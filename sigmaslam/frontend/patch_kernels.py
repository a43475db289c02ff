"""Patches of grey images, aligned and compared: compiled where a compiler was at hand, in NumPy else.

Other compiled functions stand beside their twins: `motion_blur`, `image_sharpness`, `followed_patches`,
`plane_alignment`, `row_search`, `feature_spacing` and `two_view.stereo_pose`.

Both compute the same formula, so that results agree to rounding. Samples come straight from the 8-bit image by a
separable Gaussian, whose weights are tabulated by the fraction of a pixel: exact at every place, where bilinear samples
of the pixels would be off by up to 0.015 px, alike where all move alike.
"""

from collections.abc import Callable, Sequence
from functools import cache, wraps
from types import ModuleType

import numpy as np

from sigmaslam.compiled import open_compiled, tell_slow

Images = np.ndarray | Sequence[np.ndarray]
"""An image (H, W) uint8, or several of one size, of which a match may come from any."""

_kernels = open_compiled("frontend._kernels")

# Smoothing of samples, standard deviation in pixels, and the reach of its kernel in standard deviations.
_BLUR, _REACH = 0.7, 4.0
# Steps of a pixel for which the kernel is tabulated.
_FRACTIONS = 256
MAX_ZOOM = 5.0
"""Between two patches; neighbours whose map has more are wrong."""
MAX_HALF_OCTAVES = 5
"""The same zoom, rounded: images are smoothed in such steps."""
# No part of a patch of a plane seen from elsewhere is nearer than this share of its centre's distance.
_MIN_DEPTH = 0.2
# Variance of grey values that is added to a patch's before it is normalised, and to the normal equations.
_FLAT, _RIDGE = np.float32(1e-2), np.float32(1e-6)
# Patches that are sampled at once.
_CHUNK = 128


def _of_several(kernel: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """A function of images 0 and 1, rows of their matches, and numbers, for several images 0, too."""

    @wraps(kernel)
    def run(
        image0: Images, image1: np.ndarray, *arguments: np.ndarray | float, source: np.ndarray | None = None
    ) -> np.ndarray:
        if source is None:
            return kernel(image0, image1, *arguments)
        parts = [np.flatnonzero(source == number) for number in range(len(image0))]
        found = [
            kernel(image, image1, *(each[some] if isinstance(each, np.ndarray) else each for each in arguments))
            for image, some in zip(image0, parts, strict=True)
        ]
        return np.concatenate(found)[np.argsort(np.concatenate(parts))]

    return run


@_of_several
def align(
    image0: np.ndarray,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    back: np.ndarray,
    tilt: np.ndarray,
    half_octaves: np.ndarray,
    radius: int,
    iterations: int,
    taper: float,
) -> np.ndarray:
    """Inverse compositional Lucas-Kanade over a shift (Baker & Matthews 2004), gain and offset of grey values free.

    In NumPy; the compiled twin is that of `affine_alignment.align_patches`, which is all that needs it.

    Args:
        image0, image1: (H, W) uint8; of image 0 there may be several.
        points0, points1: (M, 2) float64 matched pixels, inside the images.
        back: (M, 2, 2) linear part of the map from image 1 to image 0 around the match.
        tilt: (M, 2) its perspective part, as of `PatchMaps`.
        half_octaves: (M,) log2 of the zoom of image 1 over image 0, doubled and rounded.
        radius: of the patches, samples.
        iterations: Gauss-Newton steps, each at most one sample long.
        taper: standard deviation of the patches' Gaussian window, radii.
        source: by its name; (M,) which of the images 0 each match comes from; None: there is one.
    Returns:
        (M, 3) float64: shift of the place in image 1, pixels, and the correlation of the patches there.
    """
    result = np.zeros((len(points0), 3))
    window = _window(radius, taper)
    for step, rows in _groups(half_octaves):
        spacing = 2.0 ** (0.5 * max(step, 0))
        grid = spacing * _grid(radius)
        template = sample(image0, points0[rows, None] + _warped(grid, back[rows], tilt[rows]), max(-step, 0))
        template = _normalised(template, window)
        along_u, along_v = _gradients(template, radius, spacing)
        gradient = np.stack([along_u, along_v], axis=1)
        weighted = gradient * window
        normal = weighted @ gradient.transpose(0, 2, 1) + _RIDGE * np.eye(2, dtype=np.float32)
        towards = np.linalg.inv(normal) @ weighted
        shift = np.zeros((len(rows), 2))
        for _ in range(iterations):
            patch = sample(image1, (points1[rows] + shift)[:, None] + grid, max(step, 0))
            error = _normalised(patch, window) - template
            move = (towards @ error[..., None])[..., 0].astype(np.float64)
            length = np.linalg.norm(move, axis=1, keepdims=True)
            shift -= move * np.minimum(1.0, spacing / np.maximum(length, 1e-9))
        patch = _normalised(sample(image1, (points1[rows] + shift)[:, None] + grid, max(step, 0)), window)
        result[rows, :2], result[rows, 2] = shift, (patch * template) @ window
    return result


def examine(
    image0: Images,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    back: np.ndarray,
    half_octaves: np.ndarray,
    radius: int,
    taper: float,
    flat: float,
    source: np.ndarray | None = None,
) -> np.ndarray:
    """Compares patches; arguments as of `align`, and `flat`: variance of grey values that a flat patch has.

    Returns:
        (M, 6) float64: correlation, variance of either patch, and uu, uv, vv: mean products of the gradients of both
        normalised patches' mean, by samples.
    """
    kernels = compiled()
    rows = points0, points1, back, half_octaves
    if kernels is None:
        return examine_reference(image0, image1, *rows, radius, taper, flat, source=source)
    found: np.ndarray = kernels.examine(*sources(image0, source), image1, *rows, 2 * radius + 1, taper * radius, flat)
    return found


def invert_maps(A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Determinants (M,) of maps (M, 2, 2) and their inverses; NaN and the identity for maps that no surface shows.

    No opaque surface shows its mirror image, and none a zoom beyond `MAX_ZOOM`; nor do entries that are not finite.
    """
    a, b, c, d = A.reshape(-1, 4).T
    with np.errstate(invalid="ignore"):
        determinant = a * d - b * c
        determinant[~((determinant > MAX_ZOOM**-2) & (determinant < MAX_ZOOM**2))] = np.nan
        back = (np.stack([d, -b, -c, a], axis=1) / determinant[:, None]).reshape(-1, 2, 2)
    back[np.isnan(determinant)] = np.eye(2)
    return determinant, back


def compiled() -> ModuleType | None:
    """The compiled functions, or None where NumPy must do, which is said once."""
    if _kernels is None:
        tell_slow("patches are aligned in NumPy, which is several times slower")
    return _kernels


def sources(image0: Images, source: np.ndarray | None) -> tuple[list[np.ndarray], np.ndarray]:
    """Images and numbers as the compiled functions take them."""
    images = [image0] if isinstance(image0, np.ndarray) else list(image0)
    return images, np.zeros(0, np.int32) if source is None else source


# ---- the reference


@_of_several
def examine_reference(
    image0: np.ndarray,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    back: np.ndarray,
    half_octaves: np.ndarray,
    radius: int,
    taper: float,
    flat: float,
) -> np.ndarray:
    """`examine` in NumPy."""
    result = np.zeros((len(points0), 6))
    window = _window(radius, taper)
    for step, rows in _groups(half_octaves):
        grid = 2.0 ** (0.5 * max(step, 0)) * _grid(radius)
        warped = _warped(grid, back[rows], np.zeros((len(rows), 2)))
        centred0, variance0 = _centred(sample(image0, points0[rows, None] + warped, max(-step, 0)), window)
        centred1, variance1 = _centred(sample(image1, points1[rows, None] + grid, max(step, 0)), window)
        variance0, variance1 = variance0 + np.float32(flat), variance1 + np.float32(flat)
        # Gradients of the mean of both normalised patches: their noise is the smaller for it.
        mean = 0.5 * (centred0 / np.sqrt(variance0)[:, None] + centred1 / np.sqrt(variance1)[:, None])
        along_u, along_v = _gradients(mean, radius, 1.0)
        columns = ((centred0 * centred1) @ window / np.sqrt(variance0 * variance1), variance0, variance1)
        products = ((a * b) @ window for a, b in ((along_u, along_u), (along_u, along_v), (along_v, along_v)))
        result[rows] = np.column_stack([*columns, *products])
    return result


def sample(image: np.ndarray, places: np.ndarray, half_octaves: int = 0) -> np.ndarray:
    """Smoothed grey values (M, K) float32 of a uint8 image at places (M, K, 2), borders continued.

    The Gaussian's standard deviation is 0.7 pixels, times the square root of two for each half octave.
    """
    table, reach = _kernel(half_octaves)
    height, width = image.shape
    result = np.empty(places.shape[:2], np.float32)
    for begin in range(0, len(places), _CHUNK):
        some = slice(begin, begin + _CHUNK)
        whole = np.floor(places[some])
        steps = (places[some] - whole).astype(np.float32) * np.float32(_FRACTIONS)
        lower = np.minimum(steps.astype(np.int64), _FRACTIONS - 1)
        share = (steps - lower)[..., None]
        weights = table[lower] + share * (table[lower + 1] - table[lower])
        pixels = whole.astype(np.int64)[..., None] + np.arange(1 - reach, reach + 1)
        columns, rows = np.clip(pixels[:, :, 0], 0, width - 1), np.clip(pixels[:, :, 1], 0, height - 1)
        values = image[rows[..., None], columns[..., None, :]].astype(np.float32)
        sums = (weights[:, :, 1, :, None] * values).sum(axis=2)
        result[some] = (weights[:, :, 0] * sums).sum(axis=-1)
    return result


@cache
def _kernel(half_octaves: int) -> tuple[np.ndarray, int]:
    """Weights (257, 2 reach) float32 of the pixels around a place, by its fraction of a pixel; and the reach."""
    sigma = _BLUR * 2.0 ** (0.5 * half_octaves)
    reach = int(np.ceil(_REACH * sigma))
    fraction = np.arange(_FRACTIONS + 1)[:, None] / _FRACTIONS
    weights = np.exp(-0.5 * ((np.arange(1 - reach, reach + 1) - fraction) / sigma) ** 2)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32), reach


def _grid(radius: int) -> np.ndarray:
    """(K, 2) offsets of a patch's samples, (u, v), a sample apart."""
    side = np.arange(-radius, radius + 1, dtype=np.float64)
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def _window(radius: int, taper: float) -> np.ndarray:
    """(K,) float32 weights of a patch's samples, of sum 1."""
    weights = np.exp(-0.5 * (_grid(radius) ** 2).sum(axis=1) / (taper * radius) ** 2)
    return (weights / weights.sum()).astype(np.float32)


def _warped(grid: np.ndarray, back: np.ndarray, tilt: np.ndarray) -> np.ndarray:
    """(M, K, 2) where the samples of image 1 come from in image 0, from the patches' centres."""
    offsets = grid @ back.transpose(0, 2, 1)
    return offsets / np.maximum(1.0 - offsets @ tilt[..., None], _MIN_DEPTH)


def _groups(half_octaves: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Rows of each zoom."""
    steps = np.clip(half_octaves, -MAX_HALF_OCTAVES, MAX_HALF_OCTAVES)
    return [(int(step), np.flatnonzero(steps == step)) for step in np.unique(steps)]


def _centred(patches: np.ndarray, window: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Patches (M, K) of weighted mean 0, and their variance (M,)."""
    centred = patches - (patches @ window)[:, None]
    return centred, (centred * centred) @ window


def _normalised(patches: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Patches (M, K) of weighted mean 0 and variance 1."""
    centred, variance = _centred(patches, window)
    return np.asarray(centred / np.sqrt(variance + _FLAT)[:, None])


def _gradients(patches: np.ndarray, radius: int, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """(M, K) each: central differences along u and v of samples `spacing` apart."""
    square = patches.reshape(-1, 2 * radius + 1, 2 * radius + 1)
    along_v, along_u = np.gradient(square, np.float32(spacing), axis=(1, 2))
    return along_u.reshape(patches.shape), along_v.reshape(patches.shape)
