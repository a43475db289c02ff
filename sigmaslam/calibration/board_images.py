"""Images of a board: which belong together, and the corners in them."""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from sigmaslam.calibration.boards import NOTHING, Board, DetectedCorners
from sigmaslam.calibration.eye_names import EyeName, eye_tellers
from sigmaslam.errors import FrameError, InputError
from sigmaslam.readers.images import IMAGE_SUFFIXES, read_grey
from sigmaslam.readers.pairing import list_images


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
    """Pairs, where the names of all files say which eye they are of (`eye_tellers`); else images of one camera.

    Args:
        paths: files, or folders of them; a folder without images stands for the folders in it.

    Raises:
        InputError: a path is missing or holds no image, two images have one name, or two folders look like two eyes
            (as many images, or the same names) and no name tells which, or their images do not pair.
    """
    files = [file for path in paths for file in _files_of(path)]
    alone: list[list[Path]] = []
    untold: list[Path] = []
    for tell in eye_tellers():
        names = [(file, tell(file)) for file in files]
        told = [(file, name) for file, name in names if name is not None]
        if len({name.eye for _, name in told}) < 2:
            continue
        kinds = [_moments(told, kind) for kind in range(len(told[0][1].moments))]
        moments = max(kinds, key=lambda each: sum(map(all, each.values())))
        pairs = sum(map(all, moments.values()))
        if len(told) < len(files):
            untold += [file for file, name in names if pairs > 1 and len(files) <= 4 * pairs and name is None]
            continue
        if pairs:
            # 2 comes before 10.
            order = sorted(moments, key=lambda name: re.sub(r"\d+", lambda digits: digits[0].zfill(20), name))
            return [
                BoardImages(" + ".join(file.name for file in moments[name] if file), tuple(moments[name]))
                for name in order
            ]
        alone.append([next(file for file, name in told if name.eye == k) for k in (0, 1)])
    if alone:
        raise InputError(
            f"no image of the left eye has one of the right eye beside it ({alone[0][0]}, {alone[0][1]}): give both "
            "images of a moment the same name but for the eye"
        )
    if untold:
        raise InputError(f"{untold[0]}: its name tells no eye, others do: leave it out; of one camera: rename those")
    _refuse_two_eyes(files)
    return [BoardImages(file.name, (file,)) for file in files]


def _moments(told: Sequence[tuple[Path, EyeName]], kind: int) -> dict[str, list[Path | None]]:
    """The files of both eyes, by one of `EyeName.moments`; nothing where several would have the same name by it."""
    moments: dict[str, list[Path | None]] = {}
    for file, name in told:
        eyes = moments.setdefault(name.moments[kind], [None, None])
        other = eyes[name.eye]
        if other is not None and other.parent == file.parent and other.stem == file.stem:
            raise InputError(f"{file} and {other} have the same name: give one of them")
        if other is not None:
            return {}
        eyes[name.eye] = file
    return moments


def _refuse_two_eyes(files: Sequence[Path]) -> None:
    """Refuse two folders that are one of each eye, as far as can be seen."""
    folders: dict[Path, set[str]] = {}
    for file in files:
        folders.setdefault(file.parent, set()).add(file.name)
    if len(folders) == 2:
        (one, first), (other, second) = folders.items()
        if len(first) == len(second) or first & second:
            raise InputError(
                f"{one} and {other} hold {len(first)} and {len(second)} images, and no name says which eye they are "
                "of: call the folders left and right, or put the images of one camera into one folder"
            )


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
    if any(child.suffix.lower() in IMAGE_SUFFIXES and not child.name.startswith(".") for child in path.iterdir()):
        return list_images(path)
    folders = sorted(child for child in path.iterdir() if child.is_dir() and not child.name.startswith("."))
    inside: list[Path] = []
    for folder in folders:
        with suppress(InputError):  # it may hold something else
            inside += _files_of(folder)
    return inside or list_images(path)
