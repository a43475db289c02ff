"""The size in an image's header is the one it is decoded to, and is asked before anything is decoded."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.bodies.object_region import read_region
from sigmaslam.errors import FrameError, InputError
from sigmaslam.readers import open_sequence
from sigmaslam.readers.image_size import image_size
from sigmaslam.readers.images import decode_image, read_image

KINDS = [
    *((suffix, 1, np.uint8) for suffix in (".png", ".jpg", ".bmp", ".tiff", ".pgm")),
    *((suffix, 3, np.uint8) for suffix in (".png", ".jpg", ".bmp", ".tiff", ".ppm")),
    *((suffix, 1, np.uint16) for suffix in (".png", ".tiff", ".pgm")),
    *((suffix, 3, np.uint16) for suffix in (".png", ".tiff", ".ppm")),
]


@pytest.mark.parametrize(("suffix", "channels", "dtype"), KINDS)
@pytest.mark.parametrize(("width", "height"), [(1, 1), (37, 53), (640, 3)])
def test_the_stated_size_is_that_of_the_decoded_image(suffix: str, channels: int, dtype: type, width: int, height: int):
    image = np.random.default_rng(0).integers(0, 255, (height, width, channels)).astype(dtype)
    content = cv2.imencode(suffix, image)[1].tobytes()
    assert image_size(content) == (width, height)
    assert cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED).shape[:2] == (height, width)


@pytest.mark.parametrize("options", [[cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]])
def test_kinds_of_jpeg(options: list[int]):
    content = cv2.imencode(".jpg", np.zeros((48, 64), np.uint8), options)[1].tobytes()
    assert image_size(content) == (64, 48)
    # Comments of any length, and fill bytes, may stand before the size.
    commented = content[:2] + b"\xff\xff\xfe\x00\x08remark" + content[2:]
    assert image_size(commented) == (64, 48)


def test_tiff_of_either_byte_order():
    for order, mark in (("<", b"II*\0"), (">", b"MM\0*")):
        entries = b"".join(
            struct.pack(f"{order}HHI", tag, 3, 1) + struct.pack(f"{order}HH", n, 0) for tag, n in ((256, 64), (257, 48))
        )
        assert image_size(mark + struct.pack(f"{order}IH", 8, 2) + entries) == (64, 48)


def test_a_pnm_may_have_comments():
    assert image_size(b"P5 # made by hand\n# twice\n64\n 48 255\n") == (64, 48)


@pytest.mark.parametrize(
    "content", [b"", b"P5", b"BM", b"\xff\xd8", b"\xff\xd8\xff\xda\x00", b"II*\0\xff\xff\xff\xff", b"GIF89a@\x000\x00"]
)
def test_other_and_broken_files_have_no_size(content: bytes):
    assert image_size(content) is None


def bomb(width: int, height: int) -> bytes:
    """A PNG of a few bytes that states a size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    packed = zlib.compress(b"\0" * 10_000)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def test_a_decompression_bomb_is_refused_before_it_is_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "bomb.png").write_bytes(bomb(60_000, 60_000))
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: pytest.fail("it is decoded"))
    with pytest.raises(FrameError, match=r"bomb\.png: states a size of 60000x60000 pixels"):
        read_image(tmp_path / "bomb.png")
    with pytest.raises(InputError, match=r"bomb\.png: states a size.*give the mask"):
        read_region(str(tmp_path / "bomb.png"), 64, 48)


def test_a_chunk_that_is_longer_than_the_file_is_refused_before_it_is_decoded(monkeypatch: pytest.MonkeyPatch):
    """Found by the fuzzer: OpenCV took 4 GB and 76 s."""
    content = bytearray(bomb(64, 48))
    data = content.index(b"IDAT")
    content[data - 4 : data] = b"\xff\x00\x0c\x3b"
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: pytest.fail("it is decoded"))
    with pytest.raises(FrameError, match="or truncated"):
        decode_image(bytes(content), "image")


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), Path.mkdir])
def test_images_that_are_no_files_are_skipped(demo_sequence: Path, tmp_path: Path, make):
    """A pipe would be waited for, a link to /dev/zero never ends."""
    for eye in ("image_0", "image_1"):
        (tmp_path / eye).mkdir()
        for path in sorted((demo_sequence / eye).iterdir())[:3]:
            (tmp_path / eye / path.name).write_bytes(path.read_bytes())
    (tmp_path / "calib.txt").write_bytes((demo_sequence / "calib.txt").read_bytes())
    replaced = sorted((tmp_path / "image_1").iterdir())[1]
    replaced.unlink()
    make(replaced)
    sequence = open_sequence(tmp_path)
    assert [frame.index for frame in sequence.frames()] == [0, 2]
    assert str(replaced) in sequence.skipped[0].reason


def test_a_folder_that_may_not_be_read_is_refused(demo_sequence: Path, monkeypatch: pytest.MonkeyPatch):
    """Tests may run as root, to whom every folder is open."""
    for method in ("iterdir", "is_dir"):
        with monkeypatch.context() as changed:

            def refuse(path: Path) -> None:
                raise PermissionError(13, "Permission denied", str(path))

            changed.setattr(Path, method, refuse)
            with pytest.raises(InputError, match="Permission denied"):
                open_sequence(demo_sequence)
