"""Images of a board: which belong together, and the corners in them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sigmaslam.calibration.boards import NOTHING, Board, DetectedCorners
from sigmaslam.errors import FrameError, InputError
from sigmaslam.readers.images import IMAGE_SUFFIXES, read_grey
from sigmaslam.readers.pairing import list_images

# What tells the eyes apart in names of files, or of the folders that they lie in.
_EYES = (("left", "right"), ("cam0", "cam1"), ("infra1", "infra2"))
# At the end of a file's name.
_ENDINGS = (("_0", "_1"), ("_l", "_r"))
# Before the number at its end, as in OpenCV's `imageL01`.
_LETTERS = ("l", "r")


@dataclass(frozen=True, slots=True)
class BoardImages:
    """Images of one moment: of one camera, or of both eyes, of which one may be missing.

    Attributes:
        name: for messages.
        files: of each eye.
    """

    name: str
    files: tuple[Path | None, ...]


@dataclass(frozen=True, slots=True)
class BoardViews:
    """What images show of a board.

    Attributes:
        names: of the images or pairs.
        views: of each, the corners in each eye.
        sizes: (width, height) of each eye's images.
        unreadable: name and reason of images that cannot be read; their eye shows nothing.
    """

    names: tuple[str, ...]
    views: tuple[tuple[DetectedCorners, ...], ...]
    sizes: tuple[tuple[int, int], ...]
    unreadable: tuple[tuple[str, str], ...]


def find_board_images(paths: Sequence[Path]) -> list[BoardImages]:
    """Pairs, where the names of all files have a word for the eye; else images of one camera.

    Args:
        paths: files, or folders of them; a folder with the folders of both eyes counts as both.

    Raises:
        InputError: a path is missing or holds no image, or two folders hold as many and nothing tells the eyes apart.
    """
    groups = [_files_of(path) for path in paths]
    files = [file for group in groups for file in group]
    for tell in _tells():
        told = [tell(file) for file in files]
        if not all(told):
            continue
        moments: dict[str, list[Path | None]] = {}
        for file, (key, eye) in zip(files, (each for each in told if each), strict=True):
            eyes = moments.setdefault(key, [None, None])
            if eyes[eye] is not None:
                raise InputError(f"{file} and {eyes[eye]} have the same name: give one of them")
            eyes[eye] = file
        if all(any(eyes[k] for eyes in moments.values()) for k in (0, 1)):
            return [
                BoardImages(" + ".join(file.name for file in eyes if file), tuple(eyes))
                for _, eyes in sorted(moments.items(), key=lambda moment: _by_number(moment[0]))
            ]
    if len(paths) == 2 and all(path.is_dir() for path in paths) and len(groups[0]) == len(groups[1]):
        raise InputError(
            f"{paths[0]} and {paths[1]} hold {len(groups[0])} images each, and no name says which eye they are of: "
            "call the folders left and right, or put the images of one camera into one folder"
        )
    return [BoardImages(file.name, (file,)) for file in files]


def read_board_views(images: Sequence[BoardImages], board: Board, done: Callable[[], object]) -> BoardViews:
    """Find the board in every image; `done` is called after each moment.

    Raises:
        InputError: no image of an eye can be read, or their sizes differ.
    """
    sizes: list[tuple[int, int] | None] = [None] * len(images[0].files)
    views, unreadable = [], []
    for moment in images:
        seen = []
        for eye, file in enumerate(moment.files):
            corners = NOTHING
            if file is not None:
                try:
                    image = read_grey(file)
                except FrameError as error:
                    unreadable.append((file.name, str(error)))
                else:
                    size = (image.shape[1], image.shape[0])
                    expected = sizes[eye] = sizes[eye] or size
                    if size != expected:
                        raise InputError(
                            f"{file}: image is {size[0]}x{size[1]}, those before {expected[0]}x{expected[1]}: "
                            "calibrate images of one size"
                        )
                    corners = board.detect(image)
            seen.append(corners)
        views.append(tuple(seen))
        done()
    read = tuple(size for size in sizes if size is not None)
    if len(read) < len(sizes):
        raise InputError(f"{images[0].files[0]}: no image of one of the eyes can be read: check the files")
    return BoardViews(tuple(moment.name for moment in images), tuple(views), read, tuple(unreadable))


def _files_of(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if not path.is_dir():
        raise InputError(f"{path}: no such file or folder")
    if any(child.suffix.lower() in IMAGE_SUFFIXES for child in path.iterdir()):
        return list_images(path)
    eyes = [path / name for names in _EYES for name in names if (path / name).is_dir()]
    return [file for eye in eyes for file in list_images(eye)] or list_images(path)


def _tells() -> Iterable[Callable[[Path], tuple[str, int] | None]]:
    """Ways to tell the eyes apart: of a file, what both eyes have in their names, and which eye it is."""
    for words in _EYES:
        yield lambda file, words=words: _word(file.stem, words)  # type: ignore[misc]
        yield lambda file, words=words: _in_folder(file, words)  # type: ignore[misc]
    for endings in _ENDINGS:
        yield lambda file, endings=endings: _word(file.stem, endings, "$")  # type: ignore[misc]
    yield lambda file: _word(file.stem, _LETTERS, r"(?=\d+$)")
    for words in _EYES:
        yield lambda file, words=words: _inside_folder_name(file, words)  # type: ignore[misc]


def _word(name: str, words: tuple[str, str], behind: str = "") -> tuple[str, int] | None:
    found = re.search(f"({words[0]}|{words[1]}){behind}", name, re.IGNORECASE)
    return found and (name[: found.start()] + "*" + name[found.end() :], words.index(found[1].lower()))


def _by_number(name: str) -> str:
    """A key that sorts 2 before 10."""
    return re.sub(r"\d+", lambda digits: digits[0].zfill(20), name)


def _in_folder(file: Path, words: tuple[str, str]) -> tuple[str, int] | None:
    """Folders of the eyes may have a folder of images in them, as EuRoC's `cam0/data`."""
    for folder in (file.parent, file.parent.parent):
        if folder.name.lower() in words:
            return file.stem, words.index(folder.name.lower())
    return None


def _inside_folder_name(file: Path, words: tuple[str, str]) -> tuple[str, int] | None:
    """Names of folders such as `stereoLeft`; the numbers in a file's name are those of its moment."""
    told = _word(file.parent.name, words)
    return told and ("-".join(re.findall(r"\d+", file.stem)) or file.stem, told[1])
