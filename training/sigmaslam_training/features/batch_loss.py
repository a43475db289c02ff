"""One training step of the correspondence network: from a batch of pairs to its losses."""

import torch
from torch import Tensor

from sigmaslam_models.detector import to_cells
from sigmaslam_models.feature_network import FeatureMaps, FeatureNetwork, sample_map
from sigmaslam_training.features.losses import PairLoss, match_loss, place_loss

# A keypoint has a partner if one was found this near to its true place in image 1, pixels.
_PARTNER_DISTANCE = 3.0
# It is repeated if the partner is this near.
_REPEAT_DISTANCE = 1.5
# No keypoint of image 1 within this distance of a true place serves as a distractor.
_CLASH_DISTANCE = 4.0
# True places in image 1 are shaken by this much, because at run time a descriptor is taken at a detected keypoint.
_PLACE_JITTER = 0.7
_MARGIN = 4.0


def pair_loss(
    network: FeatureNetwork,
    image0: Tensor,
    image1: Tensor,
    keypoints0: Tensor,
    places1: Tensor,
    visible: Tensor,
    keypoints1: Tensor,
    generator: torch.Generator,
) -> PairLoss:
    """Losses of a batch of pairs.

    Args:
        network: the network in training.
        image0, image1: (B, 1, H, W) float32 in [0, 1].
        keypoints0: (B, N, 2) some keypoints of image 0, pixels.
        keypoints1: (B, K, 2) all keypoints of image 1, pixels, the strongest first; every second one is a distractor.
        places1: (B, N, 2) where keypoints0 lie in image 1, pixels.
        visible: (B, N) bool, whether they are seen there.
        generator: of the small displacements, on the CPU.
    """
    batch, count = keypoints0.shape[:2]
    size = image0.shape[-1]
    visible = visible & ((places1 >= _MARGIN) & (places1 <= size - 1 - _MARGIN)).all(dim=-1)
    # Matrix products would err by a tenth of a pixel.
    distance = torch.cdist(places1, keypoints1, compute_mode="donot_use_mm_for_euclid_dist")
    nearest, partner = distance.min(dim=2)
    distractors = keypoints1[:, ::2]
    # A keypoint of image 1 at a true place would be wrongly pushed away: it moves elsewhere as a distractor.
    elsewhere = size * torch.rand(distractors.shape, generator=generator).to(distractors)
    useless = (distance[:, :, ::2].amin(dim=1) < _CLASH_DISTANCE) | (distractors < 0).any(dim=-1)
    distractors = torch.where(useless.unsqueeze(-1), elsewhere, distractors)
    jittered = places1 + _PLACE_JITTER * torch.randn(places1.shape, generator=generator).to(places1)

    cells = to_cells(torch.cat([image0, image1])).contiguous(memory_format=torch.channels_last)
    maps = network(cells)

    maps0, maps1 = (FeatureMaps(*maps_of) for maps_of in zip(*(each.split(batch) for each in maps), strict=True))
    descriptors0 = network.describe(maps0, keypoints0)
    descriptors1 = network.describe(maps1, torch.cat([jittered, distractors], dim=1))
    matching = match_loss(
        descriptors0,
        descriptors1[:, :count],
        descriptors1[:, count:],
        sample_map(maps0.quality, keypoints0).squeeze(-1),
        visible,
        nearest < _REPEAT_DISTANCE,
    )
    log_sigma0 = sample_map(maps0.log_sigma, keypoints0).squeeze(-1)
    log_sigma1 = sample_map(maps1.log_sigma, keypoints1).squeeze(-1).gather(1, partner)
    zoom = _zoom(keypoints0, places1, visible)
    place = place_loss(nearest, log_sigma0, log_sigma1, zoom, visible & (nearest < _PARTNER_DISTANCE))
    return PairLoss(*matching, place)


def _zoom(keypoints0: Tensor, places1: Tensor, visible: Tensor) -> Tensor:
    """(B, 1) by how much lengths grow from image 0 to image 1, from the spread of the visible points."""
    weight = visible.to(places1.dtype).unsqueeze(-1)
    total = weight.sum(dim=1, keepdim=True).clamp_min(1.0)

    def spread(points: Tensor) -> Tensor:
        centred = (points - (points * weight).sum(dim=1, keepdim=True) / total) * weight
        return centred.square().sum(dim=(1, 2)).clamp_min(1.0)

    return (spread(places1) / spread(keypoints0)).sqrt().clamp(0.2, 5.0).unsqueeze(1)
