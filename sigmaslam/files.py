"""Files that appear whole or not at all."""

import csv
import io
import json
import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new, empty file in the same folder that replaces `path` when the block ends without an error.

    After an error `path` is as it was before and the new file is gone. The name of the new file ends like
    `path`, so writers that look at the suffix (numpy, matplotlib) behave.

    Args:
        path: the file to write; its folder must exist.
    Yields:
        The path to write to inside the block.
    Raises:
        InputError: the folder does not exist or cannot be written, or `path` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder: give the name of a file in it")
    temporary = path.with_name(f".{path.stem}.{secrets.token_hex(6)}{path.suffix}")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path}: cannot write into the folder {path.parent} ({reason}): create it, or choose another"
        ) from error
    try:
        yield temporary
        # On the disk before the name is: a power cut would else leave an empty file.
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def left_behind(folder: Path) -> list[Path]:
    """Temporary files of `atomic_path` in a folder, by whose name a killed process is known."""
    return [path for path in folder.iterdir() if re.fullmatch(r"\..+\.[0-9a-f]{12}(\.\w+)?", path.name)]


def printable(name: str | Path) -> str:
    """A name that can be written as UTF-8: bytes of a path that are none become `\\udc..`."""
    return str(name).encode("utf-8", "backslashreplace").decode("utf-8")


def csv_text(rows: Iterable[Iterable[Any]]) -> str:
    """Rows as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def make_folder(path: Path) -> None:
    """Makes a folder, and those above it, where there is none.

    Raises:
        InputError: a file is in the way, or it may not be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path} cannot be made a folder ({error.strerror or error}): choose another") from error


def check_new_folder(path: Path, option: str = "--out") -> None:
    """Nothing that is there is written over; `option` of the command line names it.

    Raises:
        InputError: `path` is a file, a folder that holds something, a link to nothing, or no possible name.
    """
    try:
        holds_something = path.exists() and (not path.is_dir() or any(path.iterdir()))
    except (OSError, ValueError) as error:  # a name that is too long, a folder that may not be read
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path}: cannot be a new folder ({reason}): choose another {option}") from None
    if path.is_symlink() and not path.exists():
        raise InputError(f"{path}: is a link to {path.readlink()}, which is not there: choose another {option}")
    if holds_something:
        raise InputError(f"{path} exists and is not an empty folder: choose another {option}, or remove it")


def atomic_write_text(path: str | Path, text: str) -> None:
    """Write `text` as UTF-8; see `atomic_path`."""
    with atomic_path(path) as temporary:
        # Names of files may have bytes that are no UTF-8, which Python keeps as lone surrogates.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def atomic_write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Write entries as JSON that people can read; see `atomic_path`."""
    atomic_write_text(path, json.dumps(content, indent=2) + "\n")


def save_arrays(path: str | Path, **arrays: Any) -> None:
    """Write arrays by name as a compressed .npz; see `atomic_path`."""
    with atomic_path(path) as temporary, temporary.open("wb") as file:  # to a path numpy adds .npz
        np.savez_compressed(file, **arrays)


def save_array(path: str | Path, array: np.ndarray) -> None:
    """Write an array as .npy; see `atomic_path`."""
    with atomic_path(path) as temporary:
        np.save(temporary, array)


def write_ply(path: str | Path, columns: dict[str, tuple[str, np.ndarray]]) -> None:
    """Write points as a binary PLY: by the name of a property its type ("float", "uchar", "int") and values (N,)."""
    kinds = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    vertices = np.zeros(len(columns["x"][1]), [(name, kinds[kind]) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        vertices[name] = values
    names = "".join(f"property {kind} {name}\n" for name, (kind, _) in columns.items())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}end_header\n"
    atomic_write_bytes(path, header.encode("ascii") + vertices.tobytes())


def save_png(figure: Any, path: str | Path) -> None:
    """A matplotlib figure as PNG."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130)


def atomic_write_bytes(path: str | Path, content: bytes) -> None:
    """Write `content`; see `atomic_path`."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
