"""What is no regular file, too large, or states more than it has, is refused before memory or time is spent."""

import io
import os
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sigmaslam import bounded_files
from sigmaslam.bounded_files import (
    check_columns,
    check_regular,
    list_folder,
    load_array,
    load_arrays,
    read_bytes,
    read_text,
    shorten,
)
from sigmaslam.errors import FrameError, InputError
from sigmaslam.files import atomic_write_text

MEND = "make it again"


def fifo(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.mkdir()


def large(path: Path) -> None:
    path.write_bytes(b"0" * 1001)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (fifo, "is a pipe"),
        (endless, "is a device"),
        (folder, "directory"),
        (large, "at most 1,000"),
        (lambda path: None, "no such file"),
    ],
)
def test_what_is_no_small_regular_file_is_refused_at_once(tmp_path: Path, make: Callable[[Path], None], words: str):
    path = tmp_path / "file"
    make(path)
    begin = time.perf_counter()
    with pytest.raises(FrameError, match=words) as caught:
        read_bytes(path, 1000, "the image", FrameError)
    assert str(path) in str(caught.value)
    with pytest.raises(InputError, match="is a folder" if make is folder else words):
        check_regular(path, 1000, "the image")
    assert time.perf_counter() - begin < 1.0


def test_a_regular_file_up_to_the_limit_is_read_whole(tmp_path: Path):
    path = tmp_path / "file"
    path.write_bytes(b"\xef\xbb\xbfa\r\n" + b"b" * 994)
    assert read_bytes(path, 1000, "it") == path.read_bytes()
    assert read_text(path, 1000, "it") == "a\r\n" + "b" * 994
    (tmp_path / "link").symlink_to(path)
    assert read_bytes(tmp_path / "link", 1000, "it") == path.read_bytes()


def test_bytes_that_are_no_text_are_named(tmp_path: Path):
    (tmp_path / "file").write_bytes(b"ab\xff")
    with pytest.raises(InputError, match=r"cannot read it: is not text \(byte 2"):
        read_text(tmp_path / "file", 1000, "it")


def test_a_folder_that_may_not_be_read_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Tests may run as root, to whom every folder is open."""

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(InputError, match="cannot read the folder: Permission denied") as caught:
        list_folder(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_names_that_are_no_utf8_are_written_escaped(tmp_path: Path):
    atomic_write_text(tmp_path / "run.json", os.fsdecode(b"caf\xe9"))
    assert (tmp_path / "run.json").read_text() == "caf\\udce9"


@pytest.mark.parametrize(("value", "text"), [("a\nb", "a b"), ([1, 2], "[1, 2]"), ("x" * 100, "x" * 77 + "...")])
def test_values_are_shown_in_one_short_line(value: object, text: str):
    assert shorten(value) == text


# ---- archives


def packed(**arrays: np.ndarray) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def header(shape: str, dtype: str = "<f8", size: int = 8) -> bytes:
    """A .npy of so many bytes that states a shape."""
    text = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape}, }}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(size)


def member(content: bytes, name: str = "a.npy", kind: int = zipfile.ZIP_STORED) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", kind) as file:
        file.writestr(name, content)
    return archive.getvalue()


def states_four_gigabytes() -> bytes:
    """An archive whose directory states a size that its 300 bytes do not have."""
    content = bytearray(member(header("(1,)")))
    directory = content.index(b"PK\x01\x02")
    content[directory + 24 : directory + 28] = struct.pack("<I", 4_000_000_000)
    return bytes(content)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"x y z\n", "is no numpy archive"),
        (b"", "is no numpy archive"),
        (packed(a=np.ones(9))[:100], "is no numpy archive"),
        (header("(1,)"), "a single array (.npy) and no archive"),
        (packed(b=np.ones(3)), "misses a"),
        (packed(a=np.array([{}, None])), "Python objects"),
        (packed(a=np.array([(1, 2.0)], "i4,f8")), "no numbers"),
        (member(header("(2684354560,)")), "states float64 (2684354560,), 21,474,836,480 bytes, and 8 follow"),
        (member(header("(-1,)")), "and 8 follow"),
        (member(header("(9223372036854775807, 9223372036854775807)")), "states float64 (9223372036854775807"),
        (member(header("((((1,),),),)")), "is no numpy archive"),
        (member(header("(1,)", "|O")), "Python objects"),
        (member(header("(1,)"), kind=zipfile.ZIP_LZMA), "compressed in a way"),
        (member(b"no array"), "is no numpy archive"),
        (states_four_gigabytes(), "unpack to 4,000,000,000"),
    ],
)
def test_bad_archives_are_refused_with_the_mend(tmp_path: Path, content: bytes, words: str):
    path = tmp_path / "map.npz"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_arrays(path, MEND, ("a",))
    for word in (str(path), words, MEND):
        assert word in str(caught.value)
    assert "pickle" not in str(caught.value)


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "map.npz"
    np.savez_compressed(path, a=np.zeros(1_000_000))  # 8 MB in 8 kB
    assert len(load_arrays(path, MEND)["a"]) == 1_000_000
    monkeypatch.setattr(bounded_files, "_SMALL_BYTES", 1_000_000)
    monkeypatch.setattr(bounded_files, "_read_array", lambda *arguments: pytest.fail("it is unpacked"))
    with pytest.raises(InputError, match="unpack to 8,000,128"):
        load_arrays(path, MEND)


ARRAYS = {
    "a": np.arange(6.0).reshape(2, 3),
    "b": np.asfortranarray(np.arange(6, dtype=">i2").reshape(3, 2)),
    "c": np.array("klt"),
    "d": np.zeros((0, 4), np.float32),
    "e": np.array([True, False]),
}


def test_arrays_come_back_as_numpy_reads_them(tmp_path: Path):
    np.savez_compressed(tmp_path / "whole.npz", **ARRAYS)
    read = load_arrays(tmp_path / "whole.npz", MEND)
    assert list(read) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(read[name], array)
        assert read[name].dtype == array.dtype.newbyteorder("=")
        assert read[name].flags.writeable
        np.save(tmp_path / "one.npy", array)
        np.testing.assert_array_equal(load_array(tmp_path / "one.npy", MEND), array)
    assert list(load_arrays(tmp_path / "whole.npz", MEND, ("c", "a"))) == ["c", "a"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (packed(a=np.ones(3)), "an archive of arrays (.npz)"),
        (b"1 2 3\n", "is no numpy array"),
        (header("(2684354560,)"), "21,474,836,480 bytes, and 8 follow"),
        (header("(1,)", "|O"), "Python objects"),
        (header("(2,)"), "16 bytes, and 8 follow"),
    ],
)
def test_bad_arrays_are_refused_with_the_mend(tmp_path: Path, content: bytes, words: str):
    path = tmp_path / "covariance.npy"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        load_array(path, MEND)
    for word in (str(path), words, MEND):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"x": np.zeros((3, 2), "U2")}, "x is <U2 (3, 2) and must be floating (3, 2)"),
        ({"x": np.zeros((4, 2))}, "x is float64 (4, 2) and must be floating (3, 2)"),
        ({"x": np.zeros((3, 2), np.float16)}, "x is float16 (3, 2) and must be floating (3, 2)"),
        ({"x": np.zeros(3)}, "x is float64 (3,) and must be floating (3, 2)"),
        ({"n": np.zeros(3)}, "n is float64 (3,) and must be integer or unsigned (M)"),
    ],
)
def test_columns_go_together(tmp_path: Path, change: dict[str, np.ndarray], words: str):
    shapes: dict[str, tuple[str | int, ...]] = {"n": ("M",), "x": ("M", 2)}
    good = {"n": np.zeros(3, int), "x": np.zeros((3, 2))}
    check_columns(tmp_path, good, shapes, {"n": "iu"}, MEND)
    with pytest.raises(InputError) as caught:
        check_columns(tmp_path, good | change, shapes, {"n": "iu"}, MEND)
    assert words in str(caught.value)
