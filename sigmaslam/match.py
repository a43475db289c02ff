"""Two images in, matches with a probability and a covariance out: `sigmaslam match`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path, atomic_write_bytes
from sigmaslam.frontend.affine import align_patches, local_maps
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.matching import nearest_anywhere
from sigmaslam.frontend.types import Features
from sigmaslam.readers.images import read_grey

_DETECTORS = {"learned": LearnedDetector, "sift": SiftDetector, "orb": OrbDetector}
# Learned: that of the network's training (`match_loss`). RootSIFT has no negative numbers, its similarities lie closer
# together: 60 has the least Brier score on rendered pairs (20: 0.58, 40: 0.16, 60: 0.10, 80: 0.12).
_INVERSE_TEMPERATURES = {"sift": 60.0}
_INVERSE_TEMPERATURE = 20.0
# Chosen by hand on warped photographs and rectified pairs, the sets for selection.
_AGREEMENT = 4.0
_SIGMA_ALIGNED = 0.3
_LEAST_SIDE = 96
_LEAST_KEYPOINTS = 4
_MOST_LINES = 200


@dataclass(frozen=True, slots=True)
class Matches:
    """Correspondences between two images, one to one, the most probable first.

    Attributes:
        keypoints0, keypoints1: (M, 2) float32 pixel coordinates (u, v) in image 0 and 1, as the images are stored.
        probability: (M,) float32 in (0, 1], the dual softmax over all keypoints. It ranks matches but is not yet
            calibrated: of those near 0.8, not 80 per cent need be right.
        covariance: (M, 2, 2) float32, pixels squared, of keypoints1 minus the true place of keypoints0 in image 1, if
            the match is right: (0.3 px)^2 I after refinement, else (sigma0^2 + sigma1^2) I, which takes both images to
            have about the same scale.
    """

    keypoints0: np.ndarray
    keypoints1: np.ndarray
    probability: np.ndarray
    covariance: np.ndarray


def match_images(
    image0: np.ndarray, image1: np.ndarray, frontend: str = "learned", max_keypoints: int = 1024, refine: bool = True
) -> Matches:
    """Matches between two images of one scene.

    Args:
        image0, image1: (H, W) uint8 grey, of any two sizes from 96 pixels.
        frontend: "learned", "sift" or "orb".
        max_keypoints: most an image, from 4; the time and memory of matching grow with its square.
        refine: as `refine_matches` does; without it every mutual nearest neighbour is a match.
    Raises:
        InputError: an image has another shape or type or is too small, or an option is out of range.
    """
    detect = _detector(frontend, max_keypoints)
    features0, features1 = detect(_checked(image0, "image0")), detect(_checked(image1, "image1"))
    matches = match_features(features0, features1, temperature_of(frontend))
    return refine_matches(image0, image1, matches) if refine else matches


def temperature_of(frontend: str) -> float:
    """Factor on the similarity of descriptors before the softmax, by name of what made them."""
    return _INVERSE_TEMPERATURES.get(frontend, _INVERSE_TEMPERATURE)


def match_features(features0: Features, features1: Features, inverse_temperature: float) -> Matches:
    """Mutual nearest neighbours among all keypoints of two images; exact ties are no match."""
    descriptors0, descriptors1 = features0.descriptors, features1.descriptors
    putative = nearest_anywhere(descriptors0, descriptors1)
    index0, index1 = putative.index0[putative.mutual], putative.index1[putative.mutual]
    # No similarity of unit vectors exceeds 1: no overflow. A mutual neighbour is the largest of its row and column.
    weight = np.exp(inverse_temperature * (descriptors0 @ descriptors1.T - 1.0))
    chosen = weight[index0, index1]
    probability = (chosen / weight.sum(axis=1)[index0]) * (chosen / weight.sum(axis=0)[index1])
    order = np.argsort(-probability, kind="stable")
    index0, index1 = index0[order], index1[order]
    variance = features0.sigma[index0] ** 2 + features1.sigma[index1] ** 2
    covariance = variance[:, None, None] * np.eye(2, dtype=np.float32)
    return Matches(features0.keypoints[index0], features1.keypoints[index1], probability[order], covariance)


def refine_matches(image0: np.ndarray, image1: np.ndarray, matches: Matches) -> Matches:
    """The matches that agree with their neighbours to 4 px, moved to where the patches, warped as these say, fit best.

    Where the patches do not fit, the match is dropped: nine in ten of them are wrong.

    Args:
        image0, image1: (H, W) uint8.
        matches: mutual nearest neighbours.
    """
    points0, points1 = (points.astype(np.float64) for points in (matches.keypoints0, matches.keypoints1))
    A, distance = local_maps(points0, points1, matches.probability.astype(np.float64))
    agree = np.flatnonzero(distance < _AGREEMENT)
    places, fitting = align_patches(image0, image1, points0[agree], points1[agree], A[agree])
    kept = agree[fitting]
    covariance = np.tile(_SIGMA_ALIGNED**2 * np.eye(2, dtype=np.float32), (len(kept), 1, 1))
    return Matches(matches.keypoints0[kept], places[fitting].astype(np.float32), matches.probability[kept], covariance)


def match_files(
    path0: Path,
    path1: Path,
    out: Path,
    frontend: str,
    max_keypoints: int,
    refine: bool = True,
    picture: Path | None = None,
) -> str:
    """Matches two image files, writes the fields of `Matches` as .npz and perhaps a picture; returns a summary.

    Raises:
        InputError: a file cannot be read or written, an image is too small, or an option is out of range.
    """
    for option, path, suffix in (("--out", out, ".npz"), ("--picture", picture, ".png")):
        if path is not None and path.suffix != suffix:
            raise InputError(f"{option} {path} does not end in {suffix}: choose a name that does")
    if picture is not None and picture.resolve() in (path0.resolve(), path1.resolve()):
        raise InputError(f"--picture {picture} would overwrite an image that is to be matched: choose another name")
    detect = _detector(frontend, max_keypoints)
    image0, image1 = (_checked(read_grey(path), str(path)) for path in (path0, path1))
    start = time.perf_counter()
    features0, features1 = detect(image0), detect(image1)
    detected = time.perf_counter()
    matches = match_features(features0, features1, temperature_of(frontend))
    if refine:
        matches = refine_matches(image0, image1, matches)
    end = time.perf_counter()
    with atomic_path(out) as temporary:
        np.savez_compressed(temporary, **asdict(matches))
        if picture is not None:
            atomic_write_bytes(picture, cv2.imencode(".png", draw_matches(image0, image1, matches))[1].tobytes())
    counts = f"{len(features0.keypoints)} and {len(features1.keypoints)} keypoints"
    count = len(matches.probability)
    found = f"{count} matches, median sigma {np.sqrt(np.median(matches.covariance[:, 0, 0])):.2f} px" if count else ""
    milliseconds = f"features {1e3 * (detected - start):.0f} ms, matching {1e3 * (end - detected):.0f} ms"
    return f"{counts}, {found or 'no matches'}; {milliseconds}"


def draw_matches(image0: np.ndarray, image1: np.ndarray, matches: Matches) -> np.ndarray:
    """Both images (H, W) uint8 side by side, lines from purple (probability 0) to yellow (1); (H, W, 3) BGR.

    Of many matches 200 are drawn, evenly chosen from the first to the last.
    """
    palette = cv2.applyColorMap(np.arange(256, dtype=np.uint8), cv2.COLORMAP_VIRIDIS).reshape(256, 3).tolist()
    count = len(matches.probability)
    # The most probable last: their lines lie on top.
    rows = np.linspace(count - 1, 0, min(count, _MOST_LINES)).round().astype(int)
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


def _detector(frontend: str, max_keypoints: int) -> Callable[[np.ndarray], Features]:
    if frontend not in _DETECTORS:
        raise InputError(f"there is no front-end '{frontend}' for two images: choose one of {', '.join(_DETECTORS)}")
    if max_keypoints < _LEAST_KEYPOINTS:
        raise InputError(f"--max-keypoints is {max_keypoints}: give at least {_LEAST_KEYPOINTS}")
    return _DETECTORS[frontend](max_keypoints)


def _checked(image: np.ndarray, name: str) -> np.ndarray:
    if image.ndim != 2 or image.dtype != np.uint8:
        raise InputError(f"{name} is {image.dtype} of shape {image.shape}: give a grey (H, W) uint8 image")
    height, width = image.shape
    if min(height, width) < _LEAST_SIDE:
        raise InputError(f"{name} is {width}x{height} pixels: give one of at least {_LEAST_SIDE} on each side")
    return image
