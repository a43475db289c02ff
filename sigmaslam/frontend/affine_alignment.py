"""Wide-baseline matches made consistent and exact: the map around each match from its neighbours, then patch alignment.

The classical Lucas-Kanade step (`refine`) takes both patches to differ by a shift. Between views that are turned and
scaled they do not; here each patch is first warped by the affine map that the neighbouring matches agree on.
"""

from typing import NamedTuple

import numpy as np

from sigmaslam.frontend.knn import nearest_points
from sigmaslam.frontend.patch_kernels import Images, align, compiled, invert_maps, sources
from sigmaslam.frontend.types import Refinement

# Three matches fix a map. Where 60 % are wrong, 24 find 0.60 of the maps, 12 only 0.40 (docs/notebook, following).
_NEIGHBOURS = 24
# Scale of the robust weight, pixels: from the first fit to the last.
_FIRST_SCALE, _LAST_SCALE = 12.0, 2.0
# The scale, times 0.7 each time, has come down after six; 12 fits find no more maps than eight.
_FITS = 8
# What holds a map back that its neighbours leave undetermined.
_PRIOR = 1.0
# The largest patch that the kernels take, 15 samples; five in place of seven leave 1.65 times the error.
_RADIUS = 7
# From a pixel off: after three steps 0.13 px are left in the median, after six 0.10, after twelve 0.09.
_ITERATIONS = 6
# A wider window is better where the map is exact (0.86 times the error with 1.0), and worse where it is off by 10 %.
_TAPER = 0.6
# Patches that agree less show something else; the verifier judges the others, by their correlation too.
_MIN_CORRELATION = 0.5


class AlignedPatches(NamedTuple):
    """Patches of image 0 in image 1.

    Attributes:
        places: (M, 2) float64, unchanged where the patches do not fit or the way is too far.
        moved: (M,) bool.
        correlation: (M,) of the patches where the alignment ended; 0 where there was none.
    """

    places: np.ndarray
    moved: np.ndarray
    correlation: np.ndarray


def local_maps(points0: np.ndarray, points1: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The affine map around each match that its nearest matches agree on, by iterated weighted least squares.

    Args:
        points0, points1: (M, 2) matched pixels.
        weight: (M,) trust in each match, as its probability.
    Returns:
        A (M, 2, 2), points1 - points1[i] = A[i] (points0 - points0[i]) near match i, and the distance (M,) in pixels
        of points1[i] from where the map of its neighbours, itself among them, would have it. Both are infinite for
        fewer than 4 matches.
    """
    count = len(points0)
    if count < 4:
        return np.full((count, 2, 2), np.inf), np.full(count, np.inf)
    near = nearest_points(points0, points0, min(_NEIGHBOURS, count))
    from0, from1 = points0[near] - points0[:, None], points1[near] - points1[:, None]
    design = np.concatenate([from0, np.ones((*near.shape, 1))], axis=2)
    trust = weight[near]
    fitted = trust
    scale = _FIRST_SCALE
    for _ in range(_FITS):
        weighted = design * fitted[..., None]
        normal = weighted.transpose(0, 2, 1) @ design + np.diag([_PRIOR, _PRIOR, 1e-3])
        solution = np.linalg.solve(normal, weighted.transpose(0, 2, 1) @ from1)
        distance = np.linalg.norm(from1 - design @ solution, axis=2)
        # Geman-McClure: a match far from the others' map does not pull it.
        fitted = trust / (1.0 + (distance / scale) ** 2) ** 2
        scale = max(0.7 * scale, _LAST_SCALE)
    return solution[:, :2].transpose(0, 2, 1), np.linalg.norm(solution[:, 2], axis=1)


def align_patches(
    image0: Images,
    image1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    A: np.ndarray,
    tilt: np.ndarray | None = None,
    reach: float = 3.0,
    radius: int = _RADIUS,
    iterations: int = _ITERATIONS,
    taper: float = _TAPER,
    source: np.ndarray | None = None,
) -> AlignedPatches:
    """Places in image 1 where the patches around points of image 0, warped by their maps, fit best.

    Inverse compositional Lucas-Kanade (Baker & Matthews 2004) over a shift, with gain and offset of the grey values
    free, on patches of 2 radius + 1 pixels of the coarser image.

    Args:
        image0, image1: (H, W) uint8; of image 0 there may be several.
        points0, points1: (M, 2) matched pixels.
        A: (M, 2, 2) as `local_maps` gives it.
        tilt: (M, 2) how the maps depart from affine ones, as of `PatchMaps`; not at all by default.
        reach: longest move, pixels of image 1.
        radius: of the patches, pixels of the coarser image.
        iterations: Gauss-Newton steps.
        taper: standard deviation of the patches' Gaussian window, radii.
        source: (M,) which of the images 0 each match comes from; None: there is one.
    """
    kernels, tilt = compiled(), np.zeros((len(points1), 2)) if tilt is None else tilt
    if kernels is not None:
        images, size = sources(image0, source), (reach, 2 * radius + 1, iterations, taper * radius)
        return AlignedPatches(*kernels.align(*images, image1, points0, points1, A, tilt, *size))
    places, moved = points1.astype(np.float64), np.zeros(len(points1), bool)
    determinant, back = invert_maps(A)
    usable = np.isfinite(determinant) & _inside(image1, points1)
    usable &= _inside(image0 if isinstance(image0, np.ndarray) else image0[0], points0)
    rows = np.flatnonzero(usable)
    # The finer image is smoothed as much as the coarser one's pixels do, in steps of half an octave.
    half_octaves = np.round(np.log2(determinant[rows])).astype(np.int32)
    given = points0[rows], places[rows], back[rows], tilt[rows], half_octaves
    of_rows = None if source is None else source[rows]
    found = align(image0, image1, *given, radius, iterations, taper, source=of_rows)
    shift, correlation = found[:, :2], found[:, 2]
    spacing = np.maximum(1.0, 2.0 ** (0.5 * half_octaves))
    fits = (correlation > _MIN_CORRELATION) & (np.hypot(*shift.T) <= reach * spacing)
    places[rows[fits]] += shift[fits]
    moved[rows[fits]] = True
    agreement = np.zeros(len(points1))
    agreement[rows] = correlation
    return AlignedPatches(places, moved, agreement)


def refine_by_neighbours(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, logit: np.ndarray
) -> Refinement:
    """Aligns the patches of every match, warped as its neighbours say.

    Args:
        image0, image1: (H, W) uint8.
        points0, points1: (M, 2) matched pixels.
        logit: (M,) of the scorer: how far each match is trusted.
    """
    points0, points1 = points0.astype(np.float64), points1.astype(np.float64)
    A, distance = local_maps(points0, points1, 1.0 / (1.0 + np.exp(-logit.astype(np.float64))))
    aligned = align_patches(image0, image1, points0, points1, A)
    return Refinement(points1, aligned.places, aligned.moved, A, distance)


def _inside(image: np.ndarray, points: np.ndarray) -> np.ndarray:
    return np.asarray(((points >= 0) & (points <= (image.shape[1] - 1, image.shape[0] - 1))).all(axis=1))
