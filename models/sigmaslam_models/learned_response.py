"""A learned response of the detector: blobs and saddles, each times a smooth gain of the network's features."""

import torch
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam_models.detector import CELL, hessian_response, surroundings

LEAST = 1e-4
"""Responses below are round-off of flat images."""
# Of determinants that are round-off in even surroundings; a blob of one grey level of 255 has as much.
_EVEN = 1e-6
# Logarithm of the gain of saddles before training.
_SADDLES = -3.0


class LearnedResponse(nn.Module):
    """How well each pixel would serve as a keypoint; before it is trained, nearly what the evened Hessian says.

    Gains are interpolated between cells: one for each pixel of a cell would draw keypoints to some of them.

    Args:
        features: channels of the network's finest map.

    Shapes:
        cells (B, 16, H/4, W/4), features (B, C, H/4, W/4) -> response (B, 1, H, W); that of a usual keypoint is about 1
        before training.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        last = nn.Conv2d(16, 2, 3, padding=1)
        self.gain = nn.Sequential(nn.Conv2d(features, 16, 1), nn.ReLU(inplace=True), last)
        nn.init.zeros_(last.weight)
        assert last.bias is not None
        last.bias.data = torch.tensor([0.0, _SADDLES])

    def forward(self, cells: Tensor, features: Tensor) -> Tensor:
        """Responses of all pixels."""
        determinant = hessian_response(cells)
        gains = self.gain(features).exp() / (surroundings(determinant) + _EVEN)
        gains = functional.interpolate(gains, scale_factor=float(CELL), mode="bilinear", align_corners=False)
        blobs, saddles = gains.split(1, dim=1)
        pixels = functional.pixel_shuffle(determinant, CELL)
        return torch.maximum(pixels * blobs, -pixels * saddles)
