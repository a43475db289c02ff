"""Our trained features: an ONNX graph, or the same network in torch."""

import cv2
import numpy as np

from sigmaslam.frontend.patch_kernels import compiled
from sigmaslam.frontend.types import Features
from sigmaslam.inference.backends import open_network
from sigmaslam.inference.networks import WeightsFolder
from sigmaslam.inference.onnx_graph import OnnxGraph, Step

# Of the image's sides: the network's coarsest map is a 16th of the image at half the scale.
_SIZE_MULTIPLE = 32
# Pixels from the padding where its seam may look like a keypoint.
_BORDER = 8
# The graph describes twice as many candidates; one in four comes from an image with a quarter of the pixels.
_PIXELS_PER_KEYPOINT = 8
# Pixels of a side, from which on compiled code finds the blobs; smaller images are the graph's alone.
_LEAST_COMPILED = 96


class LearnedDetector:
    """Keypoints, scores and descriptors from the network, best first.

    Args:
        max_keypoints: per image.
        backend: "onnx", or "torch" (needs the extra `train`).
        threads: of ONNX Runtime.
        provider: where ONNX Runtime computes.
        weights: folder of a network of one's own; None: the one that ships.
    """

    def __init__(
        self,
        max_keypoints: int,
        backend: str = "onnx",
        threads: int = 2,
        provider: str = "cpu",
        weights: WeightsFolder = None,
    ) -> None:
        self._max_keypoints = max_keypoints
        self._graph = open_network("features", weights, threads, provider, backend)

    def __call__(self, image: np.ndarray) -> Features:
        """Features of an (H, W) uint8 image of any size from 96 pixels."""
        return extract(self._graph, image, self._max_keypoints)


def extract(graph: Step, image: np.ndarray, max_keypoints: int) -> Features:
    """Features of an (H, W) uint8 image by a graph with the inputs and outputs of the exported one.

    Args:
        graph: takes {"image": (1, 1, H, W) float32 in [0, 1], "count": N} and returns keypoints (N, 2), scores (N,),
            best first, descriptors (N, C) and sigma (N,).
        image: of any size from 96 pixels.
        max_keypoints: upper limit; small images give fewer.
    """
    height, width = image.shape
    bottom, right = -height % _SIZE_MULTIPLE, -width % _SIZE_MULTIPLE
    padded = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
    count = np.array(min(max_keypoints, padded.size // _PIXELS_PER_KEYPOINT), np.int64)
    shades = np.divide(padded[None, None], 255.0, dtype=np.float32)
    feed: dict[str, np.ndarray] = {"image": shades, "count": count}
    is_large = min(padded.shape) >= _LEAST_COMPILED
    if is_large and isinstance(graph, OnnxGraph) and graph.optional and (kernels := compiled()):
        feed |= zip(graph.optional, kernels.find_blobs(shades[0, 0], count), strict=True)
    keypoints, scores, descriptors, sigma = graph(feed)[:4]
    # The padding contains no corners, but its seam may.
    inside = (keypoints[:, 0] < width - _BORDER) & (keypoints[:, 1] < height - _BORDER)
    return Features(keypoints, descriptors, scores, sigma).select((scores > 0) & inside)
