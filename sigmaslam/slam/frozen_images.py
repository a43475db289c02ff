"""Images that say nothing, delivered before, in whole or in part, or noise alone; and those of two moments."""

from collections import deque
from itertools import pairwise

import cv2
import numpy as np

from sigmaslam.estimation.acceptance import ACCEPTANCE

# Drivers have rings of a few buffers; an image from before those is not given by mistake.
_REMEMBERED = 8
# Rows that are compared first: an old part of an eighth of the image holds two of them.
_PROBES = 16
# Side of the blocks whose means are compared, pixels, and rows of them at a time.
_BLOCK, _BAND = 8, 8
# Share of neighbouring pixels that differ, in what is no even surface: in noise almost all do.
_VARIED = 0.1
# Grey values: no sensor is noisier in the dark.
_MOST_NOISE = 32.0
# Pixels sideways between even and odd rows: at most 0.1 in six recordings, 0.32 in noise alone and in shrunk images.
_FIELDS = 0.35
# Differences of neighbouring lines over those of every other one: 0.56 to 0.69 in seven recordings, 0.98 in noise of 25
# grey values, 1.3 to 22 where fields are interlaced, 2.5 to 23 where the pixels of a line have colours in turn.
MAX_ALTERNATION = 1.15
# So many frames are looked at, then one in so many: a camera shows its fields whenever it moves.
_LOOKED_AT = 8
# Cells that are compared, down and across, and two sides of blocks in them, pixels.
_CELLS, _SIDES = (6, 8), (2, 8)


class LastPairs:
    """The raw images of the last frames."""

    def __init__(self) -> None:
        self._pairs: deque[tuple[_Probed, _Probed]] = deque(maxlen=_REMEMBERED)
        self._was_old, self._is_interlaced, self._frames = False, False, 0

    def of_one_moment(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Copies of images (H, W) uint8: even rows and what is between them once both are seen to be interlaced."""
        pair = np.array(left), np.array(right)
        if not self._is_interlaced and (self._frames < _LOOKED_AT or self._frames % _LOOKED_AT == 0):
            self._is_interlaced = all(map(_shows_fields, pair))
        self._frames += 1
        for image in pair if self._is_interlaced else ():
            image[1:-1:2] = 0.5 * image[:-2:2] + 0.5 * image[2::2] + 0.5
        return pair

    def is_repeated(self, left: np.ndarray, right: np.ndarray) -> bool:
        """Whether one of the images shows the last one, to the byte, or one not long before it, at least in part.

        A torn image shows two moments, and the scene has one pose in each. Several old ones in a row are no driver's
        fault but a recording that is played back and forth. An image of one grey value alone says nothing: a covered
        camera gives it again and again, and so does a part that is in all of them, as a panel of text. The pair becomes
        the last.

        Args:
            left, right: (H, W) uint8, as of `of_one_moment`.
        """
        pair = _Probed(left), _Probed(right)
        same, rows = [False] * len(self._pairs), pair[0].distinct | pair[1].distinct
        if not all(rows.isdisjoint(eye.distinct) for other in self._pairs for eye in other):
            panels = [_rows_in_all(one, [other[eye] for other in self._pairs]) for eye, one in enumerate(pair)]
            same = [any(map(_shows, pair, other, panels)) for other in self._pairs]
        self._pairs.append(pair)
        is_last, is_old = bool(same and same[-1]), any(same[:-1])
        is_repeated = is_last or (is_old and not self._was_old)
        self._was_old = is_old and not is_last
        return is_repeated


def is_noise(image: np.ndarray) -> bool:
    """Whether an (H, W) uint8 image is white noise alone, which fits landmarks by chance where they are expected.

    Means of blocks of white noise differ as its pixels do, in proportion; those of scenes differ by far more.
    """
    steps = cv2.absdiff(image[:, 1:], image[:, :-1])
    within = cv2.norm(steps, cv2.NORM_L2SQR) / steps.size
    # Neither a few bright pixels of a black image nor more than any sensor's noise.
    if cv2.countNonZero(steps) <= _VARIED * steps.size or within >= 2.0 * _MOST_NOISE**2:
        return False
    rows, columns = (max(size // _BLOCK, 2) for size in image.shape)
    tall, broad = image.shape[0] // rows, image.shape[1] // columns
    left = ACCEPTANCE.noise_contrast * within * rows * (columns - 1) / (tall * broad)
    for top in range(0, rows, _BAND):  # the first one tells most scenes
        count = min(_BAND, rows - top)
        band = image[top * tall : (top + count) * tall, : columns * broad].astype(np.float32)
        blocks = cv2.resize(band, (columns, count), interpolation=cv2.INTER_AREA)
        left -= float(np.sum(np.diff(blocks, axis=1) ** 2))
        if left <= 0.0:
            return False
    return True


def shows_motion(before: np.ndarray, now: np.ndarray) -> bool:
    """Whether most of an image (H, W) uint8 has changed, whatever noise and light do, though some of it may stay.

    Gain and offset of each cell are fitted. What they leave is white where it is noise: means of blocks have less.
    """
    changes, contrasts = [], []
    for side in _SIDES:
        size = tuple(cells * (length // (cells * side)) for cells, length in zip(_CELLS, now.shape, strict=True))
        if min(size) < min(_CELLS) * 4:
            return False
        cells = [
            cv2.resize(each, size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32) for each in (before, now)
        ]
        one, other = (each.reshape(_CELLS[0], size[0] // _CELLS[0], _CELLS[1], -1) for each in cells)
        one, other = (each - each.mean(axis=(1, 3), keepdims=True) for each in (one, other))
        contrasts.append((other**2).mean(axis=(1, 3)))
        shared = (one * other).mean(axis=(1, 3)) ** 2 / np.maximum((one**2).mean(axis=(1, 3)), 1e-3)
        changes.append(contrasts[-1] - shared)
    scene, changed = (4 * coarse > fine for fine, coarse in (contrasts, changes))
    changed &= scene & (changes[1] > ACCEPTANCE.changed_image * contrasts[1])
    return bool(2 * changed.sum() > scene.sum() > 0)


def alternation(image: np.ndarray) -> float:
    """Mean difference of neighbouring rows of an (H, W) uint8 image over that of every other one."""
    near, far = (cv2.norm(image[by:], image[:-by], cv2.NORM_L1) / image[by:].size for by in (1, 2))
    return near / max(far, 1e-3)


def _shows_fields(image: np.ndarray) -> bool:
    """Whether odd rows of an (H, W) uint8 image are aside of what is between even ones, or nothing like it."""
    size = image.shape[1] // 2, (len(image) - 2) // 4
    if min(size) < 25:  # in so few noise is by chance (64x48: 111 of 200 pairs, 160x120: none)
        return False
    above, odd, below = (cv2.resize(image[k::4][: size[1]], size) for k in range(3))
    between = cv2.addWeighted(above, 0.5, below, 0.5, 0.0, dtype=cv2.CV_32F)
    slope = cv2.Sobel(between, cv2.CV_32F, 1, 0, ksize=1)
    products = slope * cv2.subtract(odd, between, dtype=cv2.CV_32F), slope * slope
    parts = [cv2.resize(each, (4, 3), interpolation=cv2.INTER_AREA) for each in products]
    is_aside = 4.0 * np.abs(parts[0]) > _FIELDS * parts[1]
    return bool(alternation(image) > MAX_ALTERNATION or 2 * is_aside.sum() > is_aside.size)


class _Probed:
    """An image (H, W) uint8 that nobody fills again, and some of its rows as bytes."""

    def __init__(self, image: np.ndarray) -> None:
        self.pixels = image
        self.step = max(len(image) // _PROBES, 1)
        self.rows = [row.tobytes() for row in self.pixels[:: self.step]]
        self.distinct = frozenset(self.rows)


def _rows_in_all(image: _Probed, others: list[_Probed]) -> np.ndarray:
    """(P,) bool, which of the rows are in all of the others, where some rows are not."""
    same = np.array([[one == row for one, row in zip(other.rows, image.rows, strict=False)] for other in others])
    return np.asarray(same.all(axis=0) & ~same.all())


def _shows(image: _Probed, other: _Probed, panel: np.ndarray) -> bool:
    """Whether an eighth of the image, in rows one below another, is as in another one; rows of a panel do not count."""
    same = [one == another and not fixed for one, another, fixed in zip(image.rows, other.rows, panel, strict=True)]
    for probe, pair in enumerate(pairwise(same)):
        if not all(pair):
            continue
        some = slice(probe * image.step, (probe + 1) * image.step + 1)
        pixels = image.pixels[some]
        varied = np.count_nonzero(np.diff(pixels, axis=1)) > _VARIED * pixels.size
        if varied and np.array_equal(pixels, other.pixels[some]):
            return True
    return False
