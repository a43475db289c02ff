"""Images that say nothing: delivered before, as a working camera never does, or noise alone, as in the dark."""

from __future__ import annotations

from collections import deque

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE

# Drivers have rings of a few buffers; an image from before those is not given by mistake.
_REMEMBERED = 8
# Side of the blocks whose means are compared, pixels.
_BLOCK = 8
# Grey values: no sensor is noisier in the dark.
_MOST_NOISE = 32.0


class LastPairs:
    """The raw images of the last frames."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[np.ndarray, np.ndarray]] = deque(maxlen=_REMEMBERED)
        self._was_old = False

    def is_repeated(self, left: np.ndarray, right: np.ndarray) -> bool:
        """Whether one of the images is the last one, to the byte, or one not long before it; the pair becomes the last.

        Several old ones in a row are no driver's fault but a recording that is played back and forth. An image of one
        grey value alone says nothing: a covered camera gives it again and again.

        Args:
            left, right: (H, W) uint8.
        """
        same = [_is_same(left, other[0]) or _is_same(right, other[1]) for other in self._pairs]
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
    is_possible = cv2.countNonZero(steps) > 0.1 * steps.size and within < 2.0 * _MOST_NOISE**2
    return bool(is_possible and tall * broad * between < ACCEPTANCE.noise_contrast * within)


def _is_same(image: np.ndarray, other: np.ndarray) -> bool:
    middle = len(image) // 2
    if image.shape != other.shape or not np.array_equal(image[middle], other[middle]):
        return False
    return np.array_equal(image, other) and bool((image != image.flat[0]).any())
