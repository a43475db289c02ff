"""Files that grow while a run goes on, and that a killed run leaves behind, whole up to its last piece."""

import io
import logging
import math
import os
import sys
from contextlib import closing, suppress
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError, OutputError

if sys.platform != "win32":
    import fcntl


_LOGGER = logging.getLogger(__name__)


class AppendedFile:
    """A file to which pieces are appended; the operating system has each one when `append` returns.

    Args:
        path: of the file; it must not exist. It stays locked until it is closed, or the process ends. Where it is
            removed before, with its folder, say, it is made again with all that it had.
        goes_on: the file exists, and pieces are appended to those that it has.
    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path, goes_on: bool = False) -> None:
        self._path = path
        self._open("a+" if goes_on else "x+")

    def append(self, content: bytes) -> None:
        """Writes a piece.

        Raises:
            OutputError: it could not be written whole, as on a full disk.
        """
        self._make_again()
        try:
            self._write(content)
        except OSError as error:
            raise OutputError(
                f"{self._path}: cannot be written ({error.strerror}): make room on the disk; "
                f"`sigmaslam report {self._path.parent}` then writes the results that are not there"
            ) from error

    def close(self) -> None:
        """Nothing can be appended any more.

        Raises:
            OutputError: the file was removed, and cannot be made again.
        """
        if not self._file.closed:
            try:
                self._make_again()
            finally:
                self._file.close()

    def _open(self, mode: str) -> None:
        self._file = io.FileIO(self._path, mode)
        if sys.platform != "win32":
            with suppress(OSError):  # a file system without locks
                fcntl.flock(self._file, fcntl.LOCK_EX)

    def _write(self, content: bytes) -> None:
        left = memoryview(content)
        while left:
            left = left[self._file.write(left) :]

    def _make_again(self) -> None:
        """The file of a removed name still holds what was written, until it is closed."""
        if os.fstat(self._file.fileno()).st_nlink:
            return
        _LOGGER.warning("%s: was removed while the run goes on: it is made again", self._path)
        self._file.seek(0)
        with closing(self._file) as removed:
            content = removed.readall()
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._open("x+")
            self._write(content)
        except OSError as error:
            raise OutputError(
                f"{self._path}: was removed while the run goes on, and cannot be made again ({error.strerror})"
            ) from error


def check_not_in_use(path: Path) -> None:
    """No other process appends to the file.

    Raises:
        InputError: one does.
    """
    if is_in_use(path):
        raise InputError(f"{path}: a run that still goes on writes it; stop that one first")


def is_in_use(path: Path) -> bool:
    """Whether another process appends to the file; False where the system has no locks."""
    if sys.platform != "win32":
        with path.open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    return False


def pack_rows(*columns: np.ndarray) -> bytes:
    """Columns (N, ...) as N rows of float64."""
    flat = [column.reshape(len(column), math.prod(column.shape[1:])) for column in columns]
    return np.column_stack(flat).astype(np.float64).tobytes()


def read_rows(path: Path, *shapes: tuple[int, ...]) -> list[np.ndarray]:
    """Columns (N, *shape) of a file of `pack_rows`; a last row that was cut off does not count."""
    sizes = [math.prod(shape) for shape in shapes]
    content, size = path.read_bytes(), 8 * sum(sizes)
    rows = np.frombuffer(content[: len(content) // size * size]).reshape(-1, sum(sizes))
    parts = np.split(rows, np.cumsum(sizes)[:-1], axis=1)
    return [part.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=True)]
