"""What is compared: a callable from a grey image to keypoints and descriptors."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.learned import Graph, extract
from sigmaslam.frontend.types import Features
from sigmaslam.session import OnnxGraph

MAX_KEYPOINTS = 1024
CLASSICAL = ("sift", "orb")


class Extractor(Protocol):
    """Keypoints and descriptors of one image."""

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Features of an (H, W) uint8 grey image, at most 1,024 of them.

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
    """

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints and descriptors of an (H, W) uint8 image."""
        found = extract(self._graph, image, MAX_KEYPOINTS)
        return found.keypoints, found.descriptors


def load_extractor(name: str) -> Extractor:
    """ "sift", "orb", or the path of a .safetensors (needs the extra `train`) or .onnx file of ours.

    Raises:
        InputError: it is none of these, or the file cannot be used.
    """
    if name == "sift":
        return _classical(SiftDetector(MAX_KEYPOINTS))
    if name == "orb":
        return _classical(OrbDetector(MAX_KEYPOINTS))
    path = Path(name)
    if path.suffix == ".onnx":
        return LearnedExtractor(OnnxGraph(path))
    if path.suffix == ".safetensors":
        from sigmaslam.models.torch_runtime import TorchFeatures

        return LearnedExtractor(TorchFeatures(path))
    raise InputError(f"{name} is no extractor: give {', '.join(CLASSICAL)}, or a .safetensors or .onnx file of ours")


def _classical(detect: Callable[[np.ndarray], Features]) -> Extractor:
    def extract(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        features = detect(image)
        return features.keypoints[:MAX_KEYPOINTS], features.descriptors[:MAX_KEYPOINTS]

    return extract
