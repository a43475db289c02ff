"""A part of a recording: pairs from one on, every so many of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Protocol

from sigmaslam.errors import InputError
from sigmaslam.readers.images import ImagePairs, RawPair, SkippedFrame, first_readable


class Pairs(Protocol):
    """Pairs in order, as of `PairSource`."""

    timestamps: list[float] | None
    length: int | None

    def __iter__(self) -> Iterator[RawPair | SkippedFrame]: ...


@dataclass(frozen=True, slots=True)
class Selection:
    """Which pairs of a recording are read.

    Attributes:
        start: number of the first, from 0 on.
        count: how many at most; None: to the end.
        every: one of so many.
    """

    start: int = 0
    count: int | None = None
    every: int = 1

    @property
    def rows(self) -> slice:
        """Of the pairs."""
        return slice(self.start, None if self.count is None else self.start + self.count * self.every, self.every)


def select_pairs(pairs: Pairs, selection: Selection, source: Path | str) -> ImagePairs | SelectedPairs:
    """The selected pairs, numbered anew from 0 on; of image files no others are read.

    Raises:
        InputError: there is none of them.
    """
    if pairs.length is not None and selection.start >= pairs.length:
        raise InputError(
            f"{source}: has {pairs.length} pairs, none from {selection.start} on: choose a smaller --start"
        )
    if isinstance(pairs, ImagePairs):
        assert pairs.timestamps is not None
        return ImagePairs(pairs.files[selection.rows], pairs.timestamps[selection.rows], Path(source))
    return SelectedPairs(pairs, selection, source)


class SelectedPairs:
    """Some pairs of a source that can be read in order alone.

    Attributes:
        timestamps: seconds, or None if only reading gives them.
        length: number of pairs, or None if that is not known.
    """

    def __init__(self, pairs: Pairs, selection: Selection, source: Path | str) -> None:
        self._pairs, self._rows, self._source = pairs, selection.rows, source
        self.timestamps = None if pairs.timestamps is None else pairs.timestamps[self._rows]
        self.length = None if pairs.length is None else len(range(pairs.length)[self._rows])

    @cached_property
    def first_pair(self) -> RawPair:
        """The first of them that can be read; InputError if none of the first ones can."""
        return first_readable(self, Path(self._source))

    def __iter__(self) -> Iterator[RawPair | SkippedFrame]:
        chosen = islice(iter(self._pairs), self._rows.start, self._rows.stop, self._rows.step)
        return (replace(pair, index=index) for index, pair in enumerate(chosen))
