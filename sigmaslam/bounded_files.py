"""Files read in bounded memory: regular files alone, of limited size, and numpy archives whose headers are checked."""

import json
import math
import os
import stat
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy_format

from sigmaslam.errors import InputError

CALIBRATION_BYTES = 1 << 18
"""Calibrations and settings have a few kB."""
TABLE_BYTES = 1 << 28
"""Tables of text, a row per frame: some millions of rows."""
_ARRAY_BYTES = 1 << 33
# Archives of runs unpack to less than ten times their size; small ones may hold constant arrays.
_MAX_UNPACKING, _SMALL_BYTES = 100, 1 << 28
_HEADER_BYTES = 10_000


def read_bytes(path: Path, limit: int, what: str, error: type[InputError] = InputError) -> bytes:
    """The content of a regular file.

    Args:
        path: file or link to one. A pipe or a device, which may never end, is refused before it is read.
        limit: bytes; larger files are refused.
        what: the file should be, for the message, such as "the trajectory".
    Raises:
        InputError: the file is missing, larger, no regular file, or may not be read.
    """
    try:
        # Without O_NONBLOCK the opening of a named pipe waits for a writer.
        with os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:
            _check_regular(path, os.fstat(file.fileno()), limit, error)
            content = file.read(limit + 1)
    except (OSError, ValueError) as problem:
        raise _unreadable(path, what, problem, error) from None
    if len(content) > limit:
        raise error(_too_large(path, len(content), limit))
    return content


def read_text(path: Path, limit: int, what: str, error: type[InputError] = InputError) -> str:
    """The content of a regular file as UTF-8, with or without a byte order mark; line ends are kept.

    Args:
        path, limit, what, error: of `read_bytes`.
    Raises:
        InputError: as of `read_bytes`, or the file is no text.
    """
    try:
        return read_bytes(path, limit, what, error).decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(
            f"{path}: cannot read {what}: is not text (byte {problem.start} is no UTF-8); give a text file in UTF-8"
        ) from None


def table_lines(path: Path, what: str) -> Iterator[tuple[int, str]]:
    """Stripped lines of a table that are neither empty nor comments, each with its number from 1; as `read_text`."""
    for number, line in enumerate(read_text(path, TABLE_BYTES, what).splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def read_json(path: Path, what: str, mend: str, error: type[InputError] = InputError, limit: int = TABLE_BYTES) -> Any:
    """The content of a JSON file.

    Args:
        path, what, error, limit: of `read_bytes`.
        mend: what to do about a bad one, for the message.
    Raises:
        InputError: as of `read_text`, or the text is no JSON.
    """
    try:
        return json.loads(read_text(path, limit, what, error))
    except (ValueError, RecursionError) as problem:
        raise error(f"{path}: is no JSON ({shorten(str(problem))}): {mend}") from None


def check_regular(path: Path, limit: int, what: str) -> None:
    """Refuses what `read_bytes` would refuse by its kind and size, where a library reads the file.

    Raises:
        InputError: the file is missing, larger, or no regular file.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as problem:
        raise _unreadable(path, what, problem, InputError) from None
    _check_regular(path, status, limit, InputError)


def list_folder(folder: Path) -> list[Path]:
    """What is in a folder, by name.

    Raises:
        InputError: it is no folder, or may not be read.
    """
    try:
        return sorted(folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{folder}: no such folder") from None
    except (OSError, ValueError) as problem:
        raise _unreadable(folder, "the folder", problem, InputError) from None


def finite_number(text: str) -> float:
    """A number; NaN where the text is none, or is not finite."""
    try:
        number = float(text)
    except ValueError:
        return math.nan
    return number if math.isfinite(number) else math.nan


def shorten(value: object, length: int = 80) -> str:
    """A value for a message, in one line of at most so many characters."""
    text = value if isinstance(value, str) else repr(value)
    text = text[: 4 * length].replace("\n", " ")
    return text if len(text) <= length else text[: length - 3] + "..."


def load_arrays(path: Path, mend: str, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of a .npz file by name: numbers, truth values and text, no Python objects.

    The sizes that the archive and the arrays' headers state are checked before any memory is taken.

    Args:
        mend: what to do about a bad one, for the message.
        names: of the arrays to read; None: all.
    Raises:
        InputError: the file is missing, no archive, cut off or changed, misses an array, or unpacks to far more than
            its size.
    """
    with _open_arrays(path, "archive", mend) as file:
        if file.read(6) == npy_format.MAGIC_PREFIX:
            raise InputError(f"{path}: is a single array (.npy) and no archive of arrays (.npz); {mend}")
        with zipfile.ZipFile(file) as archive:
            return _read_members(path, archive, mend, names)


def load_array(path: Path, mend: str) -> np.ndarray:
    """The array of a .npy file; its header is checked before any memory is taken.

    Raises:
        InputError: the file is missing, no array, or cut off.
    """
    with _open_arrays(path, "array", mend) as file:
        if file.read(4) == b"PK\x03\x04":
            raise InputError(f"{path}: is an archive of arrays (.npz) and no single array (.npy); {mend}")
        file.seek(0)
        return _read_array(file, path.stat().st_size)


@contextmanager
def _open_arrays(path: Path, what: str, mend: str) -> Iterator[IO[bytes]]:
    """A file of numpy's; zip, deflate and the headers of arrays raise a dozen kinds of errors on changed bytes."""
    check_regular(path, _ARRAY_BYTES, "the arrays")
    try:
        with path.open("rb") as file:
            yield file
    except InputError:
        raise
    except Exception as problem:
        reason = shorten(str(problem)) or type(problem).__name__
        raise InputError(f"{path}: is no numpy {what}, or is cut off ({reason}); {mend}") from problem


def load_columns(
    path: Path, mend: str, shapes: dict[str, tuple[str | int, ...]], kinds: dict[str, str]
) -> dict[str, np.ndarray]:
    """Arrays of a .npz file that go together; arguments and errors as of `load_arrays` and `check_columns`."""
    arrays = load_arrays(path, mend, shapes)
    check_columns(path, arrays, shapes, kinds, mend)
    return arrays


def check_columns(
    path: Path,
    arrays: dict[str, np.ndarray],
    shapes: dict[str, tuple[str | int, ...]],
    kinds: dict[str, str],
    mend: str,
) -> None:
    """Arrays have the number types and the shapes that go together.

    Args:
        path: of their file.
        arrays: by name.
        shapes: by name; a letter stands for a length that is the same wherever it stands.
        kinds: by name, letters of numpy's kinds of types; "f" for those that it does not name.
        mend: what to do, for the message.
    Raises:
        InputError: an array has another type or shape.
    """
    lengths: dict[str | int, int] = {}
    for name, shape in shapes.items():
        array = arrays[name]
        allowed = kinds.get(name, "f")
        # numpy's linear algebra has no half and no long double.
        fits = array.ndim == len(shape) and array.dtype.kind in allowed and array.dtype.char not in "eg"
        if fits:
            fits = all(
                lengths.setdefault(n, m) == m if isinstance(n, str) else n == m
                for n, m in zip(shape, array.shape, strict=True)
            )
        if not fits:
            expected = ", ".join(str(lengths.get(n, n)) for n in shape)
            types = {"f": "floating", "i": "integer", "u": "unsigned", "b": "boolean", "U": "text"}
            raise InputError(
                f"{path}: {name} is {array.dtype} {array.shape} and must be {' or '.join(types[k] for k in allowed)} "
                f"({expected}); {mend}"
            )


def _check_regular(path: Path, status: os.stat_result, limit: int, error: type[InputError]) -> None:
    if not stat.S_ISREG(status.st_mode):
        kind = next((name for name, test in _KINDS.items() if test(status.st_mode)), "no regular file")
        raise error(f"{path}: is {kind}; give a regular file")
    if status.st_size > limit:
        raise error(_too_large(path, status.st_size, limit))


_KINDS: dict[str, Callable[[int], bool]] = {
    "a folder": stat.S_ISDIR,
    "a pipe": stat.S_ISFIFO,
    "a device": lambda mode: stat.S_ISCHR(mode) or stat.S_ISBLK(mode),
    "a socket": stat.S_ISSOCK,
}


def _unreadable(path: Path, what: str, problem: OSError | ValueError, error: type[InputError]) -> InputError:
    """The error to raise; a ValueError is a null byte in the name."""
    if isinstance(problem, FileNotFoundError):
        return error(f"{path}: cannot read {what}: no such file; check the path")
    reason = getattr(problem, "strerror", None) or problem
    return error(f"{path}: cannot read {what}: {reason}; give one that you may read")


def _too_large(path: Path, size: int, limit: int) -> str:
    return f"{path}: is {size:,} bytes or more, at most {limit:,} are read; is it the right file?"


def _read_members(
    path: Path, archive: zipfile.ZipFile, mend: str, names: Collection[str] | None
) -> dict[str, np.ndarray]:
    members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
    missing = [name for name in names or () if name not in members]
    if missing:
        raise InputError(f"{path}: misses {', '.join(missing)}; {mend}")
    if names is not None:
        members = {name: members[name] for name in names}
    stated, size = sum(member.file_size for member in members.values()), path.stat().st_size
    if stated > min(max(_SMALL_BYTES, _MAX_UNPACKING * size), _ARRAY_BYTES):
        raise InputError(f"{path}: its {size:,} bytes unpack to {stated:,}, which no file of a run does; {mend}")
    arrays = {}
    for name, member in members.items():
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise ValueError(f"{name} is compressed in a way that numpy does not write")
        with archive.open(member) as file:
            try:
                arrays[name] = _read_array(file, member.file_size)
            except ValueError as problem:
                raise ValueError(f"{name}: {problem}") from problem
    return arrays


def _read_array(file: IO[bytes], size: int) -> np.ndarray:
    """An array of so many bytes with its header."""
    if npy_format.read_magic(file) == (1, 0):
        shape, fortran, dtype = npy_format.read_array_header_1_0(file, _HEADER_BYTES)
    else:
        shape, fortran, dtype = npy_format.read_array_header_2_0(file, _HEADER_BYTES)
    if dtype.kind not in "biufU":
        raise ValueError(f"holds {'Python objects' if dtype.hasobject else dtype}, no numbers")
    needed, there = math.prod(shape) * dtype.itemsize, size - file.tell()
    if needed != there or min(shape, default=0) < 0:
        raise ValueError(f"its header states {dtype} {shape}, {needed:,} bytes, and {there:,} follow")
    content = bytearray(needed)
    if (read := file.readinto(content)) != needed:  # type: ignore[attr-defined]
        raise ValueError(f"ends after {read:,} of {needed:,} bytes")
    array: np.ndarray = np.ndarray(shape, dtype, content, order="F" if fortran else "C")
    return array if dtype.isnative else array.astype(dtype.newbyteorder("="))
