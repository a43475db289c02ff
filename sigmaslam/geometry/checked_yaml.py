"""YAML calibration files whose values are checked as they are read."""

import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, Self, cast

import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text, shorten
from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.restricted_yaml import parse_yaml

_REQUIRED: Any = object()


class CalibrationYaml:
    """A YAML calibration file whose getters raise errors that name file, key and what was expected."""

    def __init__(self, path: Path, entries: dict[str, Any], prefix: str = "") -> None:
        self.path = path
        self.entries = entries
        self.prefix = prefix

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file; what OpenCV writes into its files and is no plain YAML is taken out."""
        path = Path(path)
        text = read_text(path, CALIBRATION_BYTES, "the calibration", CalibrationError)
        first, _, body = text.partition("\n")
        if first.startswith("%YAML"):
            # OpenCV tags matrices, and can do without the space between key and list.
            text = "\n" + re.sub(r"(?m)^(\s*[\w.]+):(?=\[)", r"\1: ", body.replace("!!opencv-matrix", ""))
        entries = parse_yaml(text, path, CalibrationError)
        if not isinstance(entries, dict):
            found = {type(None): "nothing", list: "a list", str: "text"}.get(type(entries), "a single value")
            raise CalibrationError(f"{path}: expected keys with values, found {found}: give a calibration file")
        return cls(path, entries)

    @property
    def where(self) -> str:
        """File and section, for messages."""
        return f"{self.path}: {self.prefix.rstrip('.')}" if self.prefix else str(self.path)

    def error(self, message: str) -> CalibrationError:
        """The error to raise about this section."""
        return CalibrationError(f"{self.where}: {message}")

    def section(self, key: str) -> "CalibrationYaml":
        """The mapping under a key."""
        entries = self._get(key, "a mapping")
        if not isinstance(entries, dict):
            raise self._wrong(key, "a mapping", entries)
        return CalibrationYaml(self.path, entries, f"{self.prefix}{key}.")

    def text(self, key: str, default: str = _REQUIRED) -> str:
        """A word."""
        value = self._get(key, "a word", default)
        # YAML reads a bare `none` as a string, and `null` and `~` as None.
        return "none" if value is None else str(value)

    def number(self, key: str, default: float = _REQUIRED) -> float:
        """A finite number."""
        return float(self.numbers(key, (), default))

    def integer(self, key: str) -> int:
        """A whole number."""
        value = self.number(key)
        if value != int(value):
            raise self._wrong(key, "a whole number", value)
        return int(value)

    def numbers(self, key: str, shape: tuple[int | None, ...], default: Any = _REQUIRED) -> np.ndarray:
        """A float64 array of nested lists; None in `shape` stands for any length."""
        size = "x".join("any" if n is None else str(n) for n in shape)
        expected = "a number" if not shape else "a list of numbers" if size == "any" else f"{size} numbers in lists"
        value = self._get(key, expected, default)
        try:
            numbers = np.array(_floats(value), dtype=np.float64)
        except (ValueError, OverflowError):
            raise self._wrong(key, expected, value) from None
        fits = numbers.ndim == len(shape) and all(
            n is None or n == m for n, m in zip(shape, numbers.shape, strict=True)
        )
        if not fits or not np.all(np.isfinite(numbers)):
            actual = "x".join(map(str, numbers.shape)) or "one number"
            raise self._wrong(key, expected, value, f" (size {actual})")
        return cast(np.ndarray, numbers)

    def transform(self, key: str) -> np.ndarray:
        """A matrix (4, 4), in rows or as OpenCV writes matrices."""
        if isinstance(self.entries.get(key), dict):
            return self.section(key).numbers("data", (16,)).reshape(4, 4)
        return self.numbers(key, (4, 4))

    def reject_unknown(self, known: Collection[str]) -> None:
        """Refuse unknown keys, as a misspelt optional key would be ignored."""
        unknown = [str(key) for key in self.entries if key not in known]
        if unknown:
            raise self.error(f"unknown key {shorten(', '.join(unknown))}; known are {', '.join(known)}")

    def _get(self, key: str, expected: str, default: Any = _REQUIRED) -> Any:
        if key in self.entries:
            return self.entries[key]
        if default is not _REQUIRED:
            return default
        raise CalibrationError(f"{self.path}: key '{self.prefix}{key}' is missing; expected {expected}")

    def _wrong(self, key: str, expected: str, value: Any, detail: str = "") -> CalibrationError:
        return CalibrationError(
            f"{self.path}: key '{self.prefix}{key}' must be {expected}, got {shorten(value)}{detail}"
        )


def _floats(value: Any) -> Any:
    """Nested lists of floats; text counts where it is a number in quotes.

    Raises:
        ValueError, OverflowError: an item is something else, or too large.
    """
    if isinstance(value, list):
        return [_floats(each) for each in value]
    if isinstance(value, str | int | float) and not isinstance(value, bool):
        return float(value)
    raise ValueError
