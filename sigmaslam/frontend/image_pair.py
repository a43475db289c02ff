"""Two images in, matches with a probability and a covariance out: `sigmaslam images match`."""

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path, atomic_write_bytes
from sigmaslam.frontend.affine_alignment import refine_by_neighbours
from sigmaslam.frontend.build import own_networks
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.descriptor import refine_with_confidence
from sigmaslam.frontend.epipolar_search import find_epipolar_geometry, nearest_near_lines
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.nearest_neighbours import Putative, nearest_anywhere
from sigmaslam.frontend.rival_matches import count_rivals, share_with_rivals
from sigmaslam.frontend.types import Features, Refinement, check_grey
from sigmaslam.inference.networks import WeightsFolder
from sigmaslam.readers.images import read_grey
from sigmaslam.table import Table

DETECTORS = {"learned": LearnedDetector, "sift": SiftDetector, "orb": OrbDetector}
# Matches with a smaller probability are dropped by default.
MIN_PROBABILITY = 0.5
# Pixels; three cells of the coarsest map of the network, a 32nd of the image.
_MIN_SIDE = 96
# Larger images are shrunk to this long side, pixels: a network sees texture of few pixels, and photographs of many
# are blurred and noisy at those.
_LONGEST_SIDE = 1600
# If fewer of the keypoints are matched, though enough to be believed, image 1 is tried upside down.
_FEW_SHARE, _BELIEVED = 0.1, 8
# With fewer matches there is no map of neighbours.
_MIN_KEYPOINTS = 4
# More lines hide the images that they are drawn on.
_MAX_LINES = 60
# Lines begin so far apart at least, as a share of the image's longer side.
_LINE_SPACING = 0.04

_Pair = tuple[np.ndarray, np.ndarray, Features, Features]
"""Two images (H, W) uint8, and the features of each."""
_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Matches(Table):
    """Correspondences between two images, one to one, the most probable first.

    Attributes:
        keypoints0, keypoints1: (M, 2) float32 pixel coordinates (u, v) in image 0 and 1, as the images are stored;
            keypoints1 refined to a fraction of a pixel.
        probability: (M,) float32, that keypoints1 is within 3 px of the true place of keypoints0 in image 1; calibrated
            on renders: of matches near 0.8 about 80 per cent are right. If image 1 is larger than 1,600 px, pixels here
            are those of the image shrunk to that long side, in which it is matched.
        covariance: (M, 2, 2) float32, pixels squared, of keypoints1 minus that true place, if the match is right.
        index0, index1: (M,) indices of the keypoints in either image, ordered by falling score.
    """

    keypoints0: np.ndarray
    keypoints1: np.ndarray
    probability: np.ndarray
    covariance: np.ndarray
    index0: np.ndarray
    index1: np.ndarray

    def by_probability(self) -> Self:
        """The same, the most probable first."""
        return self.select(np.argsort(-self.probability, kind="stable"))


def match_images(
    image0: np.ndarray,
    image1: np.ndarray,
    frontend: str = "learned",
    max_keypoints: int = 1024,
    min_probability: float = MIN_PROBABILITY,
    provider: str = "cpu",
    weights: WeightsFolder = None,
) -> Matches:
    """Matches between two images of one scene.

    Args:
        image0, image1: (H, W) uint8 grey, of any two sizes from 96 pixels; those whose long side exceeds 1,600 pixels
            are shrunk to it, and the matches are said in the pixels of the images as they are given.
        frontend: "learned", "sift" or "orb".
        max_keypoints: most an image, from 4; the time and memory of matching grow with its square.
        min_probability: of a match; 0 keeps every mutual nearest neighbour, among all keypoints or among those near its
            epipolar line, that the scorer does not refuse.
        provider: where ONNX Runtime computes the networks, one of `sigmaslam.inference.session.PROVIDERS`.
        weights: folder of networks of one's own, as `sigmaslam train export` writes it; for those that it lacks,
            the ones that ship.
    Raises:
        InputError: an image has another shape or type or is too small, an option is out of range, the provider is
            not installed, or the folder holds no network of the front-end, or one that does not fit.
    """
    detect = _detector(frontend, max_keypoints, provider, weights)
    _check_probability(min_probability)
    (image0, pixels0), (image1, pixels1) = _shrunk(_checked(image0, "image0")), _shrunk(_checked(image1, "image1"))
    features0, features1 = detect(image0), detect(image1)
    estimator = ConfidenceEstimator(provider=provider, weights=weights)
    matches = _match_and_doubt(detect, estimator, (image0, image1, features0, features1), min_probability)
    return _enlarged(matches, pixels0, pixels1)


def match_features(
    estimator: ConfidenceEstimator,
    image0: np.ndarray,
    image1: np.ndarray,
    features0: Features,
    features1: Features,
    min_probability: float = MIN_PROBABILITY,
) -> Matches:
    """Mutual nearest neighbours among all keypoints, refined by aligning patches that the neighbours' map warps.

    Args:
        estimator: of the matches.
        image0, image1: (H, W) uint8.
        features0, features1: of these.
        min_probability: as `match_images` takes it.
    """
    putative = nearest_anywhere(features0.descriptors, features1.descriptors)
    matches = _refined(estimator, (image0, image1, features0, features1), putative)
    return matches.select(matches.probability >= min_probability)


def match_twice(
    estimator: ConfidenceEstimator,
    image0: np.ndarray,
    image1: np.ndarray,
    features0: Features,
    features1: Features,
    min_probability: float = MIN_PROBABILITY,
) -> Matches:
    """As `match_features`; keypoints without a probable match are then matched again, near their epipolar lines.

    Between wide baselines the descriptors of a point differ, so that another of a thousand keypoints resembles it more;
    of the twenty near its line it is the most similar one far more often. Probable matches of the first round keep
    their partners, also those that move on their own; all are scored together once more. Where too few matches agree
    on a geometry there is no second round.

    Args:
        as of `match_features`.
    """
    first = match_features(estimator, image0, image1, features0, features1, 0.0)
    probable = first.probability >= MIN_PROBABILITY
    settled = first.select(probable)
    geometry = find_epipolar_geometry(settled.keypoints0, settled.keypoints1)
    if geometry is None:
        return first.select(first.probability >= min_probability)
    putative = nearest_near_lines(geometry, features0, features1, settled.index0, settled.index1)
    second = _refined(estimator, (image0, image1, features0, features1), putative)
    # Improbable matches stay where nothing took their keypoints.
    free = ~probable & ~np.isin(first.index0, second.index0) & ~np.isin(first.index1, second.index1)
    matches = Matches.concatenate([second, first.select(free)]).by_probability()
    return matches.select(matches.probability >= min_probability)


def _match_and_doubt(
    detect: Callable[[np.ndarray], Features], estimator: ConfidenceEstimator, pair: _Pair, min_probability: float
) -> Matches:
    """As `match_twice`; probabilities are lowered, with a warning, where other matches agree with each other as well.

    Either the scene repeats itself, or few match but many would with image 1 upside down: symmetric details then match
    with confidence, a little beside themselves.
    """
    image0, image1, features0, features1 = pair
    matches = match_twice(estimator, *pair, min(min_probability, MIN_PROBABILITY))
    probable = matches.probability >= MIN_PROBABILITY
    count, probability = int(probable.sum()), matches.probability
    if count >= _BELIEVED:
        rivals = count_rivals(features0, features1, matches.index0, matches.index1)
        share = float((rivals[probable] > 0).mean())
        probability = share_with_rivals(probability, rivals, share)
    if probability is not matches.probability:
        _LOGGER.warning(
            "the scene repeats itself: %.0f %% of %d matches fit other places as well; their probabilities are shared",
            100.0 * share,
            count,
        )
    elif count < _FEW_SHARE * min(len(features0.keypoints), len(features1.keypoints)):
        turned = np.ascontiguousarray(image1[::-1, ::-1])
        others = len(match_twice(estimator, image0, turned, features0, detect(turned)).probability)
        if others > max(count, _BELIEVED):
            probability = matches.probability * np.float32(count / (count + others))
            _LOGGER.warning("upside down, image 1 has %d matches and not %d: turn it by 180 degrees", others, count)
    matches = replace(matches, probability=probability).by_probability()
    return matches.select(matches.probability >= min_probability)


def _refined(estimator: ConfidenceEstimator, pair: _Pair, putative: Putative) -> Matches:
    """Putative matches that the scorer does not refuse, aligned, the most probable first."""
    image0, image1, features0, _ = pair

    def refine(points0: np.ndarray, points1: np.ndarray, _: np.ndarray, logit: np.ndarray) -> Refinement:
        return refine_by_neighbours(image0, image1, points0, points1, logit)

    matches = refine_with_confidence(estimator, *pair, putative, refine)
    keypoints, places = features0.keypoints[matches.index0], matches.places.astype(np.float32)
    columns = keypoints, places, matches.probability, matches.covariance, matches.index0, matches.index1
    return Matches(*columns).by_probability()


def match_files(
    path0: Path,
    path1: Path,
    out: Path,
    frontend: str,
    max_keypoints: int,
    min_probability: float = MIN_PROBABILITY,
    picture: Path | None = None,
    provider: str = "cpu",
    weights: Path | None = None,
) -> str:
    """Matches two image files and writes the fields of `Matches` as .npz and optionally a picture; returns a summary.

    Raises:
        InputError: a file cannot be read or written, an image is too small, or an option is out of range.
    """
    for option, path, suffix in (("--out", out, ".npz"), ("--picture", picture, ".png")):
        if path is not None and path.suffix != suffix:
            raise InputError(f"{option} {path} does not end in {suffix}: choose a name that does")
    if picture is not None and picture.resolve() in (path0.resolve(), path1.resolve()):
        raise InputError(f"--picture {picture} would overwrite an image that is to be matched: choose another name")
    detect = _detector(frontend, max_keypoints, provider, weights)
    _check_probability(min_probability)
    estimator = ConfidenceEstimator(provider=provider, weights=weights)
    image0, image1 = (_checked(read_grey(path), str(path)) for path in (path0, path1))
    start = time.perf_counter()
    (small0, pixels0), (small1, pixels1) = _shrunk(image0), _shrunk(image1)
    features0, features1 = detect(small0), detect(small1)
    detected = time.perf_counter()
    matches = _match_and_doubt(detect, estimator, (small0, small1, features0, features1), min_probability)
    matches = _enlarged(matches, pixels0, pixels1)
    end = time.perf_counter()
    with atomic_path(out) as temporary:
        np.savez_compressed(temporary, **asdict(matches))
        if picture is not None:
            atomic_write_bytes(picture, cv2.imencode(".png", draw_matches(image0, image1, matches))[1].tobytes())
    counts = f"{len(features0.keypoints)} and {len(features1.keypoints)} keypoints"
    count = len(matches.probability)
    sigma = np.sqrt(0.5 * np.trace(matches.covariance, axis1=1, axis2=2))
    summary = (
        f"{count} matches, {matches.probability.sum():.0f} expected to be right, median sigma {np.median(sigma):.2f} px"
        if count
        else ""
    )
    milliseconds = f"features {1e3 * (detected - start):.0f} ms, matching {1e3 * (end - detected):.0f} ms"
    return f"{counts}, {summary or 'no matches'}; {milliseconds}"


def draw_matches(image0: np.ndarray, image1: np.ndarray, matches: Matches) -> np.ndarray:
    """Both images (H, W) uint8 side by side, lines from purple (probability 0) to yellow (1); (H, W, 3) BGR.

    Of the matches, best first, those are drawn that lie apart from better ones, at most 60: lines that can be followed.
    """
    palette = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS).reshape(256, 3).tolist()
    apart = _LINE_SPACING * max(image0.shape)
    rows: list[int] = []
    for row, point in enumerate(matches.keypoints0):
        if len(rows) < _MAX_LINES and (np.linalg.norm(matches.keypoints0[rows] - point, axis=1) > apart).all():
            rows.append(row)
    rows.reverse()  # the most probable ones lie on top
    colours = [palette[round(255.0 * float(probability))] for probability in matches.probability[rows]]
    return draw_lines(image0, image1, matches.keypoints0[rows], matches.keypoints1[rows], colours)


def draw_lines(
    image0: np.ndarray, image1: np.ndarray, points0: np.ndarray, points1: np.ndarray, colours: Sequence[Sequence[float]]
) -> np.ndarray:
    """Both images (H, W) uint8 side by side with lines between points (M, 2) in BGR colours, the last on top."""
    (height0, width0), (height1, width1) = image0.shape, image1.shape
    grey = np.zeros((max(height0, height1), width0 + width1), np.uint8)
    grey[:height0, :width0], grey[:height1, width0:] = image0, image1
    canvas = cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR)
    thickness = 1 + canvas.shape[1] // 2000
    for point0, point1, colour in zip(points0, points1 + (width0, 0), colours, strict=True):
        start, end = point0.round().astype(int).tolist(), point1.round().astype(int).tolist()
        cv2.line(canvas, start, end, colour, thickness, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(canvas, place, 3 * thickness, colour, thickness, cv2.LINE_AA)
    return canvas


def _detector(
    frontend: str, max_keypoints: int, provider: str, weights: WeightsFolder
) -> Callable[[np.ndarray], Features]:
    if not isinstance(frontend, str) or frontend not in DETECTORS:
        raise InputError(f"there is no front-end '{frontend}' for two images: choose one of {', '.join(DETECTORS)}")
    if not isinstance(max_keypoints, int | np.integer) or max_keypoints < _MIN_KEYPOINTS:
        raise InputError(f"--max-keypoints is {max_keypoints!r}: give a whole number of at least {_MIN_KEYPOINTS}")
    own_networks(frontend, weights)
    if frontend == "learned":
        return LearnedDetector(max_keypoints, provider=provider, weights=weights)
    return DETECTORS[frontend](max_keypoints)


def _shrunk(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image with a long side of at most `_LONGEST_SIDE`, and how many of its pixels one of the result is, (2,)."""
    size = np.array(image.shape[::-1])
    if size.max() <= _LONGEST_SIDE:
        return image, np.ones(2)
    small = np.maximum(np.round(size * (_LONGEST_SIDE / size.max())).astype(int), min(_MIN_SIDE, size.min()))
    return np.asarray(cv2.resize(image, small.tolist(), interpolation=cv2.INTER_AREA)), size / small


def _enlarged(matches: Matches, pixels0: np.ndarray, pixels1: np.ndarray) -> Matches:
    """Matches of shrunk images in the pixels of the images as they were; factors as of `_shrunk`."""
    # The middle of the first pixel is at 0.
    keypoints0, keypoints1 = (
        ((keypoints + 0.5) * pixels - 0.5).astype(np.float32) if (pixels != 1.0).any() else keypoints
        for keypoints, pixels in ((matches.keypoints0, pixels0), (matches.keypoints1, pixels1))
    )
    covariance = (matches.covariance * np.outer(pixels1, pixels1)).astype(np.float32)
    return replace(matches, keypoints0=keypoints0, keypoints1=keypoints1, covariance=covariance)


def _check_probability(min_probability: float) -> None:
    if not isinstance(min_probability, int | float | np.number) or not 0.0 <= min_probability <= 1.0:
        raise InputError(f"--min-probability is {min_probability!r}: give a number from 0 to 1")


def _checked(image: np.ndarray, name: str) -> np.ndarray:
    check_grey(image, name)
    height, width = image.shape
    if min(height, width) < _MIN_SIDE:
        raise InputError(f"{name} is {width}x{height} pixels: give one of at least {_MIN_SIDE} on each side")
    return image
