"""The correspondence network: a descriptor, a quality and a log-sigma for every place of an image."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam_models.detector import CELL

DESCRIPTOR_SIZE = 64
STRIDE = 4
STRIDES = (4, 8, 16)
SIZE_MULTIPLE = 16
"""The network halves four times; images are padded to a multiple of this before it."""
_FINE, _COARSE = 32, 64
_HIDDEN = 96
_COARSE_STRIDE = 8
_WINDOW = 3


class FeatureMaps(NamedTuple):
    """What the network says of an image.

    Attributes:
        fine: (B, 32, H/4, W/4) features.
        coarse: (B, 64, H/8, W/8) features.
        quality: (B, 1, H/8, W/8) logits that a keypoint there will be matched rightly.
        log_sigma: (B, 1, H/8, W/8) logarithm of the standard deviation of a keypoint's place per axis, in pixels.
    """

    fine: Tensor
    coarse: Tensor
    quality: Tensor
    log_sigma: Tensor


class FeatureNetwork(nn.Module):
    """Descriptors, quality and log-sigma from a grey image.

    Nothing is computed above quarter resolution, where the time would go, and nothing after it but the keypoints' own
    descriptors: two layers on a window of the fine map, centred on the keypoint, and on the coarse map there. Channel
    counts are multiples of 16, which ONNX Runtime's kernels want.

    Args:
        descriptor_size: of the descriptors.
        stride: of the finest map that descriptors see: 4; 8 and 16 see the coarse one alone, 16 without its 1/8 branch.

    Raises:
        ValueError: the stride is none of these.

    Shapes:
        cells (B, 16, H/4, W/4) of an image in [0, 1], H and W multiples of 16 -> FeatureMaps. Cell (i, j) of a map of
        stride s is centred on pixel (s i + (s - 1) / 2, s j + (s - 1) / 2).
    """

    def __init__(self, descriptor_size: int = DESCRIPTOR_SIZE, stride: int = STRIDE) -> None:
        super().__init__()
        if stride not in STRIDES:
            raise ValueError(f"stride {stride} is none of {STRIDES}")
        self.descriptor_size, self.stride = descriptor_size, stride
        self.stem = nn.Sequential(_block(CELL * CELL, _FINE), _block(_FINE, _FINE))
        self.eighth = nn.Sequential(_block(_FINE, 48, stride=2), _block(48, 48))
        self.sixteenth = nn.Sequential(_block(48, 64, stride=2), _block(64, 64), _block(64, 64), _block(64, 48))
        self.merge = _block(48, _COARSE)
        self.judge = nn.Conv2d(_COARSE, 2, 1)
        seen = _COARSE + (_WINDOW * _WINDOW * _FINE if stride == 4 else 0)
        self.describer = nn.Sequential(
            nn.Linear(seen, _HIDDEN), nn.ReLU(inplace=True), nn.Linear(_HIDDEN, descriptor_size)
        )

    def forward(self, cells: Tensor) -> FeatureMaps:
        """Maps of a batch of images."""
        fine = self.stem(normalize_image(cells))
        eighth = self.eighth(fine)
        deep = self.sixteenth(eighth)
        merged = functional.interpolate(deep, scale_factor=2.0, mode="bilinear", align_corners=False)
        coarse = self.merge(merged + eighth if self.stride < 16 else merged)
        quality, log_sigma = self.judge(coarse).split(1, dim=1)
        return FeatureMaps(fine, coarse, quality, log_sigma)

    def describe(self, maps: FeatureMaps, keypoints: Tensor) -> Tensor:
        """Unit descriptors (B, N, C) of keypoints (B, N, 2), pixel coordinates (u, v)."""
        seen = sample_map(maps.coarse, keypoints)
        if self.stride == 4:
            seen = torch.cat([seen, sample_window(maps.fine, keypoints)], dim=-1)
        return functional.normalize(self.describer(seen), dim=-1)


def normalize_image(image: Tensor) -> Tensor:
    """Zero mean and unit standard deviation per image, so that gain and offset of the exposure drop out."""
    centred = image - image.mean(dim=(1, 2, 3), keepdim=True)
    variance = (centred * centred).mean(dim=(1, 2, 3), keepdim=True)
    return centred * torch.rsqrt(variance.clamp_min(1e-6))


def sample_map(features: Tensor, keypoints: Tensor, stride: int = _COARSE_STRIDE) -> Tensor:
    """Bilinear samples of a strided map at pixel positions; outside the map its border is repeated.

    Args:
        features: (B, C, H/stride, W/stride).
        keypoints: (B, N, 2) pixel coordinates (u, v).
        stride: pixels a cell of the map.
    Returns:
        (B, N, C).
    """
    return _samples(features, keypoints, stride, 1).flatten(2)


def sample_window(features: Tensor, keypoints: Tensor, stride: int = CELL) -> Tensor:
    """As `sample_map`, at each keypoint and its 8 neighbours one cell away: (B, N, 9 C), row by row."""
    return _samples(features, keypoints, stride, _WINDOW).flatten(2)


def _samples(features: Tensor, keypoints: Tensor, stride: int, window: int) -> Tensor:
    """Samples (B, N, window, window, C) of a map, one cell apart.

    They share their fractions of a cell, so each takes one look-up, and not four. Written with look-ups of rows, which
    ONNX Runtime runs several times faster than its GridSample.
    """
    batch, channels, height, width = features.shape
    table = features.permute(0, 2, 3, 1).reshape(-1, channels)
    first = height * width * torch.arange(batch, device=features.device).view(-1, 1, 1, 1)
    reach = window // 2
    steps = torch.arange(-reach, reach + 2, device=features.device)

    def axis(places: Tensor, cells: int) -> tuple[Tensor, Tensor]:
        # Beyond its border the map goes on as it ends there.
        place = ((places + 0.5) / stride - 0.5).clamp(-reach - 1, cells + reach)
        lower = place.floor()
        return (lower.long().unsqueeze(-1) + steps).clamp(0, cells - 1), (place - lower)[..., None, None, None]

    columns, du = axis(keypoints[..., 0], width)
    rows, dv = axis(keypoints[..., 1], height)
    cells = functional.embedding(first + rows.unsqueeze(-1) * width + columns.unsqueeze(-2), table)
    # Not torch.lerp, which becomes twice the work in ONNX.
    left, right = cells[..., :-1, :], cells[..., 1:, :]
    cells = left + du * (right - left)
    above, below = cells[..., :-1, :, :], cells[..., 1:, :, :]
    return above + dv * (below - above)


def _block(channels_in: int, channels_out: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(channels_out),
        nn.ReLU(inplace=True),
    )
