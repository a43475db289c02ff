"""Disparities by a stereo network that the user names."""

from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from sigmaslam.errors import InputError


class StereoNetwork:
    """An ONNX graph that takes the left and the right image and gives the disparity of the left one.

    Its two inputs are (1, C, H, W) float32 with C of 1 or 3 equal channels, grey values 0 to 255, the left one first.
    Where the graph fixes H and W images are resized to them. The last two axes of its first output are H and W; values
    are pixels of the size that the graph saw.

    Args:
        path: .onnx file.
    Raises:
        InputError: the file is missing, or no such graph.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise InputError(f"{path}: no such file: give the ONNX file of a stereo network")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 2
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime raises its own types, none of them public
            raise InputError(f"{path}: is no graph that ONNX Runtime can load ({error}): give another") from error
        inputs = self._session.get_inputs()
        shapes = [each.shape for each in inputs]
        fits = len(shapes) == 2 and all(len(shape) == 4 and shape[1] in (1, 3) for shape in shapes)
        if not fits or any(each.type != "tensor(float)" for each in inputs):
            raise InputError(
                f"{path}: takes {shapes}, a stereo network must take two float32 images (1, C, H, W) with 1 or 3 "
                "channels: wrap the graph so that it does"
            )
        self._names = [each.name for each in inputs]
        self._channels = int(shapes[0][1])
        height, width = shapes[0][2:]
        self._size = (width, height) if isinstance(width, int) and isinstance(height, int) else None

    def __call__(self, left: np.ndarray, right: np.ndarray) -> np.ndarray:
        """Disparities (H, W) float32 of rectified (H, W) uint8 images; NaN where they are not positive."""
        height, width = left.shape
        size = self._size or (width, height)
        feed = {}
        for name, image in zip(self._names, (left, right), strict=True):
            seen = image if size == (width, height) else cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            feed[name] = np.repeat(seen[None, None].astype(np.float32), self._channels, axis=1)
        try:
            output = np.asarray(self._session.run(None, feed)[0], np.float32)
        except Exception as error:  # as above
            raise InputError(f"{self._path}: does not take images of {size[0]}x{size[1]} ({error})") from error
        if output.shape[-2:] != (size[1], size[0]) or output.size != size[0] * size[1]:
            raise InputError(
                f"{self._path}: gives {output.shape} for images of {size[0]}x{size[1]} pixels, one disparity a pixel "
                "is needed: wrap the graph so that its first output is that"
            )
        disparity = output.reshape(size[1], size[0])
        if size != (width, height):
            disparity = cv2.resize(disparity, (width, height), interpolation=cv2.INTER_LINEAR) * (width / size[0])
        return np.where(disparity > 0.0, disparity, np.float32(np.nan)).astype(np.float32)
