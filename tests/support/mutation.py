"""Small files changed at random, as fuzzers change them: bytes, numbers in text, arrays in archives."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Callable
from random import Random

import numpy as np

# Values that parsers stumble over, put in place of numbers of a text.
NUMBERS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "-0", "1e308", "1e-320", "9" * 400, "1" + "0" * 5000, "0x_", "0b_"),
    *("1:2:3", "2020-13-45", "2011-02-30 25:61:61", "1_000", "true", "null", "~", "''", "1e-5", "18446744073709551616"),
    *("32768", "1403715273262142976", "0.1", "[]", "{}", "!!int x", "!!float x", "!!timestamp x", "!!binary x", "٣"),
)
# Pieces of syntax that are put into a text.
PIECES = (
    *("\n", " ", ":", ": ", ",", ";", "\t", "#", "-", "- ", "[", "]", "{", "}", "[" * 50, "{a: " * 40, "\0", "\ufeff"),
    *("&a ", "*a", "&a [*a, *a, *a]", "<<: *a", "<<: {a: 1}", "!!python/object/apply:os.system [ls]", "!!set ", "? "),
    *("%YAML:1.0\n", "---\n", "...\n", "|\n", ">\n", '"', "'", "\r", "\u2028", "\ud800", "e", ".", "left: 1\n", "fx"),
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:e[-+]?\d+)?")


def mutate(content: bytes, others: list[bytes], random: Random) -> bytes:
    """A few changes, each of a kind that is drawn.

    Args:
        content: of a file.
        others: of files of the same kind, to take parts from.
        random: source of all that is drawn.
    """
    changes: list[Callable[[bytes, list[bytes], Random], bytes]] = [
        _flip,
        _put_number,
        _put_number,
        _insert_piece,
        _insert_piece,
        _delete,
        _repeat,
        _cut,
        _splice,
        _swap_lines,
    ]
    for _ in range(random.randint(1, 4)):
        content = random.choice(changes)(content, others, random)
    return content


def mutate_archive(content: bytes, others: list[bytes], random: Random) -> bytes:
    """A .npz in which arrays are left out, have another type, shape or values, or changed bytes."""
    if random.random() < 0.2:
        return mutate(content, others, random)
    with np.load(io.BytesIO(content)) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = random.choice(sorted(arrays))
    changed = _change_array(arrays[name], random)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED if random.random() < 0.5 else zipfile.ZIP_STORED) as archive:
        for each, array in arrays.items():
            if each == name and changed is None:
                continue
            member = io.BytesIO()
            np.save(member, changed if each == name and changed is not None else array, allow_pickle=True)
            written = member.getvalue()
            if each == name and random.random() < 0.3:
                written = mutate(written, [], random)
            archive.writestr(f"{each}.npy", written)
    return packed.getvalue()


def mutate_array(content: bytes, others: list[bytes], random: Random) -> bytes:
    """A .npy with another type, shape or values, or changed bytes."""
    if random.random() < 0.5:
        return mutate(content, others, random)
    changed = _change_array(np.load(io.BytesIO(content)), random)
    packed = io.BytesIO()
    np.save(packed, changed if changed is not None else np.zeros(0), allow_pickle=True)
    return packed.getvalue()


def _change_array(array: np.ndarray, random: Random) -> np.ndarray | None:
    kind = random.randrange(8)
    if kind == 0:
        return None
    if kind == 1:
        types = ["U5", "O"] if array.dtype.kind == "U" else ["U5", "f2", "f4", "i1", "u8", "c16", "?", ">f8", "O"]
        with np.errstate(all="ignore"):
            return array.astype(random.choice(types))
    if kind == 2 and array.ndim:
        return array[: random.randint(0, array.shape[0])]
    if kind == 3:
        return array.reshape(-1)
    if kind == 4:
        return array[..., None]
    if kind == 5 and array.ndim:
        return np.concatenate([array, array])
    changed = array.copy()
    if changed.size and changed.dtype.kind in "fiu":
        value = random.choice([np.nan, np.inf, -1.0, 0.0, 1e300, 2.0**31, 2.0**63, 1e-300])
        with np.errstate(all="ignore"):
            place = random.randrange(changed.size)
            changed.reshape(-1)[place] = np.array([value]).astype(changed.dtype)[0]
            if random.random() < 0.2:
                changed[...] = np.array([value]).astype(changed.dtype)[0]
    return changed


def _flip(content: bytes, others: list[bytes], random: Random) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice([1, 1, 2, 8])):
        if changed:
            changed[random.randrange(len(changed))] = random.choice([0, 1, 0x7F, 0x80, 0xFF, random.randrange(256)])
    return bytes(changed)


def _put_number(content: bytes, others: list[bytes], random: Random) -> bytes:
    found = [match.span() for match in _NUMBER.finditer(content[:20_000])]
    if not found:
        return content
    begin, end = random.choice(found)
    return content[:begin] + random.choice(NUMBERS).encode() + content[end:]


def _insert_piece(content: bytes, others: list[bytes], random: Random) -> bytes:
    place = random.randint(0, len(content))
    return content[:place] + random.choice(PIECES).encode(errors="surrogatepass") + content[place:]


def _span(content: bytes, random: Random) -> tuple[int, int]:
    begin = random.randint(0, len(content))
    return begin, min(len(content), begin + random.choice([1, 2, 4, 16, 64, 256]))


def _delete(content: bytes, others: list[bytes], random: Random) -> bytes:
    begin, end = _span(content, random)
    return content[:begin] + content[end:]


def _repeat(content: bytes, others: list[bytes], random: Random) -> bytes:
    begin, end = _span(content, random)
    return content[:end] + content[begin:end] * random.choice([1, 2, 30]) + content[end:]


def _cut(content: bytes, others: list[bytes], random: Random) -> bytes:
    return content[: random.randint(0, len(content))]


def _splice(content: bytes, others: list[bytes], random: Random) -> bytes:
    other = random.choice(others) if others else content
    return content[: random.randint(0, len(content))] + other[random.randint(0, len(other)) :]


def _swap_lines(content: bytes, others: list[bytes], random: Random) -> bytes:
    lines = content.split(b"\n")
    i, j = random.randrange(len(lines)), random.randrange(len(lines))
    lines[i], lines[j] = lines[j], lines[i]
    if random.random() < 0.5:
        lines.insert(i, lines[j])
    return b"\n".join(lines)
