"""Pairs of left and right images, and their time stamps."""

import logging
import re
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from math import isfinite
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np

from sigmaslam.bounded_files import list_folder, shorten, table_lines
from sigmaslam.errors import InputError
from sigmaslam.readers.images import IMAGE_SUFFIXES
from sigmaslam.table import nearest_rows

logger = logging.getLogger(__name__)

DEFAULT_RATE_HZ = 10.0
# Images that are not read: among others they are a frame that misses.
_UNREAD = frozenset({".gif", ".webp", ".heic", ".avif", ".jp2", ".exr", ".svg"})
STAMP_TOLERANCE_NS = 5_000_000
# A driver drops single images; where more than this share has no partner, folders or names are wrong.
_MAX_ALONE = 0.1
# Seconds with decimals and milliseconds since 1970; of nanoseconds 16 digits also admit clocks with another origin.
_STAMP = re.compile(r"\d{10}\.\d+|\d{13}|\d{16,}")
_STAMPS = range(-(2**63), 2**63)
# Seconds: times since 1970 in our century lie between these.
_EARLIEST, _LATEST = 1e9, 4.1e9
# Seconds from image to image: names are times at shorter steps, and times.txt is in milliseconds at longer ones.
_LONGEST_STEP, _SLOWEST = 5.0, 20.0

# At most so many images of one eye wait for a partner.
MAX_WAITING = 50

Key = tuple[int, ...] | str
T = TypeVar("T")


def list_images(folder: Path) -> list[Path]:
    """Image files of a folder by name; hidden files are left out, and with a warning images of other types.

    Raises:
        InputError: the folder is missing, may not be read, or has no image.
    """
    visible = [path for path in list_folder(folder) if not path.name.startswith(".")]
    files = [path for path in visible if path.suffix.lower() in IMAGE_SUFFIXES]
    unread = [path for path in visible if path.suffix.lower() in _UNREAD]
    if unread:
        logger.warning(
            "%s: %d images are of a type that is not read (first: %s): convert them to PNG",
            *(folder, len(unread), shorten(unread[0].name, 60)),
        )
    if not files:
        raise InputError(f"{folder}: no image files ({' '.join(sorted(IMAGE_SUFFIXES))})")
    return files


def pair_by_name(
    left_folder: Path, right_folder: Path, prefixes: tuple[str, str] = ("", "")
) -> tuple[list[tuple[Path, Path]], np.ndarray]:
    """Pairs of equal frame numbers (all the numbers in a name but the camera's), in their order.

    Where a name has no number, or a folder has the same numbers twice, whole names are compared. Images without partner
    are left out with one warning.

    Args:
        left_folder, right_folder: may be the same.
        prefixes: what the names of left and right images begin with; others are left out.

    Returns:
        The pairs, and which of all frames they are, (N,) bool.

    Raises:
        InputError: more than a tenth of the frames lack an image; the message gives both counts and the first names.
    """
    folders = (left_folder, right_folder)
    files = [
        [path for path in list_images(folder) if path.name.startswith(prefix)]
        for folder, prefix in zip(folders, prefixes, strict=True)
    ]
    keys = _frame_keys(files)
    if any(() in side or len(set(side)) < len(side) for side in keys):
        keys = [[path.stem for path in side] for side in files]
    left, right = (dict(zip(side_keys, side, strict=True)) for side_keys, side in zip(keys, files, strict=True))
    alone = [sorted(path.name for key, path in a.items() if key not in b) for a, b in ((left, right), (right, left))]
    frames = sorted(left.keys() | right.keys())
    whole = np.array([key in left and key in right for key in frames])
    if not whole.all():
        parts = [
            f"{len(names)} in {folder.name} without partner (first: {', '.join(names[:3])})"
            for names, folder in zip(alone, folders, strict=True)
            if names
        ]
        # Where one eye begins earlier and the other ends later, the same frames may have other numbers.
        shifted = not (whole[0] or whole[-1]) and (frames[0] in left) != (frames[-1] in left)
        if shifted or (~whole).sum() > _MAX_ALONE * len(frames):
            raise InputError(
                f"unequal left and right images: {len(left)} in {left_folder}, {len(right)} in {right_folder}; "
                f"{'; '.join(parts)}; images of a pair must have the same number in their names"
            )
        logger.warning("%s: %d frames are left out: %s", left_folder.parent, (~whole).sum(), "; ".join(parts))
    return [(left[key], right[key]) for key in frames if key in left and key in right], whole


def _frame_keys(files: Sequence[Sequence[Path]]) -> Sequence[Sequence[Key]]:
    """The numbers in names, without one that is in all left names k and in all right ones k + 1: cam0_07, cam1_07."""
    keys = [[tuple(map(int, re.findall(r"\d+", path.stem))) for path in side] for side in files]
    places = zip(*([set(place) for place in zip(*side, strict=False)] for side in keys), strict=False)
    cameras = {
        k for k, (left, right) in enumerate(places) if len(left) == 1 and right == {min(left) + 1} <= {*range(9)}
    }
    rest = [[tuple(n for k, n in enumerate(key) if k not in cameras) for key in side] for side in keys]
    return rest if all(len(key) for side in rest for key in side) else keys


def frame_numbers(files: Sequence[tuple[Path, Path]]) -> list[int] | None:
    """The frame numbers of pairs named by nothing but a number, else None."""
    stems = [left.stem for left, _ in files]
    return [int(stem) for stem in stems] if all(stem.isdecimal() for stem in stems) else None


def stamps_of(stems: Sequence[str]) -> list[int] | None:
    """Times in names of files as nanoseconds; None where a name is no time.

    A name has nanoseconds, or, since 1970 and with steps as of a camera, seconds with decimals, milli- or microseconds.
    """
    if not all(map(_STAMP.fullmatch, stems)):
        return None
    times = list(map(Fraction, stems))
    step = float(np.median(np.diff(np.array(sorted(times), np.float64)))) if len(times) > 1 else 0.0
    for unit in (1, 1_000, 1_000_000):
        if all(_EARLIEST * unit <= time <= _LATEST * unit for time in times) and step < _LONGEST_STEP * unit:
            return [int(time * 1_000_000_000 / unit) for time in times]
    return list(map(int, stems)) if all(stem.isdecimal() and len(stem) > 13 for stem in stems) else None


def stamped_images(folder: Path) -> dict[int, Path] | None:
    """Images of a folder by the times in their names, nanoseconds; None where a name is no time."""
    files = list_images(folder)
    stamps = stamps_of([path.stem for path in files])
    return None if stamps is None or len({*stamps}) < len(files) else dict(zip(stamps, files, strict=True))


def pair_by_stamp(
    left: Mapping[int, Path], right: Mapping[int, Path], source: Path
) -> tuple[list[tuple[Path, Path]], list[float]]:
    """Pairs of mutually nearest stamps, at most 5 ms apart; others are left out with one warning.

    Args:
        left, right: files by time stamp, nanoseconds.
        source: for messages.

    Returns:
        The pairs in order and the left stamps in seconds.

    Raises:
        InputError: the counts differ by more than 10 %, or nothing pairs.
    """
    if abs(len(left) - len(right)) > _MAX_ALONE * max(len(left), len(right)):
        raise InputError(
            f"{source}: unequal left and right images: {len(left)} left, {len(right)} right; copy the missing files"
        )
    for stamp, file in [*left.items(), *right.items()]:
        if stamp not in _STAMPS:
            raise InputError(f"{file}: {shorten(str(stamp))} is no time in nanoseconds since 1970: rename the image")
    left_stamps, right_stamps = np.array(sorted(left), np.int64), np.array(sorted(right), np.int64)
    to_right, to_left = nearest_rows(left_stamps, right_stamps), nearest_rows(right_stamps, left_stamps)
    mutual = to_left[to_right] == np.arange(len(left_stamps))
    close = np.abs(right_stamps[to_right] - left_stamps) <= STAMP_TOLERANCE_NS
    chosen = np.flatnonzero(mutual & close)
    if not len(chosen):
        raise InputError(
            f"{source}: none of {len(left)} left images has a right one within "
            f"{STAMP_TOLERANCE_NS / 1e6:g} ms ({len(right)} right); are both from the same recording?"
        )
    unpaired = len(left) + len(right) - 2 * len(chosen)
    if unpaired:
        logger.warning("%s: %d images without a partner within 5 ms are left out", source, unpaired)
    pairs = [(left[int(left_stamps[i])], right[int(right_stamps[to_right[i]])]) for i in chosen]
    # A float does not hold 19 digits; dividing Python integers rounds only once.
    return pairs, [int(left_stamps[i]) / 1_000_000_000 for i in chosen]


@dataclass(frozen=True, slots=True)
class Stamped(Generic[T]):
    """An item with its time stamp, nanoseconds."""

    stamp: int
    item: T


def pair_streams(images: Iterable[tuple[int, Stamped[T]]]) -> Iterator[tuple[Stamped[T] | None, Stamped[T] | None]]:
    """Pairs of mutually nearest stamps, at most 5 ms apart, from two streams that are read once.

    Args:
        images: (0, left image) and (1, right image), each eye in the order of time, the two mixed in any way.

    Yields:
        Pairs (left, right); (left, None) or (None, right) for an image without partner, among them those whose
        stamp is not later than the one before of that eye. At most `MAX_WAITING` images of an eye are held.
    """
    waiting: tuple[deque[Stamped[T]], deque[Stamped[T]]] = (deque(), deque())
    latest = [-1, -1]
    for eye, image in images:
        if image.stamp <= latest[eye]:
            yield (None, image) if eye else (image, None)
            continue
        latest[eye] = image.stamp
        waiting[eye].append(image)
        yield from _settle(waiting, False)
    yield from _settle(waiting, True)


def _settle(
    waiting: tuple[deque[Stamped[T]], deque[Stamped[T]]], ended: bool
) -> Iterator[tuple[Stamped[T] | None, Stamped[T] | None]]:
    """Pairs or discards the heads of both queues as long as their successors are there, or the streams have ended."""
    left, right = waiting
    while left or right:
        if not ended and max(len(left), len(right)) <= MAX_WAITING and min(len(left), len(right)) < 2:
            return
        if left and right:
            difference = abs(left[0].stamp - right[0].stamp)
            left_alone = len(left) > 1 and abs(left[1].stamp - right[0].stamp) < difference
            right_alone = len(right) > 1 and abs(left[0].stamp - right[1].stamp) < difference
            if difference <= STAMP_TOLERANCE_NS and not left_alone and not right_alone:
                yield left.popleft(), right.popleft()
                continue
            left_alone = left_alone if difference <= STAMP_TOLERANCE_NS else left[0].stamp < right[0].stamp
        else:
            left_alone = bool(left)
        yield (left.popleft(), None) if left_alone else (None, right.popleft())


def read_times(
    path: Path, count: int, numbers: Collection[int] | None = None, whole: np.ndarray | None = None
) -> list[float]:
    """Timestamps of a times file: seconds, or KITTI raw's dates, one a line.

    Args:
        count: number of pairs.
        numbers: frame numbers of the pairs; a file of a whole recording is then indexed by them.
        whole: which of all frames are pairs, (N,) bool; a file may have a line for each.

    Returns:
        Seconds, one per pair.

    Raises:
        InputError: a line is no time, times do not increase or are no seconds, or the number of lines does not fit.
    """
    times: list[float] = []
    rows: list[int] = []
    for number, line in table_lines(path, "the timestamps"):
        try:
            times.append(parse_seconds(line))
        except (ValueError, OverflowError):
            raise InputError(f"{path}: line {number} is not a time in seconds: {shorten(repr(line))}") from None
        rows.append(number)
    if len(times) != count and whole is not None and len(times) == len(whole):
        numbers = np.flatnonzero(whole).tolist()
    if len(times) != count:
        if numbers is None or len(times) <= max(numbers):
            raise InputError(f"{path}: {len(times)} timestamps for {count} image pairs; one line per pair is needed")
        times, rows = [times[number] for number in numbers], [rows[number] for number in numbers]
    check_increase(path, times, rows)
    return in_seconds(path, times, _SLOWEST)


def check_increase(path: Path, times: Sequence[float], lines: Sequence[int]) -> None:
    """Refuses times that are not finite, or not later than the one before; `lines` are their numbers in the file."""
    for k, (time, line) in enumerate(zip(times, lines, strict=True)):
        if not isfinite(time):
            raise InputError(f"{path}: line {line} is {time}: give a finite time in seconds")
        if k and time <= times[k - 1]:
            raise InputError(
                f"{path}: line {line} is {time!r}, the time before is {times[k - 1]!r}: times must increase; sort the "
                "lines by time (and images with them), and remove repeated ones"
            )


def parse_seconds(text: str) -> float:
    """Seconds, or KITTI raw's date and time of day; ValueError where it is neither."""
    date, _, clock = text.partition(" ")
    if not clock:
        return float(text)
    # datetime cannot read nine decimals.
    whole, _, decimals = clock.partition(".")
    return datetime.fromisoformat(f"{date} {whole}+00:00").timestamp() + float(f"0.{decimals or 0}")


def in_seconds(path: Path, times: Sequence[float], longest_step: float = np.inf) -> list[float]:
    """The times, if they can be seconds; their unit is told by their size and by the median of their steps.

    Args:
        longest_step: seconds; longer ones are taken for milliseconds.
    Raises:
        InputError: they are so large or so far apart that they must be in nano-, micro- or milliseconds.
    """
    if not np.all(np.isfinite(times)) or not len(times):
        return list(times)
    largest, step = float(np.max(np.abs(times))), float(np.median(np.abs(np.diff(times)))) if len(times) > 1 else 0.0
    # Seconds since 1970 have ten digits, and no pairs of a moving camera are a quarter of an hour apart.
    for unit, factor, longest in (("nano", 1e9, 1e6), ("micro", 1e6, 1e3), ("milli", 1e3, longest_step)):
        if largest > 0.1 * factor * _LATEST or step > longest:
            raise InputError(
                f"{path}: times such as {times[0]:.0f}, {step:.6g} apart, look like {unit}seconds: write seconds, the "
                f"numbers divided by {factor:.0e}"
            )
    return list(times)


def default_times(numbers: Sequence[int], source: Path) -> list[float]:
    """Times at 10 Hz from frame numbers, so that a gap in the numbers is a gap in time; logs a warning."""
    logger.warning("%s: no timestamps; %g Hz is taken", source, DEFAULT_RATE_HZ)
    return [(number - numbers[0]) / DEFAULT_RATE_HZ for number in numbers]
