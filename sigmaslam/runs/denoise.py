"""Filtering images from disk, one by one or as a sequence, and both eyes of a run."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from sigmaslam.errors import FrameError, InputError
from sigmaslam.files import atomic_write_bytes, check_new_folder, make_folder
from sigmaslam.image_filtering import NoiseModel, SequenceFilter, denoise_image, estimate_noise, filter_both_ways
from sigmaslam.progress import counted
from sigmaslam.readers import StereoFrame
from sigmaslam.readers.images import IMAGE_SUFFIXES, GreyConverter, read_grey, read_image
from sigmaslam.readers.pairing import list_images
from sigmaslam.readers.video import read_frames

_MIN_SIDE = 32


@dataclass(frozen=True, slots=True)
class DenoiseSummary:
    """What was filtered.

    Attributes:
        images: how many were written.
        noise: of the first image.
        seconds: all together.
    """

    images: int
    noise: NoiseModel
    seconds: float

    def describe(self) -> str:
        """Two lines."""
        noise = self.noise
        words = [f"sigma {noise.sigma:.2f}"]
        words += [f"shot noise of {noise.gain:.2f} x signal"] if noise.gain > 0 else []
        words += [f"quantiser steps of {noise.step:.1f}"] if noise.step > 0 else []
        words += [f"{100 * noise.impulses:.1f} % of the pixels stuck"] if noise.impulses > 0 else []
        words += [f"after a blur of {noise.blur:g} px"] if noise.blur > 0 else []
        return f"Noise: {', '.join(words)} (grey levels)\n{self.images} images in {self.seconds:.1f} s"


class StereoFilter:
    """A filter for each eye, which estimates the noise from its first image."""

    def __init__(self) -> None:
        self._eyes = SequenceFilter(), SequenceFilter()

    def step(self, frame: StereoFrame) -> StereoFrame:
        """The frame with its images filtered.

        Raises:
            FrameError: the images are too small to filter.
        """
        images, name = (frame.left, frame.right), f"frame {frame.index}"
        for image in images:
            _check_size(image, name)
        with _naming([name]):
            left, right = (to_bytes(eye.step(image)) for eye, image in zip(self._eyes, images, strict=True))
        return replace(frame, left=left, right=right)

    def describe(self) -> list[dict[str, Any]]:
        """Entries of run.json: the noise of the left and right eye; none before the first frame."""
        return [asdict(eye.noise) for eye in self._eyes if eye.noise is not None]


def denoise_files(
    source: Path,
    out: Path,
    noise: NoiseModel | None = None,
    single: bool = False,
    thorough: bool = False,
    blur: float = 0.0,
) -> DenoiseSummary:
    """Filters an image, the images of a folder or those of a video; writes 8-bit grey PNG.

    Args:
        source: an image, a folder of images, which are a sequence in the order of their names, or a video of one eye.
        out: new or empty folder.
        noise: None to estimate it from the first image, or from each where they are filtered one by one.
        single: filter each image by itself.
        thorough: as of `denoise_image`; images are then filtered one by one.
        blur: of the lens, pixels; images are then filtered one by one.
    Raises:
        InputError: there is no image, one cannot be read, or has another size than those before.
    """
    check_new_folder(out)
    make_folder(out)
    alone = single or thorough or blur > 0.0 or _is_image(source)
    count, began, used = 0, time.perf_counter(), noise
    results = _filter_alone(source, noise, thorough, blur) if alone else _filter_sequence(source, noise)
    with counted("images", None) as done:
        for name, own, result in results:
            used = own if count == 0 else used
            path = out / f"{Path(name).stem}.png"
            if path.exists():
                raise InputError(f"{source}: {name} and another image would both become {path.name}: rename one")
            atomic_write_bytes(path, cv2.imencode(".png", to_bytes(result))[1].tobytes())
            count += 1
            done()
    if used is None:
        raise InputError(f"{source}: no image; give an image, a folder that holds some, or a video")
    return DenoiseSummary(count, used, time.perf_counter() - began)


_Results = Iterator[tuple[str, NoiseModel | None, np.ndarray]]


def _filter_alone(source: Path, noise: NoiseModel | None, thorough: bool, blur: float) -> _Results:
    """Names, noise and estimates."""
    for name, image in _read(source, read_grey):
        own = replace(noise or estimate_noise(image), blur=blur)
        yield name, own, denoise_image(image, own, thorough)


def _filter_sequence(source: Path, noise: NoiseModel | None) -> _Results:
    """Likewise, each from those before and after it."""
    names, forward, grey = [], SequenceFilter(noise), GreyConverter()

    def images() -> Iterator[np.ndarray]:
        for name, image in _read(source, lambda path: grey.convert(read_image(path), str(path))):
            names.append(name)
            yield image

    with _naming(names):
        for number, result in enumerate(filter_both_ways(images(), forward)):
            yield names[number], forward.noise, result


def _read(source: Path, read: Callable[[Path], np.ndarray]) -> Iterator[tuple[str, np.ndarray]]:
    """Names and grey images, large enough to filter."""
    if source.is_dir() or _is_image(source):
        images = ((path.name, read(path)) for path in (list_images(source) if source.is_dir() else [source]))
    else:
        images = ((f"{index:06d}.png", image) for index, image in enumerate(read_frames(source)))
    for name, image in images:
        _check_size(image, name)
        yield name, image


def _is_image(source: Path) -> bool:
    return source.is_file() and source.suffix.lower() in IMAGE_SUFFIXES


@contextmanager
def _naming(names: list[str]) -> Iterator[None]:
    """What a filter refuses is the last of these images."""
    try:
        yield
    except ValueError as error:
        raise FrameError(f"{names[-1]}: {error}; filter images of different sizes with --single") from None


def _check_size(image: np.ndarray, name: str) -> None:
    if min(image.shape) < _MIN_SIDE:
        height, width = image.shape
        raise FrameError(f"{name}: is {width}x{height} pixels; images from {_MIN_SIDE}x{_MIN_SIDE} on are filtered")


def to_bytes(image: np.ndarray) -> np.ndarray:
    """Grey levels as an 8-bit image stores them."""
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)
