"""A part of a recording: pairs from one on, every so many of them."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam.readers.images import ImagePairs, PairSource, RawPair, SkippedFrame


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


def select_pairs(pairs: PairSource, selection: Selection, source: Path | str) -> PairSource:
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


class SelectedPairs(PairSource):
    """Some pairs of a source that can be read in order alone."""

    def __init__(self, pairs: PairSource, selection: Selection, source: Path | str) -> None:
        self._pairs, self._rows, self.source = pairs, selection.rows, source
        self.timestamps = None if pairs.timestamps is None else pairs.timestamps[self._rows]
        self.length = None if pairs.length is None else len(range(pairs.length)[self._rows])

    def __iter__(self) -> Iterator[RawPair | SkippedFrame]:
        chosen = islice(iter(self._pairs), self._rows.start, self._rows.stop, self._rows.step)
        return (replace(pair, index=index) for index, pair in enumerate(chosen))
