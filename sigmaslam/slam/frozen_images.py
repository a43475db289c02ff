"""Images that say nothing: delivered before, in whole or in part, as a working camera never does, or noise alone."""

from __future__ import annotations

from collections import deque

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
        self._pairs: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=_REMEMBERED)
        self._was_old = False

    def is_repeated(self, left: np.ndarray, right: np.ndarray) -> bool:
        """Whether one of the images shows the last one, to the byte, or one not long before it, at least in part.

        A torn image shows two moments, and the scene has one pose in each. Several old ones in a row are no driver's
        fault but a recording that is played back and forth. An image of one grey value alone says nothing: a covered
        camera gives it again and again. The pair becomes the last.

        Args:
            left, right: (H, W) uint8.
        """
        same = [_shows(left, other[0]) or _shows(right, other[1]) for other in self._pairs]
        # Callers may fill the same arrays again.
        self._pairs.append((left.copy(), right.copy()))
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


def _shows(image: np.ndarray, other: np.ndarray) -> bool:
    """Whether an eighth of the image or more, in rows one below another, is as in another one, to the byte."""
    if image.shape != other.shape:
        return False
    step = max(len(image) // _PROBES, 1)
    same = (image[::step] == other[::step]).all(axis=1)
    for probe in np.flatnonzero(same[1:] & same[:-1]).tolist():
        rows = slice(probe * step, (probe + 1) * step + 1)
        varied = np.count_nonzero(np.diff(image[rows], axis=1)) > _VARIED * image[rows].size
        if varied and np.array_equal(image[rows], other[rows]):
            return True
    return False
