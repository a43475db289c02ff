"""Masks of what may be used of left images: not zero where it may, as OpenCV and COLMAP have it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sigmaslam.errors import FrameError, InputError
from sigmaslam.readers.images import read_image
from sigmaslam.readers.pairing import list_images


def read_mask(path: Path, width: int, height: int) -> np.ndarray:
    """(H, W) bool of an image: true where a channel other than transparency is not zero.

    Raises:
        FrameError: it is no image, of another size, or zero everywhere.
    """
    try:
        mask = read_image(path)
    except FrameError as error:
        raise FrameError(f"{error}: give the mask as a PNG") from None
    if mask.shape[:2] != (height, width):
        raise FrameError(
            f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]} pixels, the left image {width}x{height}; "
            "make it from the left image as it is stored"
        )
    if mask.ndim == 3:
        mask = mask[..., :3].max(axis=2)  # without transparency
    if not mask.any():
        raise FrameError(f"{path}: the mask is zero everywhere; what may be used must not be zero")
    return np.asarray(mask > 0)


class Masks:
    """One mask for all frames, or one a frame, with the name of its left image: 000012.png, or COLMAP's 000012.png.png.

    Args:
        path: image, or folder of images.
        left_images: files of the frames; None where the input has none, as a video.
        width, height: of the left images as they are stored.
    Raises:
        InputError: the path is missing, a frame has no mask, or the mask of the first one cannot be used.
    """

    def __init__(self, path: Path, left_images: Sequence[Path] | None, width: int, height: int) -> None:
        self.source = path
        self._size = width, height
        self._files: dict[str, Path] = {}
        if not path.is_dir():
            self._first = read_mask(path, width, height)
            return
        if left_images is None:
            raise InputError(f"--mask {path}: a folder of masks goes with image files; give one mask for all frames")
        self._files = {file.stem: file for file in list_images(path)}
        missing = [image.name for image in left_images if self._file(image) is None]
        if missing:
            raise InputError(
                f"--mask {path}: {len(missing)} of {len(left_images)} frames have no mask, the first is {missing[0]}; "
                "a mask has the name of its left image"
            )
        self._first = self.read(str(left_images[0]))

    def read(self, left_name: str) -> np.ndarray:
        """(H, W) bool, the mask of a frame by the path of its left image.

        Raises:
            FrameError: it cannot be used.
        """
        file = self._file(Path(left_name))
        return self._first if file is None else read_mask(file, *self._size)

    def _file(self, left_image: Path) -> Path | None:
        return self._files.get(left_image.stem) or self._files.get(left_image.name)
