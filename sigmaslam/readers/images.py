"""Image files: reading one, making it grey 8-bit, and a list of left and right files as a source of pairs."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.bounded_files import read_bytes
from sigmaslam.errors import FrameError, InputError
from sigmaslam.readers.image_size import image_size

logger = logging.getLogger(__name__)

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm"})

_KINDS = ("PNG", "JPEG", "BMP", "TIFF", "PNM")
# Of a camera of today; files of a few kB can state sizes that take all memory to decode.
MAX_PIXELS, MAX_FILE_BYTES = 1 << 26, 1 << 28

# Reading stops after more failed pairs in a row.
MAX_FAILURES = 20


@dataclass(frozen=True, slots=True)
class RawPair:
    """A pair as it was stored: any number of channels, 8 or 16 bits.

    Attributes:
        index: number of the pair in the sequence.
        timestamp: seconds.
        left, right: (H, W) or (H, W, C) images.
        left_name, right_name: where they came from, for messages.
    """

    index: int
    timestamp: float
    left: np.ndarray
    right: np.ndarray
    left_name: str
    right_name: str


@dataclass(frozen=True, slots=True)
class SkippedFrame:
    """A pair that could not be used: its index, timestamp (seconds) and why."""

    index: int
    timestamp: float
    reason: str


def read_image(path: Path) -> np.ndarray:
    """Read an image as it is stored.

    Returns:
        (H, W) or (H, W, C) array, colours in OpenCV's order.

    Raises:
        FrameError: the file is missing, empty, truncated, too large or no image.
    """
    return decode_image(read_bytes(path, MAX_FILE_BYTES, "the image", FrameError), str(path))


def decode_image(content: bytes, name: str) -> np.ndarray:
    """Decode an image file's bytes as they are stored.

    Returns:
        (H, W) or (H, W, C) array, colours in OpenCV's order.

    Raises:
        FrameError: it is empty, truncated, too large or no image.
    """
    if not content:
        raise FrameError(f"{name}: file is empty (0 bytes)")
    # OpenCV 4 fills the missing part of a truncated JPEG with grey. A whole one ends with a marker after its last scan.
    if content[:2] == b"\xff\xd8" and content.rfind(b"\xff\xd9") < content.rfind(b"\xff\xda"):
        raise FrameError(f"{name}: JPEG is truncated")
    size = image_size(content)
    if size is None:
        raise FrameError(f"{name}: not an image, or truncated; {', '.join(_KINDS)} are read")
    if size[0] * size[1] > MAX_PIXELS:
        raise FrameError(
            f"{name}: states a size of {size[0]}x{size[1]} pixels, at most {MAX_PIXELS:,} are read; "
            "is it the right file?"
        )
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise FrameError(f"{name}: not an image, or truncated ({len(content)} bytes)")
    return image


def read_grey(path: Path) -> np.ndarray:
    """Read one image of any kind as (H, W) uint8; 16 bits are scaled by those that are significant in it.

    Raises:
        FrameError: the file is missing or no image, or has another pixel type or number of channels.
    """
    image = _single_channel(read_image(path), str(path))
    return image if image.dtype == np.uint8 else _to_8_bits(image, _significant_bits(image))


class GreyConverter:
    """Makes every image of one sequence grey and 8-bit by the same rule, and says once that it does.

    16-bit images are scaled by one factor from the significant bits (8 to 16) of the first one seen, so that
    brightness does not jump within the sequence; brighter pixels later on saturate.
    """

    def __init__(self) -> None:
        self.significant_bits: int | None = None
        self._colour_warned = False

    def convert(self, image: np.ndarray, name: str) -> np.ndarray:
        """Convert (H, W) or (H, W, 1 to 4) uint8 or uint16 to (H, W) uint8.

        Raises:
            FrameError: another pixel type or number of channels.
        """
        grey = _single_channel(image, name)
        if image.ndim == 3 and image.shape[2] > 2 and not self._colour_warned:
            self._colour_warned = True
            logger.warning("%s: colour image; the whole sequence is converted to grey", name)
        if grey.dtype == np.uint16:
            if self.significant_bits is None:
                self.significant_bits = _significant_bits(grey)
                logger.warning(
                    "%s: 16-bit image, %d significant bits; the whole sequence is scaled to 8 bits by 255/%d",
                    name,
                    self.significant_bits,
                    2**self.significant_bits - 1,
                )
            grey = _to_8_bits(grey, self.significant_bits)
        return grey

    def colour(self, image: np.ndarray) -> np.ndarray | None:
        """(H, W, 3) uint8 of an image that was converted, scaled alike, in OpenCV's order; None if it has no colour."""
        if image.ndim == 2 or image.shape[2] < 3:
            return None
        colour = np.ascontiguousarray(image[..., :3])
        if colour.dtype == np.uint8 or self.significant_bits is None:
            return colour
        return _to_8_bits(colour, self.significant_bits)


def _single_channel(image: np.ndarray, name: str) -> np.ndarray:
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"{name}: pixel type {image.dtype} is neither 8- nor 16-bit unsigned")
    if image.ndim == 2:
        return image
    channels = image.shape[2]
    if channels > 4:
        raise FrameError(f"{name}: {channels} channels; expected grey, BGR or BGR with alpha")
    if channels <= 2:
        return np.ascontiguousarray(image[..., 0])
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY if channels == 3 else cv2.COLOR_BGRA2GRAY)


def _significant_bits(image: np.ndarray) -> int:
    return max(8, int(image.max()).bit_length())


def _to_8_bits(image: np.ndarray, significant_bits: int) -> np.ndarray:
    return cv2.convertScaleAbs(image, alpha=255.0 / (2**significant_bits - 1))


class PairSource(ABC):
    """Pairs of a reader in order; pairs that cannot be read are SkippedFrame.

    Attributes:
        timestamps: seconds, strictly increasing; None where reading alone gives them.
        length: number of pairs; None where it is not known.
        source: the file or folder, or the name of a camera, for messages.
    """

    timestamps: list[float] | None = None
    length: int | None = None
    source: Path | str

    @abstractmethod
    def __iter__(self) -> Iterator[RawPair | SkippedFrame]: ...

    @cached_property
    def first_pair(self) -> RawPair:
        """The first pair that can be read.

        Raises:
            InputError: none of the first pairs can.
        """
        tried = 0
        reason = ""
        for tried, item in enumerate(self, start=1):
            if isinstance(item, RawPair):
                return item
            reason = reason or item.reason
            if tried > MAX_FAILURES:
                break
        raise InputError(f"{self.source}: none of the first {tried} pairs can be read; the first: {reason}")


class ListedPairs(PairSource):
    """Pairs in memory: left and right images, and seconds."""

    source = "pairs in memory"

    def __init__(self, pairs: Sequence[tuple[np.ndarray, np.ndarray, float]]) -> None:
        self.timestamps, self.length, self._pairs = [seconds for _, _, seconds in pairs], len(pairs), pairs

    def __iter__(self) -> Iterator[RawPair]:
        for index, (left, right, seconds) in enumerate(self._pairs):
            yield RawPair(index, seconds, left, right, f"left image {index}", f"right image {index}")


class ImagePairs(PairSource):
    """Left and right image files with their timestamps, as a source of pairs.

    Raises:
        InputError: there is no pair, or a timestamp is not finite or not later than the one before.
    """

    def __init__(self, files: Sequence[tuple[Path, Path]], timestamps: Sequence[float], source: Path) -> None:
        if not files:
            raise InputError(f"{source}: no pair of left and right images")
        if len(files) != len(timestamps):
            raise InputError(f"{source}: {len(files)} pairs but {len(timestamps)} timestamps")
        wrong = np.flatnonzero(~((np.diff(timestamps, prepend=-np.inf) > 0) & np.isfinite(timestamps)))
        if len(wrong):
            first = int(wrong[0])
            raise InputError(
                f"{source}: timestamp of pair {first} ({files[first][0].name}) is {timestamps[first]!r}, the "
                f"one before {timestamps[first - 1] if first else None!r}; they must be finite and increase"
            )
        self.files = list(files)
        self.timestamps = list(timestamps)
        self.length = len(files)
        self.source = source

    def __iter__(self) -> Iterator[RawPair | SkippedFrame]:
        return (self.read(index) for index in range(len(self.files)))

    def read(self, index: int) -> RawPair | SkippedFrame:
        """The pair with that number."""
        assert self.timestamps is not None
        (left, right), timestamp = self.files[index], self.timestamps[index]
        try:
            return RawPair(index, timestamp, read_image(left), read_image(right), str(left), str(right))
        except FrameError as error:
            return SkippedFrame(index, timestamp, str(error))
