"""SIFT and ORB as baselines and fall-backs, through the same interface as the learned features."""

from collections.abc import Sequence

import cv2
import numpy as np

from sigmaslam.frontend.types import Features

# Standard deviation of a keypoint's place, relative to the diameter from OpenCV: SIFT interpolates it.
_SIFT_SIGMA = 0.1
# Likewise, half a pixel of the octave: patches have 31 pixels.
_ORB_SIGMA = 0.5 / 31


class SiftDetector:
    """OpenCV's SIFT with RootSIFT descriptors (Arandjelovic & Zisserman 2012)."""

    def __init__(self, max_keypoints: int) -> None:
        self._sift = cv2.SIFT.create(nfeatures=max_keypoints)

    def __call__(self, image: np.ndarray) -> Features:
        """Features of an (H, W) uint8 image."""
        keypoints, descriptors = self._sift.detectAndCompute(image, None)
        if not keypoints:
            return _no_features(128)
        root = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12))
        return _features(keypoints, root.astype(np.float32), _SIFT_SIGMA)


class OrbDetector:
    """OpenCV's ORB; its 256 bits become +-1/16, so that the dot product is 1 - Hamming distance / 128."""

    def __init__(self, max_keypoints: int) -> None:
        self._orb = cv2.ORB.create(nfeatures=max_keypoints)

    def __call__(self, image: np.ndarray) -> Features:
        """Features of an (H, W) uint8 image."""
        keypoints, descriptors = self._orb.detectAndCompute(image, None)
        if not keypoints:
            return _no_features(256)
        bits = np.unpackbits(descriptors.astype(np.uint8, copy=False), axis=1).astype(np.float32)
        return _features(keypoints, (2.0 * bits - 1.0) / 16.0, _ORB_SIGMA)


def _features(keypoints: Sequence[cv2.KeyPoint], descriptors: np.ndarray, sigma_per_size: float) -> Features:
    places = np.array([keypoint.pt for keypoint in keypoints], np.float32)
    scores = np.array([keypoint.response for keypoint in keypoints], np.float32)
    sigma = sigma_per_size * np.array([keypoint.size for keypoint in keypoints], np.float32)
    # OpenCV may return one place with two orientations. Only the first is used, as matches must be one to one.
    _, first = np.unique(places, axis=0, return_index=True)
    order = first[np.argsort(-scores[first], kind="stable")]
    return Features(places[order], descriptors[order], scores[order], sigma[order])


def _no_features(size: int) -> Features:
    none = np.zeros(0, np.float32)
    return Features(np.zeros((0, 2), np.float32), np.zeros((0, size), np.float32), none, none)
