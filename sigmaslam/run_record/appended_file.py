"""Files that grow while a run goes on, and that a killed run leaves behind, whole up to its last piece."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError, OutputError

if sys.platform != "win32":
    import fcntl


class AppendedFile:
    """A file to which pieces are appended; the operating system has each one when `append` returns.

    Args:
        path: of the file; it must not exist. It stays locked until it is closed, or the process ends.
        goes_on: the file exists, and pieces are appended to those that it has.
    Raises:
        OSError: it cannot be made.
    """

    def __init__(self, path: Path, goes_on: bool = False) -> None:
        self._path = path
        self._file = path.open("ab" if goes_on else "xb", buffering=0)
        if sys.platform != "win32":
            with suppress(OSError):  # a file system without locks
                fcntl.flock(self._file, fcntl.LOCK_EX)

    def append(self, content: bytes) -> None:
        """Writes a piece.

        Raises:
            OutputError: it could not be written whole, as on a full disk.
        """
        left = memoryview(content)
        try:
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise OutputError(
                f"{self._path}: cannot be written ({error.strerror}): make room on the disk; "
                f"`sigmaslam finish {self._path.parent}` then writes the results that are not there"
            ) from error

    def close(self) -> None:
        """Nothing can be appended any more."""
        self._file.close()


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


def read_records(path: Path, width: int) -> np.ndarray:
    """Rows (N, width) float64 of a file to which they were appended; a last row that was cut off does not count."""
    content = path.read_bytes()
    size = 8 * width
    return np.frombuffer(content[: len(content) // size * size]).reshape(-1, width)
