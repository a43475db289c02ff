"""A keyframe's view in a tenth of its memory: what finds it again."""

from dataclasses import dataclass, replace
from typing import Self

import cv2
import numpy as np

from sigmaslam.frontend import Features, StereoView

# Of the left image: on a drive and in a room, poses relative to it move by less than half of their sigmas down to 40.
_JPEG_QUALITY = 50
# Steps of a descriptor's entries, of which 64 have a root mean square of 1/8. Half as many lose 2 % of the inliers.
_STEPS = 16.0


@dataclass(frozen=True, slots=True)
class PackedView:
    """What remains of a view.

    Attributes:
        jpeg: (B,) uint8, the left image.
        features: (N,) those with a disparity; descriptors are int8, in sixteenths.
        disparity, disparity_sigma: (N,) float32 of them, pixels.
    """

    jpeg: np.ndarray
    features: Features
    disparity: np.ndarray
    disparity_sigma: np.ndarray

    @classmethod
    def of(cls, view: StereoView, count: int | None = None) -> Self:
        """A view with its best `count` features in stereo, or with all of them."""
        kept = np.flatnonzero(np.isfinite(view.disparity))[:count]
        features = view.features.select(kept)
        descriptors = np.clip(np.rint(_STEPS * features.descriptors), -127, 127).astype(np.int8)
        features = replace(
            features, descriptors=descriptors, scores=_halved(features.scores), sigma=_halved(features.sigma)
        )
        jpeg = cv2.imencode(".jpg", view.left, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        disparity = view.disparity[kept].astype(np.float32)
        return cls(jpeg.ravel(), features, disparity, _halved(view.disparity_sigma[kept]))

    @property
    def descriptors(self) -> np.ndarray:
        """(N, D) float32 of unit length."""
        wide = self.features.descriptors.astype(np.float32)
        return wide / np.maximum(np.linalg.norm(wide, axis=1, keepdims=True), 1.0)

    def unpack(self) -> StereoView:
        """The view without its right image."""
        left = np.asarray(cv2.imdecode(self.jpeg, cv2.IMREAD_GRAYSCALE))
        features = replace(self.features, descriptors=self.descriptors)
        disparity, sigma = self.disparity.astype(np.float64), self.disparity_sigma.astype(np.float64)
        return StereoView(left, np.zeros((0, 0), np.uint8), features, disparity, sigma)


def _halved(values: np.ndarray) -> np.ndarray:
    """float32 of the precision of float16, which archives halve."""
    return values.astype(np.float16).astype(np.float32)
