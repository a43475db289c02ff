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
    corners0: Tensor,
    places1: Tensor,
    visible: Tensor,
    corners1: Tensor,
    generator: torch.Generator,
) -> MatchLoss:
    """Loss of a batch of pairs.

    Args:
        network: the network in training.
        image0, image1: (B, 1, H, W) float32 in [0, 1].
        corners0, corners1: (B, N, 2) corners of either image, pixels.
        places1: (B, N, 2) where corners0 lie in image 1, pixels.
        visible: (B, N) bool, whether they are seen there.
        generator: of the small displacements.
    """
    batch, size = image0.shape[0], image0.shape[-1]
    visible = visible & ((places1 >= _MARGIN) & (places1 <= size - 1 - _MARGIN)).all(dim=-1)
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
