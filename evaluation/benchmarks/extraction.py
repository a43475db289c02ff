"""Extractors that do one thing otherwise than the shipped one, for the ablations."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam.models.detector import CELL, detect, find_peaks, hessian_response, to_cells
from sigmaslam.models.extractor import FeatureExtractor
from sigmaslam.models.network import FeatureNetwork

# Of three levels: share of the keypoints of each.
_THREE_SHARES = (0.66, 0.24, 0.1)
_SADDLE_WEIGHT = 0.25


class _OtherResponse(FeatureExtractor):
    """Peaks of another response than the Hessian's determinant."""

    def __init__(self, network: FeatureNetwork, response: Callable[[Tensor], Tensor]) -> None:
        super().__init__(network)
        self._response = response

    def _detect(self, cells: Tensor, count: int) -> tuple[Tensor, Tensor]:
        return find_peaks(self._response(cells), count)


class _WholePixels(FeatureExtractor):
    def _detect(self, cells: Tensor, count: int) -> tuple[Tensor, Tensor]:
        keypoints, strength = detect(cells, count)
        return keypoints.round(), strength


class _OneScale(FeatureExtractor):
    def forward(self, image: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self._level(to_cells(image), int(count))


class _ThreeScales(FeatureExtractor):
    """The image, its half and its quarter."""

    def forward(self, image: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        levels = []
        for level, share in enumerate(_THREE_SHARES):
            keypoints, scores, descriptors, sigma = self._level(to_cells(image), int(share * int(count)))
            keypoints = (keypoints + 0.5) * 2**level - 0.5
            levels.append((keypoints, scores, descriptors, sigma * 2**level))
            height, width = (side // 2 // 32 * 32 for side in image.shape[2:])
            image = functional.avg_pool2d(image, 2)[:, :, :height, :width]
        keypoints, scores, descriptors, sigma = (torch.cat(parts) for parts in zip(*levels, strict=True))
        return keypoints, scores, descriptors, sigma


class _OtherRanking(FeatureExtractor):
    """Candidates ordered by strength^a quality^b sigma^-c."""

    def __init__(self, network: FeatureNetwork, strength: float, quality: float, sigma: float) -> None:
        super().__init__(network)
        self._powers = (strength, quality, sigma)

    def _rank(self, strength: Tensor, quality: Tensor, sigma: Tensor) -> Tensor:
        a, b, c = self._powers
        return (strength > 0) * strength**a * quality**b * sigma**-c


def _shi_tomasi(blurred: bool) -> Callable[[Tensor], Tensor]:
    """Smaller eigenvalue of the structure tensor of Sobel gradients, in a 5-tap binomial window."""
    taps = torch.tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    sobel = torch.tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8.0

    def smooth(image: Tensor) -> Tensor:
        channels = image.shape[1]
        rows = functional.conv2d(
            image, taps.view(1, 1, 1, 5).repeat(channels, 1, 1, 1), padding=(0, 2), groups=channels
        )
        return functional.conv2d(rows, taps.view(1, 1, 5, 1).repeat(channels, 1, 1, 1), padding=(2, 0), groups=channels)

    def response(cells: Tensor) -> Tensor:
        image = functional.pixel_shuffle(cells, CELL)
        image = smooth(image) if blurred else image  # the binomial's sigma is 1 px
        u, v = functional.conv2d(image, torch.stack([sobel, sobel.T]).unsqueeze(1), padding=1).split(1, dim=1)
        uu, vv, uv = smooth(torch.cat([u * u, v * v, u * v], dim=1)).split(1, dim=1)
        half = 0.5 * (uu - vv)
        return functional.pixel_unshuffle(0.5 * (uu + vv) - torch.sqrt(half * half + uv * uv), CELL)

    return response


def _blobs_and_saddles(cells: Tensor) -> Tensor:
    response = hessian_response(cells)
    return torch.maximum(response, -_SADDLE_WEIGHT * response)


EXTRACTIONS: dict[str, Callable[[FeatureNetwork], FeatureExtractor]] = {
    "default": FeatureExtractor,
    "shi_tomasi": lambda network: _OtherResponse(network, _shi_tomasi(blurred=False)),
    "shi_tomasi_blurred": lambda network: _OtherResponse(network, _shi_tomasi(blurred=True)),
    "saddles": lambda network: _OtherResponse(network, _blobs_and_saddles),
    "one_scale": _OneScale,
    "three_scales": _ThreeScales,
    "strength": lambda network: _OtherRanking(network, 1.0, 0.0, 0.0),
    "quality": lambda network: _OtherRanking(network, 0.0, 1.0, 0.0),
    "sigma": lambda network: _OtherRanking(network, 0.5, 1.0, 1.0),
    "whole_pixels": _WholePixels,
}
