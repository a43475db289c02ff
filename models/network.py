"""The correspondence network: a descriptor, a quality and a log-sigma per 8x8 pixels, interpolated in between."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam.models.detector import CELL

DESCRIPTOR_SIZE = 64
STRIDE = 8
SIZE_MULTIPLE = 16
"""The network halves four times; images are padded to a multiple of this before it."""


class FeatureMaps(NamedTuple):
    """What the network says of an image.

    Attributes:
        descriptors: (B, C, H/stride, W/stride), not of unit length.
        quality: (B, 1, H/stride, W/stride) logits that a keypoint there will be matched rightly.
        log_sigma: (B, 1, H/stride, W/stride) logarithm of the standard deviation of a keypoint's place per axis, in
            pixels.
    """

    descriptors: Tensor
    quality: Tensor
    log_sigma: Tensor


class FeatureNetwork(nn.Module):
    """Dense descriptors, quality and log-sigma from a grey image.

    Nothing is computed above quarter resolution, where the time would go; a 1/16 branch widens the receptive field.
    Channel counts are multiples of 16, which ONNX Runtime's kernels want.

    Args:
        descriptor_size: channels of the descriptors.
        stride: of the maps: 4, 8 or 16.

    Shapes:
        cells (B, 16, H/4, W/4) of an image in [0, 1], H and W multiples of 16 -> FeatureMaps. With stride 8 cell
        (i, j) of a map is centred on pixel (8 i + 3.5, 8 j + 3.5).
    """

    def __init__(self, descriptor_size: int = DESCRIPTOR_SIZE, stride: int = STRIDE) -> None:
        super().__init__()
        self.descriptor_size, self.stride = descriptor_size, stride
        self.stem = _block(CELL * CELL, 32)
        self.eighth = nn.Sequential(_block(32, 48, stride=2), _block(48, 48))
        self.sixteenth = nn.Sequential(_block(48, 64, stride=2), _block(64, 64), _block(64, 64), _block(64, 48))
        self.lateral = nn.Conv2d(32, 48, 1) if stride == 4 else None
        self.merge = _block(48, 64)
        self.head = nn.Conv2d(64, descriptor_size + 2, 1)

    def forward(self, cells: Tensor) -> FeatureMaps:
        """Maps of a batch of images."""
        quarter = self.stem(normalize_image(cells))
        fine = self.eighth(quarter)
        merged = self.sixteenth(fine)
        if self.stride < 16:
            merged = fine + _doubled(merged)
        if self.lateral is not None:
            merged = self.lateral(quarter) + _doubled(merged)
        maps = self.head(self.merge(merged))
        return FeatureMaps(*maps.split([self.descriptor_size, 1, 1], dim=1))


def normalize_image(image: Tensor) -> Tensor:
    """Zero mean and unit standard deviation per image, so that gain and offset of the exposure drop out."""
    centred = image - image.mean(dim=(1, 2, 3), keepdim=True)
    variance = (centred * centred).mean(dim=(1, 2, 3), keepdim=True)
    return centred * torch.rsqrt(variance.clamp_min(1e-6))


def sample_map(features: Tensor, keypoints: Tensor, stride: int = STRIDE) -> Tensor:
    """Bilinear samples of a strided map at pixel positions; outside the map its border is repeated.

    Written with look-ups of rows, which ONNX Runtime runs several times faster than its GridSample.

    Args:
        features: (B, C, H/stride, W/stride).
        keypoints: (B, N, 2) pixel coordinates (u, v).
    Returns:
        (B, N, C).
    """
    batch, channels, height, width = features.shape
    table = features.permute(0, 2, 3, 1).reshape(-1, channels)
    first = height * width * torch.arange(batch, device=features.device).unsqueeze(1)
    u = ((keypoints[..., 0] + 0.5) / stride - 0.5).clamp(0, width - 1)
    v = ((keypoints[..., 1] + 0.5) / stride - 0.5).clamp(0, height - 1)
    left, top = u.floor(), v.floor()
    du, dv = (u - left).unsqueeze(-1), (v - top).unsqueeze(-1)
    left, top = left.long(), top.long()
    right, bottom = (left + 1).clamp_max(width - 1), (top + 1).clamp_max(height - 1)

    def at(column: Tensor, row: Tensor) -> Tensor:
        return functional.embedding(first + row * width + column, table)

    above = (1 - du) * at(left, top) + du * at(right, top)
    below = (1 - du) * at(left, bottom) + du * at(right, bottom)
    return (1 - dv) * above + dv * below


def _doubled(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2.0, mode="bilinear", align_corners=False)


def _block(channels_in: int, channels_out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )
