"""What is compared: a callable from a grey image to keypoints and descriptors."""

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.learned import extract
from sigmaslam.frontend.types import Features
from sigmaslam.inference.onnx_graph import OnnxGraph, Step
from sigmaslam_benchmarks.matching.peer_extractors import PeerExtractor, read_signature

MAX_KEYPOINTS = 1024
CLASSICAL = ("sift", "orb")
_OUR_INPUTS = {"image", "count"}


class Extractor(Protocol):
    """Keypoints and descriptors of one image."""

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features of an (H, W) uint8 grey image, at most 1,024 of them unless another number was asked for.

        Returns:
            (N, 2) pixel coordinates (u, v), and (N, C) descriptors: float32 of unit length, compared by dot product,
            or uint8 bit strings, compared by Hamming distance.
        """
        ...


class LearnedExtractor:
    """Our network, from a graph that is called as the exported one is.

    Args:
        graph: called as `sigmaslam.frontend.learned.extract` does: an `OnnxGraph`, or a `FeatureExtractor` in a
            `TorchModule`.
        max_keypoints: of an image.
    """

    def __init__(self, graph: Step, max_keypoints: int = MAX_KEYPOINTS) -> None:
        self._graph, self._max_keypoints = graph, max_keypoints

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and descriptors of an (H, W) uint8 image."""
        features = extract(self._graph, image, self._max_keypoints)
        return features.keypoints, features.descriptors


def load_extractor(name: str, max_keypoints: int = MAX_KEYPOINTS) -> Extractor:
    """ "sift", "orb", or the path of a file: ours (.safetensors, which needs the extra `train`, or .onnx), or a peer's
    .onnx (see `PeerExtractor`).

    Raises:
        InputError: it is none of these, or the file cannot be used.
    """
    if name == "sift":
        return _classical(SiftDetector(max_keypoints), max_keypoints)
    if name == "orb":
        return _classical(OrbDetector(max_keypoints), max_keypoints)
    path = Path(name)
    if path.suffix == ".onnx":
        graph = OnnxGraph(path)
        if set(read_signature(path).inputs) == _OUR_INPUTS:
            return LearnedExtractor(graph, max_keypoints)
        return PeerExtractor(path, max_keypoints)
    if path.suffix == ".safetensors":
        from sigmaslam_models.torch_runtime import TorchFeatures

        return LearnedExtractor(TorchFeatures(path), max_keypoints)
    raise InputError(f"{name} is no extractor: give {', '.join(CLASSICAL)}, or a .safetensors or .onnx file")


def remembering(extractor: Extractor) -> Extractor:
    """The same extractor, which is asked only once for the features of an array."""
    # The cache holds the arrays, so that no two of them share an id.
    features: dict[int, tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]] = {}

    def extract(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if id(image) not in features:
            features[id(image)] = image, extractor(image)
        return features[id(image)][1]

    return extract


def _classical(detect: Callable[[np.ndarray], Features], max_keypoints: int) -> Extractor:
    def extract(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        features = detect(image)
        return features.keypoints[:max_keypoints], features.descriptors[:max_keypoints]

    return extract
