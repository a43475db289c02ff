"""Dataclasses whose fields are columns of equal length, and rows of columns."""

from collections.abc import Sequence
from typing import Any, ClassVar, Self

import numpy as np


class Table:
    """Rows of a dataclass whose fields are arrays (M, ...) or tables; None stands for a column that is not there."""

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Any]]

    def __len__(self) -> int:
        return len(getattr(self, next(iter(self.__dataclass_fields__))))

    def select(self, rows: np.ndarray) -> Self:
        """The rows of that index or mask."""
        index = np.flatnonzero(rows) if rows.dtype == bool else rows
        return type(self)(*(_select(column, index) for column in self.columns()))

    def columns(self) -> list[Any]:
        """The columns in the order of the fields."""
        return [getattr(self, name) for name in self.__dataclass_fields__]

    def arrays(self) -> dict[str, Any]:
        """The columns by the names of the fields."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """All rows of all parts, of which there is at least one."""
        return cls(*(_concatenate(columns) for columns in zip(*(part.columns() for part in parts), strict=True)))


def even_rows(count: int, most: int) -> np.ndarray:
    """Indices of an even selection of at most so many of `count` rows, the first and the last included."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).astype(np.int64))


def distinct(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct ones of small integers (N,) from zero on, and (N,) which of them each is: a fast `np.unique`."""
    present = np.bincount(numbers) > 0
    return np.flatnonzero(present), (np.cumsum(present) - 1)[numbers]


def nearest_rows(values: np.ndarray, ordered: np.ndarray) -> np.ndarray:
    """(N,) index of the nearest of increasing numbers (M,) for each value (N,); of two as near the first."""
    after = np.clip(np.searchsorted(ordered, values), 0, len(ordered) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(ordered[before] - values) <= np.abs(ordered[after] - values), before, after)


def _select(column: Any, index: np.ndarray) -> Any:
    if column is None:
        return None
    # `take` needs a third of the time of column[index].
    return column.select(index) if isinstance(column, Table) else column.take(index, axis=0)


def _concatenate(columns: tuple[Any, ...]) -> Any:
    if columns[0] is None:
        return None
    return columns[0].concatenate(columns) if isinstance(columns[0], Table) else np.concatenate(columns)
