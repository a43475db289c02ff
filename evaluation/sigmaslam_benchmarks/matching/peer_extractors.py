"""Other people's extractors as ONNX graphs: recognised by their inputs and outputs, nothing else is known of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import onnxruntime

from sigmaslam.errors import FrameError, InputError
from sigmaslam.inference.onnx_graph import OnnxGraph

_SIZE_MULTIPLE = 32
_NAMES = {
    "keypoints": ("keypoints", "kpts", "keypoint", "points"),
    "scores": ("scores", "score", "keypoint_scores"),
    "descriptors": ("descriptors", "descriptor", "desc", "descs"),
}

Shape = Sequence[int | str | None]


@dataclass(frozen=True, slots=True)
class Signature:
    """What a graph takes and gives.

    Attributes:
        inputs, outputs: shapes by name; an axis that is free is a name or None.
        types: by name of the input, as ONNX Runtime writes them ("tensor(float)").
    """

    inputs: Mapping[str, Shape]
    outputs: Mapping[str, Shape]
    types: Mapping[str, str]


def read_signature(path: Path) -> Signature:
    """Inputs and outputs of a graph that ONNX Runtime can load."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    inputs, outputs = session.get_inputs(), session.get_outputs()
    return Signature(
        {node.name: node.shape for node in inputs},
        {node.name: node.shape for node in outputs},
        {node.name: node.type for node in inputs},
    )


class PeerExtractor:
    """An extractor with one image input, (1, 1, H, W) or (1, 3, H, W) float32 in [0, 1], of free or fixed size.

    Its outputs are keypoints (N, 2) in pixels (u, v), scores (N,) and descriptors (N, C), each perhaps with a leading
    1, known by their names or, where those say nothing, by their shapes.

    Args:
        path: .onnx file.
        max_keypoints: so many of the best are kept.
    Raises:
        InputError: the graph is none of that kind; the message lists its inputs or outputs.
    """

    def __init__(self, path: Path, max_keypoints: int) -> None:
        self._path, self._max_keypoints = path, max_keypoints
        self._graph = OnnxGraph(path)
        signature = read_signature(path)
        self._outputs = signature.outputs
        self._input, self._channels, self._size = _image_input(path, signature)

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and unit descriptors of an (H, W) uint8 image, best first; scores that are not positive are left
        out, as are keypoints in what the image was padded with.

        Raises:
            FrameError: the image is larger than the graph takes.
        """
        outputs = self._graph({self._input: self._pad(image)})
        named = dict(zip(self._graph.outputs, outputs, strict=True))
        keypoints, scores, descriptors = recognise_outputs(named, self._path, self._outputs)
        inside = (keypoints[:, 0] <= image.shape[1] - 1) & (keypoints[:, 1] <= image.shape[0] - 1)
        kept = np.flatnonzero((scores > 0) & inside)
        kept = kept[np.argsort(-scores[kept], kind="stable")][: self._max_keypoints]
        length = np.linalg.norm(descriptors[kept], axis=1, keepdims=True)
        return keypoints[kept], descriptors[kept] / np.maximum(length, 1e-12)

    def _pad(self, image: np.ndarray) -> np.ndarray:
        """The image as the graph wants it, continued to the right and below where it is too small."""
        height, width = (
            -(-length // _SIZE_MULTIPLE) * _SIZE_MULTIPLE if fixed is None else fixed
            for length, fixed in zip(image.shape, self._size, strict=True)
        )
        bottom, right = height - image.shape[0], width - image.shape[1]
        if bottom < 0 or right < 0:
            raise FrameError(
                f"{self._path} takes images of {width}x{height}, this one is {image.shape[1]}x{image.shape[0]}: "
                "export the graph with a free or larger size"
            )
        padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        return np.repeat(padded[None, None].astype(np.float32) / 255.0, self._channels, axis=1)


def recognise_outputs(
    outputs: Mapping[str, np.ndarray], path: Path, shapes: Mapping[str, Shape] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keypoints (N, 2), scores (N,) and descriptors (N, C) as float32.

    Args:
        outputs: arrays by name of the output.
        path: of the graph, for the message.
        shapes: of the outputs as the graph declares them, for the message; those found without it.
    Raises:
        InputError: names and shapes do not tell which is which.
    """
    keypoints = _find(outputs, "keypoints", (-1, 2))
    if keypoints is not None:
        count = len(keypoints)
        scores, descriptors = _find(outputs, "scores", (count,)), _find(outputs, "descriptors", (count, -1))
        if scores is not None and descriptors is not None:
            return keypoints.astype(np.float32), scores.astype(np.float32), descriptors.astype(np.float32)
    declared = shapes or {name: array.shape for name, array in outputs.items()}
    raise InputError(
        f"{path} cannot be understood: its outputs are {_list(declared)}; keypoints (N, 2), scores (N,) and "
        "descriptors (N, C) are wanted, by these names or these shapes"
    )


def _image_input(path: Path, signature: Signature) -> tuple[str, int, tuple[int | None, int | None]]:
    """Name, channels and size (height, width) of the only input; None where the size is free."""
    inputs = list(signature.inputs.items())
    name, shape = inputs[0] if inputs else ("", ())
    free = [not isinstance(length, int) for length in shape]
    if (
        len(inputs) != 1
        or len(shape) != 4
        or signature.types[name] != "tensor(float)"
        or not (free[0] or shape[0] == 1)
        or not (free[1] or shape[1] in (1, 3))
    ):
        raise InputError(
            f"{path} cannot be understood: its inputs are {_list(signature.inputs)}; one float32 image (1, 1, H, W) "
            "or (1, 3, H, W) is wanted, or `image` and `count` of a graph of ours; its outputs are "
            f"{_list(signature.outputs)}"
        )
    height, width = (length if isinstance(length, int) else None for length in shape[2:])
    return name, 3 if shape[1] == 3 else 1, (height, width)


def _find(outputs: Mapping[str, np.ndarray], kind: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """The output of a name that says so, or else the only one of that shape, without a leading 1.

    Args:
        outputs: arrays by name.
        kind: of `_NAMES`.
        shape: -1 for any length, of descriptors but 2, which is that of keypoints.
    """
    fitting = {}
    for name, array in outputs.items():
        bare = array[0] if array.ndim == len(shape) + 1 and len(array) == 1 else array
        if bare.ndim == len(shape) and all(n in (-1, m) for n, m in zip(shape, bare.shape, strict=True)):
            fitting[name] = bare
    named = [name for name in outputs if name.lower() in _NAMES[kind]]
    if named:
        return fitting.get(named[0])
    candidates = [array for array in fitting.values() if kind != "descriptors" or array.shape[1] != 2]
    return candidates[0] if len(candidates) == 1 else None


def _list(shapes: Mapping[str, Shape]) -> str:
    return ", ".join(f"{name} ({', '.join(map(str, shape))})" for name, shape in shapes.items()) or "none"
