"""A stereo sequence: checked when it is opened, then read ahead in the background."""

import logging
import queue
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from copy import copy
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from sigmaslam.errors import CalibrationError, FrameError, InputError
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.readers.images import MAX_FAILURES, GreyConverter, ImagePairs, PairSource, RawPair, SkippedFrame
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam.readers.masks import Masks
from sigmaslam.readers.odometry import OdometryRecording
from sigmaslam.readers.selection import Selection, select_pairs

logger = logging.getLogger(__name__)

READ_AHEAD = 4
SAMPLED_EVERY = 5
"""Of a sequence that is read in order, one of so many frames is sampled."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """One stereo pair.

    Attributes:
        index: number of the pair in the sequence; skipped pairs leave a gap.
        timestamp: seconds.
        left, right: (H, W) uint8 grey images, as stored (not rectified here).
        mask: (H, W) uint8, zero where the left image is not to be used; None: use all of it.
        colour: (H, W, 3) uint8 of the left image in OpenCV's order, of the size that is stored; None where the
            recording has none.
    """

    index: int
    timestamp: float
    left: np.ndarray
    right: np.ndarray
    mask: np.ndarray | None = None
    colour: np.ndarray | None = None


FrameStep = tuple[StereoFrame, StereoFrame | None]
"""A frame and the one after it; None where that is missing or cannot be read."""


# Pixels that images may be shrunk to: one cell of the coarsest map of the features.
_MIN_SIDE = 32


class StereoSequence:
    """Stereo pairs with their calibration.

    Attributes:
        camera: calibration of the frames: of the images as stored, or of those that `select` makes smaller.
        source: the file or folder, or the name of a camera.
        format: 'kitti', 'euroc', '4seasons', 'folder', 'video', 'bag' or 'camera'.
        timestamps: seconds, one per pair, or None if only reading gives them (videos).
        length: number of pairs, or None if the file does not give it.
        skipped: the pairs that the latest run of `frames` could not use.
        masks: of the left images, as `use_masks` took them.
        imu, odometry: sensors of motion that were recorded beside the images, where they are to be used.

    Raises:
        CalibrationError: the first images have another size than the calibration (the message gives both).
        InputError: no image can be read.
    """

    def __init__(
        self, pairs: PairSource, camera: StereoCamera, source: Path | str, format: str, scale: float = 1.0
    ) -> None:
        self.camera = camera if scale == 1.0 else camera.scaled(scale)
        sides = self.camera.left.width, self.camera.left.height
        if scale < 1.0 and min(sides) < _MIN_SIDE:
            least = _MIN_SIDE / min(camera.left.width, camera.left.height)
            raise InputError(
                f"--scale {scale:g} leaves {sides[0]}x{sides[1]} pixels, too few to track: give at least {least:.2g}"
            )
        self._stored = camera
        self.source = source
        self.format = format
        self.timestamps = pairs.timestamps
        self.length = pairs.length
        self.skipped: list[SkippedFrame] = []
        self._pairs = pairs
        self._grey = GreyConverter()
        self.masks: Masks | None = None
        self.imu: InertialRecording | None = None
        self.odometry: OdometryRecording | None = None
        first = pairs.first_pair
        for eye, image, name, model in (
            ("left", first.left, first.left_name, camera.left),
            ("right", first.right, first.right_name, camera.right),
        ):
            mismatch = _size_mismatch(image, model)
            if mismatch:
                raise CalibrationError(
                    f"{name}: {eye} {mismatch}; give the calibration made at the size of these images"
                )
            # The first image sets the scale of 16-bit images, so that every run gives the same pixels.
            try:
                self._grey.convert(image, name)
            except FrameError as error:
                raise InputError(str(error)) from None

    def select(self, selection: Selection, scale: float = 1.0) -> "StereoSequence":
        """A part of the sequence, with images so many times as large as those that are stored.

        Raises:
            InputError: none of its pairs is in the sequence, or can be read.
        """
        pairs = select_pairs(self._pairs, selection, self.source)
        return StereoSequence(pairs, self._stored, self.source, self.format, scale)

    def at(self, times: np.ndarray) -> "StereoSequence":
        """The first pairs from each of these times on, seconds; all pairs where they must be read in order."""
        some, pairs, stamps = copy(self), self._pairs, self.timestamps or []
        rows = np.unique(np.searchsorted(stamps, times))
        if isinstance(pairs, ImagePairs) and rows[-1] < len(stamps):
            some.timestamps, some.length = [stamps[row] for row in rows], len(rows)
            some._pairs = ImagePairs([pairs.files[row] for row in rows], some.timestamps, Path(pairs.source))
        return some

    def use_masks(self, path: Path) -> None:
        """Takes a mask of the left images as they are stored, or a folder with one for each; see `Masks`.

        Raises:
            InputError: the path is missing, a frame has no mask, or the mask of the first one cannot be used.
        """
        files = [left for left, _ in self._pairs.files] if isinstance(self._pairs, ImagePairs) else None
        self.masks = Masks(path, files, self._stored.left.width, self._stored.left.height)

    @property
    def dropped(self) -> int:
        """Number of pairs of a live camera that the consumer missed; 0 for recordings."""
        return 0

    def frames(self) -> Generator[StereoFrame, None, None]:
        """Pairs in order, read ahead by a thread that ends with the iteration, however that ends.

        A pair with an image that is missing, broken or of another size is left out, logged as a warning and
        noted in `skipped`.

        Raises:
            InputError: more than `MAX_FAILURES` pairs in a row fail, or none can be read.
        """
        self.skipped = []
        failures, any_read = 0, False
        with closing(self._items()) as items:
            for item in items:
                if isinstance(item, StereoFrame):
                    failures, any_read = 0, True
                    yield item
                    continue
                failures += 1
                self.skipped.append(item)
                logger.warning("pair %d is skipped: %s", item.index, item.reason)
                if failures > MAX_FAILURES:
                    raise InputError(
                        f"{self.source}: {failures} pairs in a row cannot be read; the last: {item.reason}"
                    )
        if not any_read:
            raise InputError(f"{self.source}: not one of {len(self.skipped)} pairs can be read")

    def sample(self, count: int) -> list[FrameStep]:
        """At most `count` frames to judge the sequence by, each with the one after it; unreadable ones are left out.

        Of image files they are spread over the whole recording, of a video or bag over its first frames.
        """
        pairs = self._pairs
        if isinstance(pairs, ImagePairs):
            firsts = np.unique(np.linspace(0, max(len(pairs.files) - 2, 0), count).astype(int)).tolist()
            wanted = sorted({first + k for first in firsts for k in (0, 1) if first + k < len(pairs.files)})
            items: Iterator[RawPair | SkippedFrame] = (pairs.read(index) for index in wanted)
        else:
            firsts = [SAMPLED_EVERY * k for k in range(count)]
            items = islice(iter(pairs), firsts[-1] + 2)
        with closing(self._convert(items)) as converted:
            frames = {item.index: item for item in converted if isinstance(item, StereoFrame)}
        return [(frames[first], frames.get(first + 1)) for first in firsts if first in frames]

    def _items(self) -> Generator[StereoFrame | SkippedFrame, None, None]:
        return read_ahead(lambda: self._convert(self._pairs), READ_AHEAD)

    def _convert(self, pairs: Iterable[RawPair | SkippedFrame]) -> Generator[StereoFrame | SkippedFrame, None, None]:
        for item in pairs:
            if isinstance(item, SkippedFrame):
                yield item
                continue
            try:
                left = self._check(item.left, item.left_name, self._stored.left, self.camera.left)
                right = self._check(item.right, item.right_name, self._stored.right, self.camera.right)
                colour = self._grey.colour(item.left)
                yield StereoFrame(item.index, item.timestamp, left, right, self._mask(item.left_name), colour)
            except FrameError as error:
                yield SkippedFrame(item.index, item.timestamp, str(error))

    def _check(self, image: np.ndarray, name: str, model: CameraModel, wanted: CameraModel) -> np.ndarray:
        mismatch = _size_mismatch(image, model)
        if mismatch:
            raise FrameError(f"{name}: {mismatch}")
        grey = self._grey.convert(image, name)
        if (wanted.width, wanted.height) == (model.width, model.height):
            return grey
        return np.asarray(cv2.resize(grey, (wanted.width, wanted.height), interpolation=cv2.INTER_AREA))

    def _mask(self, left_name: str) -> np.ndarray | None:
        """(H, W) uint8 of a frame."""
        if self.masks is None:
            return None
        mask, size = self.masks.read(left_name).astype(np.uint8), (self.camera.left.width, self.camera.left.height)
        return np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST))


def _size_mismatch(image: np.ndarray, model: CameraModel) -> str | None:
    height, width = image.shape[:2]
    if (width, height) == (model.width, model.height):
        return None
    return f"image is {width}x{height}, the calibration is for {model.width}x{model.height}"


def read_ahead(produce: Callable[[], Generator[T, None, None]], depth: int) -> Generator[T, None, None]:
    """Run a generator in a background thread, at most `depth` items ahead of the consumer.

    Its exceptions reach the consumer in their place. Closing this generator ends the thread.
    """
    ready: queue.Queue[tuple[T | None, BaseException | None]] = queue.Queue(depth)
    stop = threading.Event()

    def put(item: T | None, error: BaseException | None) -> None:
        while not stop.is_set():
            try:
                ready.put((item, error), timeout=0.05)
                return
            except queue.Full:
                continue

    def run() -> None:
        try:
            with closing(produce()) as items:
                for item in items:
                    put(item, None)
                    if stop.is_set():
                        return
            put(None, StopIteration())
        except BaseException as error:
            put(None, error)

    thread = threading.Thread(target=run, name="sigmaslam-read-ahead", daemon=True)
    thread.start()
    try:
        while True:
            item, error = ready.get()
            if isinstance(error, StopIteration):
                return
            if error is not None:
                raise error
            yield item  # type: ignore[misc]
    finally:
        stop.set()
        thread.join()
