"""Stereo pairs decoded onto disk, so that a method is timed without readers, decoders and other frames in memory.

To read them needs numpy alone: OpenCV and the readers are imported where pairs are written.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import make_folder
from sigmaslam.geometry.camera import CameraModel, RectifiedStereo, StereoCamera

if TYPE_CHECKING:
    from sigmaslam.readers import StereoFrame

_NAME, _RAW, _RECTIFIED = "pairs.json", "raw.u8", "rectified.u8"


@dataclass(frozen=True, slots=True)
class DecodedPairs:
    """Pairs of one size, raw and rectified.

    Attributes:
        folder: where they are.
        timestamps: seconds.
        camera: calibration of the raw pairs.
        rectified: of the rectified ones.
    """

    folder: Path
    timestamps: tuple[float, ...]
    camera: StereoCamera
    rectified: RectifiedStereo

    @property
    def size(self) -> str:
        """Width and height of the images."""
        return f"{self.camera.left.width}x{self.camera.left.height}"

    def __len__(self) -> int:
        return len(self.timestamps)

    def read(self, index: int, rectified: bool = False) -> tuple[np.ndarray, np.ndarray]:
        """One pair, (H, W) uint8 each."""
        # Memory that is mapped would count as the method's own.
        height, width = self.camera.left.height, self.camera.left.width
        size, path = 2 * height * width, self.folder / (_RECTIFIED if rectified else _RAW)
        left, right = np.fromfile(path, np.uint8, size, offset=index * size).reshape(2, height, width)
        return left, right

    def resize(self, folder: Path, scale: float) -> DecodedPairs:
        """The same pairs at another size, in another folder, with the calibration that belongs to it."""
        import cv2

        from sigmaslam.readers import StereoFrame

        camera = StereoCamera(
            _resize_model(self.camera.left, scale), _resize_model(self.camera.right, scale), self.camera.T_left_right
        )
        size, method = (camera.left.width, camera.left.height), cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        frames = (
            StereoFrame(k, time, *(cv2.resize(image, size, interpolation=method) for image in self.read(k)))
            for k, time in enumerate(self.timestamps)
        )
        return write_pairs(folder, frames, camera)


def write_pairs(folder: Path, frames: Iterable[StereoFrame], camera: StereoCamera) -> DecodedPairs:
    """Decodes and rectifies all frames.

    Raises:
        InputError: the two images differ in size.
    """
    from sigmaslam.geometry.rectification import StereoRectifier

    sizes = [(model.width, model.height) for model in (camera.left, camera.right)]
    if sizes[0] != sizes[1]:
        raise InputError(f"the left images are {sizes[0]}, the right ones {sizes[1]} pixels: give pairs of one size")
    make_folder(folder)
    rectifier = StereoRectifier(camera)
    timestamps = []
    with (folder / _RAW).open("wb") as raw, (folder / _RECTIFIED).open("wb") as rectified:
        for frame in frames:
            timestamps.append(frame.timestamp)
            for file, pair in (
                (raw, (frame.left, frame.right)),
                (rectified, rectifier.rectify(frame.left, frame.right)),
            ):
                for image in pair:
                    file.write(np.ascontiguousarray(image).tobytes())
    content = {
        "timestamps": timestamps,
        "left": asdict(camera.left),
        "right": asdict(camera.right),
        "T_left_right": camera.T_left_right.tolist(),
        "rectified": asdict(rectifier.rectified),
    }
    (folder / _NAME).write_text(json.dumps(content), encoding="utf-8")
    return DecodedPairs(folder, tuple(timestamps), camera, rectifier.rectified)


def open_pairs(folder: Path) -> DecodedPairs:
    """What `write_pairs` wrote."""
    content = json.loads((folder / _NAME).read_text(encoding="utf-8"))
    camera = StereoCamera(
        CameraModel(**content["left"]), CameraModel(**content["right"]), np.array(content["T_left_right"])
    )
    return DecodedPairs(folder, tuple(content["timestamps"]), camera, RectifiedStereo(**content["rectified"]))


def _resize_model(model: CameraModel, scale: float) -> CameraModel:
    """A camera with other pixels; (0, 0) stays the centre of the first one."""
    width, height = round(model.width * scale), round(model.height * scale)
    x, y = width / model.width, height / model.height
    return replace(
        model,
        width=width,
        height=height,
        fx=model.fx * x,
        fy=model.fy * y,
        cx=(model.cx + 0.5) * x - 0.5,
        cy=(model.cy + 0.5) * y - 0.5,
        skew=model.skew * x,
    )
