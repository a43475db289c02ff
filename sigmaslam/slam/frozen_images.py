"""Images that say nothing: delivered before, in whole or in part, as a working camera never does, or noise alone."""

from __future__ import annotations

from collections import deque
from itertools import pairwise

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE

# Drivers have rings of a few buffers; an image from before those is not given by mistake.
_REMEMBERED = 8
# Rows that are compared first: an old part of an eighth of the image holds two of them.
_PROBES = 16
# Side of the blocks whose means are compared, pixels.
_BLOCK = 8
# Share of neighbouring pixels that differ, in what is no even surface: in noise almost all do.
_VARIED = 0.1
# Grey values: no sensor is noisier in the dark.
_MOST_NOISE = 32.0


class LastPairs:
    """The raw images of the last frames."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[_Probed, _Probed]] = deque(maxlen=_REMEMBERED)
        self._was_old = False

    def is_repeated(self, left: np.ndarray, right: np.ndarray) -> bool:
        """Whether one of the images shows the last one, to the byte, or one not long before it, at least in part.

        A torn image shows two moments, and the scene has one pose in each. Several old ones in a row are no driver's
        fault but a recording that is played back and forth. An image of one grey value alone says nothing: a covered
        camera gives it again and again. The pair becomes the last.

        Args:
            left, right: (H, W) uint8.
        """
        pair = _Probed(left), _Probed(right)
        same = [any(map(_shows, pair, other)) for other in self._pairs]
        self._pairs.append(pair)
        is_last, is_old = bool(same and same[-1]), any(same[:-1])
        is_repeated = is_last or (is_old and not self._was_old)
        self._was_old = is_old and not is_last
        return is_repeated


def is_noise(image: np.ndarray) -> bool:
    """Whether an (H, W) uint8 image is white noise alone, which fits landmarks by chance where they are expected.

    Means of blocks of white noise differ as its pixels do, in proportion; those of scenes differ by far more.
    """
    rows, columns = (max(size // _BLOCK, 2) for size in image.shape)
    tall, broad = image.shape[0] // rows, image.shape[1] // columns
    whole = image[: rows * tall, : columns * broad].astype(np.float32)
    blocks = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA)
    steps = cv2.absdiff(image[:, 1:], image[:, :-1])
    between, within = float(np.mean(np.diff(blocks, axis=1) ** 2)), cv2.norm(steps, cv2.NORM_L2SQR) / steps.size
    # Neither a few bright pixels of a black image nor more than any sensor's noise.
    is_possible = cv2.countNonZero(steps) > _VARIED * steps.size and within < 2.0 * _MOST_NOISE**2
    return bool(is_possible and tall * broad * between < ACCEPTANCE.noise_contrast * within)


class _Probed:
    """A copy of an image (H, W) uint8, for callers may fill the same array again, and some of its rows as bytes."""

    def __init__(self, image: np.ndarray) -> None:
        self.pixels = image.copy()
        self.step = max(len(image) // _PROBES, 1)
        self.rows = [row.tobytes() for row in self.pixels[:: self.step]]


def _shows(image: _Probed, other: _Probed) -> bool:
    """Whether an eighth of the image or more, in rows one below another, is as in another one, to the byte."""
    if image.pixels.shape != other.pixels.shape:
        return False
    same = [one == another for one, another in zip(image.rows, other.rows, strict=True)]
    for probe, pair in enumerate(pairwise(same)):
        if not all(pair):
            continue
        some = slice(probe * image.step, (probe + 1) * image.step + 1)
        pixels = image.pixels[some]
        varied = np.count_nonzero(np.diff(pixels, axis=1)) > _VARIED * pixels.size
        if varied and np.array_equal(pixels, other.pixels[some]):
            return True
    return False
