"""Size of an image from the header of its file, before anything is decoded."""

import re
import struct

# Markers of a JPEG that begin a frame, whose size follows; the three in between begin tables.
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
# Restart markers, and the marker of the file's begin: nothing belongs to them.
_JPEG_BARE = frozenset({0x01, *range(0xD0, 0xD9)})
_TIFF_WIDTH, _TIFF_HEIGHT = 256, 257
# Magic number, white space and comments, width and height.
_PNM = re.compile(rb"P[1-6](?:\s+|#[^\n]*\n)+(\d{1,9})(?:\s+|#[^\n]*\n)+(\d{1,9})\s")


def image_size(content: bytes) -> tuple[int, int] | None:
    """(width, height) in pixels of a PNG, JPEG, BMP, TIFF or PNM file; None for other files and broken headers."""
    try:
        if content.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png_size(content)
        if content.startswith(b"\xff\xd8"):
            return _jpeg_size(content)
        if content.startswith(b"BM"):
            return _bmp_size(content)
        if content[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(content)
        found = _PNM.match(content[:10_000])
        return (int(found[1]), int(found[2])) if found else None
    except (struct.error, IndexError):
        return None


def _png_size(content: bytes) -> tuple[int, int] | None:
    """None also where a chunk is longer than the file: OpenCV 5 takes memory, and a minute, for 4 GB of it."""
    place = 8
    while place + 8 <= len(content):
        length = struct.unpack_from(">I", content, place)[0]
        if content[place + 4 : place + 8] == b"IEND":
            break
        place += 12 + length
        if place > len(content):
            return None
    return struct.unpack_from(">II", content, 16)


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    place = 2
    while content[place] == 0xFF:
        marker = content[place + 1]
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack_from(">HH", content, place + 5)
            return width, height
        if marker == 0xFF:
            place += 1
        elif marker in _JPEG_BARE:
            place += 2
        else:
            place += 2 + struct.unpack_from(">H", content, place + 2)[0]
    return None


def _bmp_size(content: bytes) -> tuple[int, int]:
    if struct.unpack_from("<I", content, 14)[0] == 12:
        return struct.unpack_from("<HH", content, 18)
    width, height = struct.unpack_from("<ii", content, 18)
    return abs(width), abs(height)


def _tiff_size(content: bytes) -> tuple[int, int] | None:
    order = "<" if content[:1] == b"I" else ">"
    directory = struct.unpack_from(f"{order}I", content, 4)[0]
    sizes = {}
    for k in range(struct.unpack_from(f"{order}H", content, directory)[0]):
        tag, kind = struct.unpack_from(f"{order}HH", content, directory + 2 + 12 * k)
        if tag in (_TIFF_WIDTH, _TIFF_HEIGHT):
            # A short number or a long one.
            sizes[tag] = struct.unpack_from(f"{order}{'H' if kind == 3 else 'I'}", content, directory + 10 + 12 * k)[0]
    return (sizes[_TIFF_WIDTH], sizes[_TIFF_HEIGHT]) if len(sizes) == 2 else None
