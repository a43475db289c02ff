"""What single images show, without matching: light, contrast, sharpness, and one image given for both eyes."""

from collections.abc import Sequence

import cv2
import numpy as np

from sigmaslam.checks.finding import Finding
from sigmaslam.frontend.image_sharpness import sharpness
from sigmaslam.readers.stereo_sequence import StereoFrame
from sigmaslam.slam.frozen_images import MAX_ALTERNATION, alternation

# Grey values at which a camera clips, and the shares of the pixels that may.
_DARK, _BRIGHT = 5, 250
_WARN_CLIPPED, _MAX_CLIPPED = 0.5, 0.95
# Contrast below the steps of 8 bits: difference of the 99th and the 1st percentile.
_MIN_CONTRAST = 10
# Standard deviation of the blur of edges, pixels: from here on rows of matches scatter twice as much as in sharp ones,
# in renders of rooms that are blurred by a Gaussian of 3 px. Matches remain.
_WARN_BLUR = 2.0
# Mean grey values of good pairs differ by up to 1.2 times (KITTI, EuRoC); at 3 times poses of KITTI are wrong.
_MAX_LIGHT = 2.0
# Grey values by which pixels of an overlay change at most, by noise and compression, and that its edges span at least;
# the share of the pixels that are such: recordings and renders have up to 0.00024 by chance, a line of text 0.0007.
_STILL, _EDGE, _WARN_STILL = 10, 60, 0.0005
# Images are one and the same where they differ by less than the noise of two cameras, grey values.
_SAME = 0.5
EYES = ("left", "right")


def check_images(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[Finding]:
    """Findings from pairs of images, left and right (H, W) uint8, as they are stored."""
    return [_check_exposure(pairs), _check_sharpness(pairs), _check_lines(pairs), _check_same(pairs)]


def _check_exposure(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Finding:
    """The worst of dark, bright and without contrast in the median pair, of either eye."""
    worst = Finding("exposure", "ok", "", 0.0)
    for eye, name in enumerate(EYES):
        images = [pair[eye] for pair in pairs]
        contrast = float(np.median([_contrast(image) for image in images]))
        for clipped, what, cure in (
            ([(image <= _DARK).mean() for image in images], "black", "light, aperture or exposure time; lens cap on?"),
            ([(image >= _BRIGHT).mean() for image in images], "over-exposed", "expose for a shorter time"),
        ):
            share = float(np.median(clipped))
            if share > _WARN_CLIPPED and share > (worst.figure or 0.0):
                worst = Finding(
                    "exposure",
                    "error" if share > _MAX_CLIPPED else "warning",
                    f"{100 * share:.0f} % of the pixels of the {name} images are {what}: {cure}",
                    share,
                )
        if contrast < _MIN_CONTRAST and worst.severity != "error":
            worst = Finding(
                "exposure",
                "error",
                f"grey values of the {name} images span {contrast:.0f} of 255: nothing can be seen in them",
                contrast,
            )
    if worst.severity == "ok":
        clipped = [((image <= _DARK) | (image >= _BRIGHT)).mean() for pair in pairs for image in pair]
        share = float(np.median(clipped))
        return Finding("exposure", "ok", f"{100 * share:.0f} % of the pixels are black or over-exposed", share)
    return worst


def _contrast(image: np.ndarray) -> float:
    low, high = np.percentile(image, (1, 99))
    return float(high - low)


def blur_radius(image: np.ndarray) -> float:
    """Standard deviation of a Gaussian blur of step edges that are as sharp as those of an (H, W) uint8 image, pixels.

    The energy of the second derivative of such an edge is that of the first over twice the variance; `sharpness` takes
    the first derivative twice as large.
    """
    return float(1.0 / np.sqrt(8.0 * max(sharpness(image), 1e-6)))


def check_overlay(frames: Sequence[StereoFrame]) -> Finding:
    """Whether edges stay where they are in both images while most of the scene's move."""
    pairs = [(frame.left, frame.right) for frame in frames]
    if len(pairs) < 3 or len({image.shape for pair in pairs for image in pair}) > 1:
        return Finding("overlay", "ok", "too few images of one size to tell what stays in them")
    images, square = np.array(pairs), np.ones((3, 3), np.uint8)
    stays = (np.ptp(images, axis=0) <= _STILL).all(axis=0)
    for frame in frames:
        if frame.mask is not None:
            stays &= frame.mask > 0
    left, right = (cv2.morphologyEx(image, cv2.MORPH_GRADIENT, square) >= _EDGE for image in images[0])
    still = stays & left & right
    share = float(still.mean())
    if share <= _WARN_STILL or (left & stays).sum() > 0.5 * left.sum():
        return Finding("overlay", "ok", f"{100 * share:.2f} % of the pixels are edges that stay in both images", share)
    v, u = (np.percentile(each, (1, 99)).astype(int) for each in np.nonzero(still))
    message = (
        f"edges in columns {u[0]} to {u[1]} and rows {v[0]} to {v[1]} stay where they are while the scene moves: text, "
        "a rim or dirt in both images, which holds poses still: leave it out with --mask"
    )
    return Finding("overlay", "warning", message, share)


def light_ratio(frame: StereoFrame) -> float:
    """Light of the left eye over that of the right one, by some of their pixels."""
    left, right = (float(image[::4, ::4].mean()) for image in (frame.left, frame.right))
    return (1.0 + left) / (1.0 + right)


def check_light(seconds: Sequence[float], ratios: np.ndarray, most: float = 0.0) -> Finding:
    """Whether one eye is darker than the other, in more than a share of the frames.

    Args:
        seconds: of the frames.
        ratios: (N,) as of `light_ratio`.
    """
    uneven = np.flatnonzero(np.maximum(ratios, 1.0 / ratios) > _MAX_LIGHT)
    if len(uneven) <= most * len(ratios):
        ratio = float(np.median(ratios))
        return Finding("light", "ok", f"left images are {ratio:.2f} times as bright as right ones", ratio)
    ratio = float(np.median(ratios[uneven]))
    dark, times = ("right", ratio) if ratio > 1.0 else ("left", 1.0 / ratio)
    message = (
        f"the {dark} eye is {times:.1f} times darker than the other in {describe_frames(seconds, uneven)}: give both "
        "the same exposure, gain and aperture"
    )
    return Finding("light", "warning", message, ratio)


def describe_frames(seconds: Sequence[float], chosen: np.ndarray) -> str:
    """How many frames of those that were looked at, at `seconds`, are meant, and when, by their indices."""
    first, last = (seconds[k] - seconds[0] for k in chosen[[0, -1]])
    return f"{len(chosen)} of {len(seconds)} frames that were looked at ({first:.1f} to {last:.1f} s)"


def _check_sharpness(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Finding:
    if any(_contrast(image) < _MIN_CONTRAST for pair in pairs for image in pair):
        return Finding("sharpness", "unknown", "images without contrast have no edges")
    blurs = [float(np.median([blur_radius(pair[eye]) for pair in pairs])) for eye in range(2)]
    worse = int(np.argmax(blurs))
    blur = blurs[worse]
    if blur <= _WARN_BLUR:
        return Finding("sharpness", "ok", f"edges are blurred by {blur:.1f} px", blur)
    message = (
        f"edges of the {EYES[worse]} images are blurred by {blur:.1f} px ({EYES[1 - worse]} {blurs[1 - worse]:.1f}): "
        "focus, clean the lens, move slowly, expose for a shorter time, or use smaller images"
    )
    return Finding("sharpness", "warning", message, blur)


def _check_lines(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Finding:
    """Whether rows are of two moments, or pixels of several colours, in turn."""
    lines = [[(alternation(image), alternation(image.T)) for image in pair] for pair in pairs]
    rows, columns = np.median(lines, axis=0).max(axis=0).tolist()
    figure = f"neighbouring rows differ {rows:.2f} times as much as every other one"
    if rows <= MAX_ALTERNATION:
        return Finding("lines", "ok", figure, rows)
    what = (
        "interlaced video, whose even and odd rows are of two moments: even ones alone are tracked; deinterlace it"
        if columns <= MAX_ALTERNATION
        else "the raw mosaic of a colour sensor: convert it to colour or grey"
    )
    return Finding("lines", "warning", f"{figure}: {what}", rows)


def _check_same(pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> Finding:
    if any(left.shape != right.shape for left, right in pairs):
        return Finding("same image", "ok", "the eyes have images of different sizes")
    difference = float(np.median([np.abs(left.astype(np.int16) - right).mean() for left, right in pairs]))
    if difference < _SAME and float(np.median([left.std() for left, _ in pairs])) > _SAME:
        message = (
            f"left and right images are the same (they differ by {difference:.2f} grey values): give the images of "
            "both cameras"
        )
        return Finding("same image", "error", message, difference)
    return Finding("same image", "ok", f"left and right images differ by {difference:.1f} grey values", difference)
