"""The stereo network: disparity, its scale of error and the odds of a gross one for every pixel of the left image."""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

SIZE_MULTIPLE = 32
"""Images are padded to a multiple of this before the network."""
LEVELS = 48
"""Disparities that the volume spans, in steps of four pixels from zero on."""
STRIDE = 4
_HALF, _QUARTER, _EIGHTH, _SIXTEENTH = 16, 32, 48, 64
_HIDDEN = (48, 64, 96)
_COMPARED, _HINTS = 8, 6  # channels that are warped, and that the coarse stages hand on
_REFINE = 16
_REACH = 2  # steps around the best one that the mean is taken over


class StereoMaps(NamedTuple):
    """What the network says of a pair, pixels of the images that it saw.

    Attributes:
        disparity: (B, 1, H, W).
        log_scale: (B, 1, H, W) logarithm of the scale of a Laplace distribution of its error.
        gross: (B, 1, H, W) logit that the error is of no such distribution.
        half: (B, 1, H/2, W/2) disparity before the refinement, pixels of the whole size; for training.
        logits: (B, 48, H/4, W/4) of the steps; for training.
    """

    disparity: Tensor
    log_scale: Tensor
    gross: Tensor
    half: Tensor
    logits: Tensor


def _layer(inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    padding = dilation * (size // 2) if stride == 1 else 0
    convolution = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, bias=False)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class _Residual(nn.Module):
    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.first = _layer(channels, channels, dilation=dilation)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.second(self.first(x)))


class _Features(nn.Module):
    """Features of one image at a half and a quarter of its size."""

    def __init__(self) -> None:
        super().__init__()
        self.half_size = nn.Sequential(_layer(1, _HALF, 2, 2), _layer(_HALF, _HALF))
        self.quarter = nn.Sequential(_layer(_HALF, _QUARTER, 2, 2), _Residual(_QUARTER))
        self.eighth = nn.Sequential(_layer(_QUARTER, _EIGHTH, 2, 2), _Residual(_EIGHTH))
        self.sixteenth = nn.Sequential(_layer(_EIGHTH, _SIXTEENTH, 2, 2), _Residual(_SIXTEENTH))
        self.to_eighth = nn.Conv2d(_SIXTEENTH, _EIGHTH, 1)
        self.to_quarter = nn.Conv2d(_EIGHTH, _QUARTER, 1)
        self.last = _layer(_QUARTER, _QUARTER)
        self.match = nn.Conv2d(_QUARTER, _QUARTER, 1)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        half = self.half_size(image)
        quarter = self.quarter(half)
        eighth = self.eighth(quarter)
        eighth = functional.relu(eighth + _double(self.to_eighth(self.sixteenth(eighth))))
        quarter = self.last(quarter + _double(self.to_quarter(eighth)))
        return half, quarter, functional.normalize(self.match(quarter), dim=1)


class StereoNetwork(nn.Module):
    """Matches features at a quarter of the size and refines at half of it.

    Correlations of 48 steps of disparity are the channels that a U-Net of 2-D convolutions works on, as in DispNetC
    (Mayer et al. 2016); what it finds is refined once by features warped at half the size, and brought to the whole
    size by weighted means of neighbours (Teed & Deng 2020).

    Shapes:
        two images (B, 1, H, W) in grey values 0 to 255, H and W multiples of 32 -> StereoMaps.
    """

    def __init__(self) -> None:
        super().__init__()
        first, second, third = _HIDDEN
        self.features = _Features()
        self.temperature = nn.Parameter(torch.tensor(10.0))
        self.enter = _layer(LEVELS + _QUARTER, first)
        self.fine = _Residual(first)
        self.eighth = nn.Sequential(_layer(first, second, 2, 2), _Residual(second))
        self.sixteenth = nn.Sequential(_layer(second, third, 2, 2), _Residual(third), _Residual(third, 2))
        self.to_eighth = nn.Conv2d(third, second, 1)
        self.up_eighth = _Residual(second)
        self.to_fine = nn.Conv2d(second, first, 1)
        self.up_fine = _Residual(first)
        self.vote = nn.Conv2d(first, LEVELS, 3, padding=1)
        self.half_weights = nn.Conv2d(first, 4 * 9, 1)
        self.half_hints = nn.Conv2d(first, 4 * _HINTS, 1)
        self.compare = nn.Conv2d(_HALF, _COMPARED, 1)
        self.refine = nn.Sequential(_layer(_HALF + _COMPARED + _HINTS + 2, _REFINE), _Residual(_REFINE), _Residual(_REFINE, 2))
        self.say = nn.Conv2d(_REFINE, 3, 3, padding=1)
        self.full_weights = nn.Conv2d(_REFINE, 4 * 9, 1)
        with torch.no_grad():
            self.say.weight.mul_(0.1)
            self.say.bias.copy_(torch.tensor([0.0, 0.0, -2.0]))

    def forward(self, left: Tensor, right: Tensor) -> StereoMaps:
        """Maps of a batch of rectified pairs."""
        left, right = _normalised(left), _normalised(right)
        both = self.features(torch.cat([left, right]))
        (half, half_right), (context, _), (match, match_right) = (each.chunk(2) for each in both)
        with torch.autocast(left.device.type, enabled=False):  # steps would be told apart too roughly
            volume = self.temperature * correlate(match.float(), match_right.float())
        fine = self.fine(self.enter(torch.cat([volume, context], dim=1)))
        eighth = self.eighth(fine)
        eighth = self.up_eighth(eighth + _double(self.to_eighth(self.sixteenth(eighth))))
        fine = self.up_fine(fine + _double(self.to_fine(eighth)))
        logits = volume + self.vote(fine).float()
        rough, best = _read_out(logits)
        half_size = upsample(STRIDE * rough, self.half_weights(fine))
        sure = functional.interpolate(best, scale_factor=2.0, mode="nearest")
        compared, compared_right = self.compare(half), self.compare(half_right)
        differs = compared - warp(compared_right.to(half_size.dtype), half_size / 2.0).to(half.dtype)
        hints = functional.pixel_shuffle(self.half_hints(fine), 2)
        known = (half_size / 64.0).to(half.dtype), sure.to(half.dtype)
        refined = self.refine(torch.cat([half, differs, hints, *known], dim=1))
        said = self.say(refined).float()
        disparity = upsample(half_size + said[:, :1], self.full_weights(refined))
        return StereoMaps(disparity, _double(said[:, 1:2]), _double(said[:, 2:3]), half_size, logits)


def correlate(left: Tensor, right: Tensor) -> Tensor:
    """(B, 48, H, W) products of features (B, C, H, W) of the left image with those so many places to the left.

    All products of a row are one matrix; its diagonals are read off by laying it out with a longer row.
    """
    height, width = left.shape[2:]
    rows = left.permute(0, 2, 3, 1) @ right.permute(0, 2, 1, 3)
    padded = functional.pad(rows, (LEVELS, 0)).flatten(2)
    padded = functional.pad(padded, (0, width)).unflatten(2, (width, width + LEVELS + 1))
    return padded[..., 1 : LEVELS + 1].flip(3).permute(0, 3, 1, 2).reshape(-1, LEVELS, height, width)


def warp(image: Tensor, disparity: Tensor) -> Tensor:
    """(B, C, H, W) of the right image where the left one's pixels are seen by their disparities (B, 1, H, W)."""
    height, width = image.shape[2:]
    u = torch.arange(width, device=image.device, dtype=disparity.dtype) - disparity[:, 0]
    v = torch.arange(height, device=image.device, dtype=disparity.dtype)[None, :, None].expand_as(u)
    grid = torch.stack([(2.0 * u + 1.0) / width - 1.0, (2.0 * v + 1.0) / height - 1.0], dim=3)
    return functional.grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)


def upsample(values: Tensor, weights: Tensor) -> Tensor:
    """(B, 1, 2 H, 2 W), each a weighted mean of 3 x 3 of values (B, 1, H, W); weights (B, 36, H, W) before softmax."""
    height, width = values.shape[2:]
    padded = functional.pad(values, (1, 1, 1, 1), mode="replicate")
    around = torch.cat([padded[:, :, i : i + height, j : j + width] for i in range(3) for j in range(3)], dim=1)
    shares = _shares(weights.float().unflatten(1, (4, 9)), 2)
    return functional.pixel_shuffle((shares * around[:, None]).sum(dim=2), 2)


def _double(values: Tensor) -> Tensor:
    return functional.interpolate(values, scale_factor=2.0, mode="nearest")


def _shares(logits: Tensor, dim: int) -> Tensor:
    """Softmax, which ONNX Runtime computes slowly along another axis than the last."""
    shares = (logits - logits.amax(dim=dim, keepdim=True)).exp()
    return shares / shares.sum(dim=dim, keepdim=True)


def _normalised(image: Tensor) -> Tensor:
    mean = image.mean(dim=(2, 3), keepdim=True)
    spread = (image - mean).square().mean(dim=(2, 3), keepdim=True).sqrt()
    return (image - mean) / (spread + 1.0)


def _read_out(logits: Tensor) -> tuple[Tensor, Tensor]:
    """Mean step (B, 1, H, W) near the best one, and the share of all that lies there."""
    shares = _shares(logits.float(), 1)
    steps = torch.arange(LEVELS, device=logits.device, dtype=shares.dtype)[None, :, None, None]
    near = ((steps - shares.argmax(dim=1, keepdim=True)).abs() <= _REACH).to(shares.dtype)
    shares = shares * near
    total = shares.sum(dim=1, keepdim=True)
    return (shares * steps).sum(dim=1, keepdim=True) / (total + 1e-6), total
