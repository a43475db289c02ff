"""Statistics of grey images that matter to a detector of keypoints: gradients, spectrum, corners, brightness, noise.

Images are (H, W) uint8 or float, grey levels 0 to 255. All is computed after a mild blur that is the same for all
images, but for the spectrum and the noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

BLUR = 1.0
"""Standard deviation of the common blur, pixels."""
GRADIENT_EDGES = np.linspace(-2.0, 2.0, 81)
"""Bins of log10 of the gradient's magnitude in grey levels per pixel; the first and the last hold what is beyond."""
STRENGTH_EDGES = np.linspace(-1.0, 2.0, 61)
"""Bins of log10 of the strength of corners; the first and the last hold what is beyond."""
BRIGHTNESS_EDGES = np.linspace(0.0, 256.0, 33)
"""Bins of grey levels."""
TILE = 224
"""Side of the squares whose spectra are averaged, pixels."""
MID_BAND = (0.02, 0.2)
"""Frequencies between which the slope of the spectrum is fitted, cycles per pixel."""
CORNER_LEVELS = (3.0, 10.0)
"""Corners of these strengths and more are counted, grey levels per pixel."""
FLAT = 0.5
"""Pixels with a smaller gradient are flat, grey levels per pixel."""
CORNERS_PER_10000 = 40.0
"""The strongest corners of an image that must be found again, per 10^4 pixels."""

_MARGIN = 4  # pixels at the border that no filter's result is read from
_WINDOW = 2.0  # standard deviation of the window of the structure tensor, pixels
_SPACING = 7  # pixels, side of the square of which a corner is the largest response
_SEEN_MARGIN = 8  # corners nearer to the border of the other image need not be found again
_PATCH = 8  # side of the patches whose noise is measured, pixels
_FLAT_SHARE = 0.1  # of the patches of one brightness, the flattest
_FEWEST_PATCHES = 20
_DARKEST, _BRIGHTEST = 6, 249  # patches that reach beyond are clipped
_IMMERKAER = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)


@dataclass(frozen=True, slots=True)
class NoisePatches:
    """Patches of 8x8 pixels of an image.

    Attributes:
        brightness: (N,) mean grey level.
        sigma: (N,) standard deviation of the noise if it is white, grey levels (what is left of texture adds to it).
        texture: (N,) mean gradient after a blur that takes most noise away, grey levels per pixel.
    """

    brightness: np.ndarray
    sigma: np.ndarray
    texture: np.ndarray


@dataclass(frozen=True, slots=True)
class ImageSet:
    """Statistics of several images; histograms are means over the images.

    Attributes:
        name: of the set.
        count: of the images.
        gradient: shares in GRADIENT_EDGES.
        frequencies, density: the spectrum, geometric mean over the images.
        strength: corners per 10^4 pixels, strong and weak, in STRENGTH_EDGES.
        corner_density: corners of CORNER_LEVELS per 10^4 pixels, (2,).
        repeatability: of the strongest corners under a random homography, share, and its standard error.
        brightness: shares in BRIGHTNESS_EDGES.
        noise: grey levels, in the bins of BRIGHTNESS_EDGES; NaN where there are too few flat patches.
    """

    name: str
    count: int
    gradient: np.ndarray
    frequencies: np.ndarray
    density: np.ndarray
    strength: np.ndarray
    corner_density: np.ndarray
    repeatability: tuple[float, float]
    brightness: np.ndarray
    noise: np.ndarray

    @property
    def slope(self) -> float:
        """Of the spectrum over MID_BAND."""
        return spectral_slope(self.frequencies, self.density)

    @property
    def median_gradient(self) -> float:
        """Grey levels per pixel."""
        return float(10.0 ** quantile(self.gradient, GRADIENT_EDGES, 0.5))

    @property
    def flat(self) -> float:
        """Share of the pixels with a gradient below FLAT."""
        return float(self.gradient[GRADIENT_EDGES[1:] <= np.log10(FLAT) + 1e-9].sum())

    @property
    def median_noise(self) -> float:
        """Median over the bins of brightness, grey levels; NaN where none is known."""
        return float(np.nanmedian(self.noise)) if np.isfinite(self.noise).any() else float("nan")


def summarize(name: str, images: Sequence[np.ndarray], seed: int = 0) -> ImageSet:
    """All statistics of images (H, W) of grey levels.

    Args:
        name: of the set.
        images: one or more.
        seed: of the homographies, one an image.
    """
    gradient, spectra, strengths, brightness, patches, densities, repeated = [], [], [], [], [], [], []
    for k, image in enumerate(images):
        gradient.append(gradient_histogram(image))
        frequencies, density = power_spectrum(image)
        spectra.append(np.log(density + 1e-12))
        _, strength = corners(image)
        strengths.append(histogram(np.log10(strength), STRENGTH_EDGES) * corner_density(strength, image.shape, 0.0))
        densities.append([corner_density(strength, image.shape, level) for level in CORNER_LEVELS])
        H = random_homography(np.random.default_rng((seed, k)), image.shape)
        repeated.append(repeatability(image, H))
        brightness.append(brightness_histogram(image))
        patches.append(noise_patches(image))
    joined = NoisePatches(
        *(np.concatenate([getattr(part, key) for part in patches]) for key in ("brightness", "sigma", "texture"))
    )
    return ImageSet(
        name,
        len(images),
        np.mean(gradient, axis=0),
        frequencies,
        np.exp(np.mean(spectra, axis=0)),
        np.mean(strengths, axis=0),
        np.mean(densities, axis=0),
        (float(np.nanmean(repeated)), float(np.nanstd(repeated) / np.sqrt(len(repeated)))),
        np.mean(brightness, axis=0),
        noise_by_brightness(joined),
    )


def gradients(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives along u and v after the common blur, (H, W) float32 grey levels per pixel."""
    return _derivatives(image, BLUR)


def gradient_histogram(image: np.ndarray) -> np.ndarray:
    """Shares of the pixels by log10 of their gradient's magnitude, in the bins of GRADIENT_EDGES."""
    along_u, along_v = gradients(image)
    inner = np.s_[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    return histogram(np.log10(np.hypot(along_u, along_v)[inner] + 1e-9), GRADIENT_EDGES)


def power_spectrum(image: np.ndarray, tile: int = TILE) -> tuple[np.ndarray, np.ndarray]:
    """Radially averaged power spectral density, mean over all whole tiles of the image.

    A Hann window keeps the tile's borders out. White noise of standard deviation s has density s^2 everywhere.

    Returns:
        (K,) frequencies in cycles per pixel up to 0.5, and (K,) densities in grey levels squared x pixel^2.
    Raises:
        ValueError: the image is smaller than a tile.
    """
    height, width = image.shape
    if min(height, width) < tile:
        raise ValueError(f"the image of {width}x{height} is smaller than a tile of {tile}x{tile}: give a smaller tile")
    window = np.outer(np.hanning(tile), np.hanning(tile))
    power = np.zeros((tile, tile))
    # Tiles in the middle of equal parts of the image.
    tops, lefts = (np.linspace(0, side - tile, side // tile).astype(int) for side in (height, width))
    for top in tops:
        for left in lefts:
            square = image[top : top + tile, left : left + tile].astype(np.float64)
            mean = (square * window).sum() / window.sum()
            power += np.abs(np.fft.fft2((square - mean) * window)) ** 2
    power /= len(tops) * len(lefts) * (window**2).sum()
    frequency = np.hypot(np.fft.fftfreq(tile)[:, None], np.fft.fftfreq(tile))
    ring = np.round(frequency * tile).astype(int).ravel()
    counts = np.bincount(ring)
    rings = np.arange(1, tile // 2 + 1)
    return rings / tile, np.bincount(ring, power.ravel())[rings] / counts[rings]


def spectral_slope(frequencies: np.ndarray, density: np.ndarray) -> float:
    """Slope of log density against log frequency over MID_BAND, each octave alike; -2 is that of most photographs."""
    low, high = np.log(MID_BAND)
    samples = np.linspace(low, high, 50)
    values = np.interp(samples, np.log(frequencies), np.log(np.maximum(density, 1e-12)))
    return float(np.polyfit(samples, values, 1)[0])


def corners(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shi-Tomasi corners: local maxima of the smaller eigenvalue of the structure tensor.

    Returns:
        (N, 2) places (u, v) in pixels, to a fraction of one, strongest first; (N,) strengths: the square root of the
        eigenvalue, which is the root mean square gradient across the weakest direction, grey levels per pixel.
    """
    along_u, along_v = gradients(image)
    products = np.stack([along_u * along_u, along_u * along_v, along_v * along_v], axis=-1)
    uu, uv, vv = np.moveaxis(cv2.GaussianBlur(products, (0, 0), _WINDOW, borderType=cv2.BORDER_REFLECT_101), -1, 0)
    response = 0.5 * (uu + vv) - np.sqrt(0.25 * (uu - vv) ** 2 + uv * uv)
    highest = cv2.dilate(response, np.ones((_SPACING, _SPACING), np.uint8))
    peak = (response >= highest) & (response > 1e-4)
    peak[:_MARGIN] = peak[-_MARGIN:] = peak[:, :_MARGIN] = peak[:, -_MARGIN:] = False
    v, u = np.nonzero(peak)
    strengths = np.sqrt(response[v, u])
    centre = response[v, u]
    places = np.stack(
        [
            u + _summit(response[v, u - 1], centre, response[v, u + 1]),
            v + _summit(response[v - 1, u], centre, response[v + 1, u]),
        ],
        axis=1,
    )
    order = np.argsort(-strengths, kind="stable")
    return places[order], strengths[order]


def corner_density(strengths: np.ndarray, shape: tuple[int, ...], threshold: float) -> float:
    """Corners of at least that strength per 10^4 pixels of an image of that (H, W)."""
    return 1e4 * float((strengths >= threshold).sum()) / (shape[0] * shape[1])


def repeatability(image: np.ndarray, H: np.ndarray) -> float:
    """Share of an image's strongest corners that are found again within 1 px after a homography.

    As many of the strongest are taken in both, CORNERS_PER_10000 of the area in which they may lie. What lies within
    8 px of the border of the warped image or of the original's border in it is not asked for.

    Args:
        image: (H, W) grey levels.
        H: (3, 3), takes pixels of the image to those of the warped one, which has the same size.
    Returns:
        Share in [0, 1], NaN where no corner remains in sight.
    """
    height, width = image.shape
    warped = cv2.warpPerspective(image, H, (width, height), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT_101)
    there = cv2.warpPerspective(np.full((height, width), 255, np.uint8), H, (width, height), flags=cv2.INTER_NEAREST)
    side = 2 * _SEEN_MARGIN + 1
    there = cv2.erode(there, np.ones((side, side), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    places0, _ = corners(image)
    places1, _ = corners(warped)
    mapped = cv2.perspectiveTransform(places0[:, None].astype(np.float64), H)[:, 0] if len(places0) else places0
    wanted = round(CORNERS_PER_10000 * np.count_nonzero(there) / 1e4)
    mapped = mapped[_inside(there, mapped)][:wanted]
    if len(mapped) == 0:
        return float("nan")
    # Keep corners just outside the area, or those that move across its border are lost.
    near = cv2.dilate(there, np.ones((5, 5), np.uint8))
    matched = places1[_inside(near, places1)]
    matched = matched[np.cumsum(_inside(there, matched)) <= wanted]
    if len(matched) == 0:
        return 0.0
    distance = np.linalg.norm(mapped[:, None] - matched[None], axis=2).min(axis=1)
    return float((distance < 1.0).mean())


def random_homography(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """A mild homography about the centre of an image of that (H, W): turn to +-20 degrees, scale 0.85 to 1.2, tilt."""
    height, width = shape[:2]
    angle, scale = np.deg2rad(rng.uniform(-20, 20)), np.exp(rng.uniform(np.log(0.85), np.log(1.2)))
    centre = np.array([[1.0, 0.0, 0.5 * (width - 1)], [0.0, 1.0, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    H = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    H[2, :2] = rng.uniform(-0.1, 0.1, 2) / max(height, width)
    return np.asarray(centre @ H @ np.linalg.inv(centre))


def brightness_histogram(image: np.ndarray) -> np.ndarray:
    """Shares of the pixels by grey level, in the bins of BRIGHTNESS_EDGES."""
    return histogram(image.astype(np.float64), BRIGHTNESS_EDGES)


def noise_patches(image: np.ndarray) -> NoisePatches:
    """Noise of all patches of an image that are not clipped.

    By Immerkaer's second differences (1996), to which planes and edges along the axes are nothing. Rounding to eight
    bits adds 0.29 in squares.
    """
    grey = image.astype(np.float32)
    residual = np.abs(cv2.filter2D(grey, -1, _IMMERKAER, borderType=cv2.BORDER_REFLECT_101))
    along_u, along_v = _derivatives(grey, 2.0)
    inner = np.s_[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
    brightness, sigma, texture = (
        _patches(values[inner]).mean(axis=1) for values in (grey, residual, np.hypot(along_u, along_v))
    )
    whole = _patches(grey[inner])
    kept = (whole.min(axis=1) >= _DARKEST) & (whole.max(axis=1) <= _BRIGHTEST)
    return NoisePatches(brightness[kept], sigma[kept] * np.sqrt(np.pi / 2) / 6.0, texture[kept])


def noise_by_brightness(patches: NoisePatches, edges: np.ndarray = BRIGHTNESS_EDGES) -> np.ndarray:
    """Median noise of the flattest tenth of the patches in each bin of brightness, NaN where there are too few.

    Args:
        patches: of one image or, joined, of many.
        edges: (K + 1,) of the bins.
    Returns:
        (K,) standard deviations, grey levels.
    """
    result = np.full(len(edges) - 1, np.nan)
    bins = np.digitize(patches.brightness, edges) - 1
    for k in range(len(result)):
        index = np.flatnonzero(bins == k)
        count = int(_FLAT_SHARE * len(index))
        if count >= _FEWEST_PATCHES:
            flattest = index[np.argsort(patches.texture[index], kind="stable")[:count]]
            result[k] = np.median(patches.sigma[flattest])
    return result


def histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Shares of the values by bin; what is beyond the edges goes to the first and the last."""
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return np.asarray(counts / max(counts.sum(), 1))


def wasserstein(shares0: np.ndarray, shares1: np.ndarray, edges: np.ndarray) -> float:
    """First Wasserstein distance between two histograms in the same bins, in units of the edges: how far to shift."""
    difference = np.cumsum(np.asarray(shares0) - np.asarray(shares1))
    return float(np.abs(difference) @ np.diff(edges))


def quantile(shares: np.ndarray, edges: np.ndarray, level: float) -> float:
    """The value below which that share of a histogram lies, linear within its bin."""
    below = np.concatenate([[0.0], np.cumsum(shares)])
    return float(np.interp(level * below[-1], below, edges))


def _derivatives(image: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur, borderType=cv2.BORDER_REFLECT_101)
    kernel = np.array([[-0.5, 0.0, 0.5]], np.float32)
    along_u = cv2.filter2D(smooth, -1, kernel, borderType=cv2.BORDER_REFLECT_101)
    return along_u, cv2.filter2D(smooth, -1, kernel.T, borderType=cv2.BORDER_REFLECT_101)


def _summit(before: np.ndarray, centre: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Where the parabola through three values has its top, pixels from the middle one, at most a half."""
    bend = before - 2.0 * centre + after
    offset = 0.5 * (before - after) / np.where(bend < 0, bend, -1.0)
    return np.clip(np.where(bend < 0, offset, 0.0), -0.5, 0.5)


def _inside(mask: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which of (N, 2) places lie where the mask is not zero."""
    height, width = mask.shape
    u, v = np.round(places).astype(int).T
    within = (u >= 0) & (v >= 0) & (u < width) & (v < height)
    within[within] = mask[v[within], u[within]] > 0
    return np.asarray(within)


def _patches(values: np.ndarray) -> np.ndarray:
    """(N, 64) of the whole patches of an (H, W) array."""
    rows, columns = (side // _PATCH for side in values.shape)
    square = values[: rows * _PATCH, : columns * _PATCH].reshape(rows, _PATCH, columns, _PATCH)
    return np.asarray(square.swapaxes(1, 2).reshape(rows * columns, -1))
