"""Photographs of one's own as textures."""

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.readers.images import IMAGE_SUFFIXES, read_grey

# Smaller ones have too few pixels for a texture.
_MIN_SIDE = 64


@lru_cache(maxsize=8)
def photographs(folder: str) -> tuple[Path, ...]:
    """The images of a folder, by name; folders in it are not looked into.

    Raises:
        InputError: there is no such folder, or no image in it.
    """
    if not Path(folder).is_dir():
        raise InputError(f"{folder} is no folder: give one with photographs")
    found = tuple(sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in IMAGE_SUFFIXES))
    if not found:
        suffixes = ", ".join(sorted(IMAGE_SUFFIXES))
        raise InputError(f"{folder}: no image in it ({suffixes}): give a folder with photographs")
    return found


def cut(folder: str, size: int, rng: np.random.Generator) -> np.ndarray:
    """A square of one of the photographs, at its own or a smaller scale; (size, size) uint8.

    Args:
        folder: of photographs.
        size: side, pixels; photographs that are smaller are enlarged.
        rng: source of the choice of photograph, place and scale.
    Raises:
        InputError: there is no photograph, or one cannot be read or is too small.
    """
    paths = photographs(folder)
    path = paths[int(rng.integers(len(paths)))]
    image = _read(path)
    shortest = min(image.shape)
    side = round(float(np.exp(rng.uniform(np.log(min(size, shortest)), np.log(shortest)))))
    top, left = (int(rng.integers(length - side + 1)) for length in image.shape)
    part = image[top : top + side, left : left + side]
    interpolation = cv2.INTER_AREA if side > size else cv2.INTER_LINEAR
    return np.array(cv2.resize(part, (size, size), interpolation=interpolation))


@lru_cache(maxsize=16)
def _read(path: Path) -> np.ndarray:
    image = read_grey(path)
    if min(image.shape) < _MIN_SIDE:
        raise InputError(f"{path} is {image.shape[1]}x{image.shape[0]} pixels: give {_MIN_SIDE} or more on each side")
    return image
