"""The correspondence network: one descriptor and one quality per 8x8 cell, interpolated in between."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

DESCRIPTOR_SIZE = 64
STRIDE = 8
# The network halves four times; images are padded to a multiple of this before it.
SIZE_MULTIPLE = 16


class FeatureNetwork(nn.Module):
    """Dense descriptors and match quality from a grey image.

    A PixelUnshuffle(4) stem keeps every convolution at quarter resolution or below, where the time goes; a 1/16
    branch widens the receptive field. Channel counts are multiples of 16 so that int8 can win later.

    Shapes:
        image (B, 1, H, W) float32, H and W multiples of 16 -> descriptors (B, 64, H/8, W/8), quality logits
        (B, 1, H/8, W/8). Cell (i, j) is centred on pixel (8 i + 3.5, 8 j + 3.5).
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Sequential(nn.PixelUnshuffle(4), _block(16, 32), _block(32, 32))
        self.eighth = nn.Sequential(_block(32, 48, stride=2), _block(48, 48), _block(48, 48))
        self.sixteenth = nn.Sequential(_block(48, 64, stride=2), _block(64, 64), _block(64, 48))
        self.merge = _block(48, 64)
        self.descriptor = nn.Conv2d(64, DESCRIPTOR_SIZE, 1)
        self.quality = nn.Conv2d(64, 1, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Descriptors (not yet of unit length) and quality logits."""
        fine = self.eighth(self.stem(normalize_image(image)))
        coarse = functional.interpolate(self.sixteenth(fine), scale_factor=2.0, mode="bilinear", align_corners=False)
        merged = self.merge(fine + coarse)
        return self.descriptor(merged), self.quality(merged)


def normalize_image(image: Tensor) -> Tensor:
    """Zero mean and unit standard deviation per image, so that gain and offset of the exposure drop out."""
    centred = image - image.mean(dim=(2, 3), keepdim=True)
    variance = (centred * centred).mean(dim=(2, 3), keepdim=True)
    return centred * torch.rsqrt(variance.clamp_min(1e-6))


def sample_map(features: Tensor, keypoints: Tensor, stride: int = STRIDE) -> Tensor:
    """Bilinear samples of a strided map at pixel positions.

    Args:
        features: (B, C, H/stride, W/stride).
        keypoints: (B, N, 2) pixel coordinates (u, v).
    Returns:
        (B, N, C).
    """
    height, width = features.shape[-2] * stride, features.shape[-1] * stride
    u = (2.0 * keypoints[..., 0] + 1.0) / width - 1.0
    v = (2.0 * keypoints[..., 1] + 1.0) / height - 1.0
    grid = torch.stack([u, v], dim=-1).unsqueeze(2)
    sampled = functional.grid_sample(features, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return sampled.squeeze(-1).transpose(1, 2)


def _block(channels_in: int, channels_out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )
