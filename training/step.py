"""One training step of the correspondence network: from a batch of pairs to a loss."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam.models.network import FeatureNetwork, sample_map
from sigmaslam.training.losses import MatchLoss, match_loss

_REPEAT_DISTANCE = 2.0
# True places in image 1 are shaken by this much, because at run time a descriptor is taken at a detected corner.
_PLACE_JITTER = 0.7
_MARGIN = 4.0


def pair_loss(
    network: FeatureNetwork,
    image0: Tensor,
    image1: Tensor,
    H_1_0: Tensor,
    corners0: Tensor,
    corners1: Tensor,
    generator: torch.Generator,
) -> MatchLoss:
    """Loss of a batch of homography pairs.

    Args:
        network: the network in training.
        image0, image1: (B, 1, H, W) float32 in [0, 1].
        H_1_0: (B, 3, 3) from pixels of image 0 to image 1.
        corners0, corners1: (B, N, 2) corners of either image, pixels.
        generator: of the small displacements.
    """
    batch, size = image0.shape[0], image0.shape[-1]
    places1 = transfer(H_1_0, corners0)
    visible = ((places1 >= _MARGIN) & (places1 <= size - 1 - _MARGIN)).all(dim=-1)
    distance = torch.cdist(places1, corners1)
    repeated = distance.amin(dim=2) < _REPEAT_DISTANCE
    # A corner of image 1 at a true place would be wrongly pushed away: it moves elsewhere as a distractor.
    elsewhere = size * torch.rand(corners1.shape, generator=generator)
    clash = distance.amin(dim=1) < 2 * _REPEAT_DISTANCE
    distractors = torch.where(clash.unsqueeze(-1), elsewhere, corners1)
    jittered = places1 + _PLACE_JITTER * torch.randn(places1.shape, generator=generator)

    images = torch.cat([image0, image1]).contiguous(memory_format=torch.channels_last)
    dense, logits = network(images)
    descriptors0 = functional.normalize(sample_map(dense[:batch], corners0), dim=-1)
    descriptors1 = functional.normalize(sample_map(dense[batch:], torch.cat([jittered, distractors], dim=1)), dim=-1)
    quality0 = sample_map(logits[:batch], corners0).squeeze(-1)
    count = corners0.shape[1]
    return match_loss(descriptors0, descriptors1[:, :count], descriptors1[:, count:], quality0, visible, repeated)


def transfer(H: Tensor, points: Tensor) -> Tensor:
    """Points (B, N, 2) under homographies (B, 3, 3)."""
    homogeneous = torch.cat([points, torch.ones_like(points[..., :1])], dim=-1) @ H.transpose(1, 2)
    depth = homogeneous[..., 2:]
    return homogeneous[..., :2] / torch.where(depth.abs() < 1e-6, torch.full_like(depth, 1e-6), depth)
