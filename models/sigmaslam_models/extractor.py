"""From an image to keypoints, scores, descriptors and sigmas: the graph that is exported and shipped."""

import torch
from torch import Tensor, nn

from sigmaslam_models.detector import detect, to_cells, to_half_cells
from sigmaslam_models.feature_network import SIZE_MULTIPLE, FeatureNetwork, sample_map

EXTRACTOR_SIZE_MULTIPLE = 2 * SIZE_MULTIPLE
"""Sides of the image: the network's multiple, at half size too."""
BLOBS = ("places", "strengths", "half_places", "half_strengths")
"""What `find_blobs` returns, and what the graph takes from another detector."""
# Twice as many peaks are described as are kept; the learned quality decides which.
_CANDIDATES_PER_KEYPOINT = 2
# Share of the keypoints that comes from the image at half size: they match where the scale differs by 2 and more, but
# lie less exactly.
_HALF_SHARE = 4


class FeatureExtractor(nn.Module):
    """Keypoints of two scales with descriptors, best first.

    The same detector and network run on the image and on the image at half its size: three keypoints in four come
    from the first, one from the second.

    Args:
        network: trained descriptors, quality and log-sigma.

    Shapes:
        image (1, 1, H, W) float32 in [0, 1], H and W multiples of 32; count, the number N of keypoints, scalar int64,
        from 4 to H W / 8 -> keypoints (N, 2) pixel coordinates (u, v); scores (N,), zero where the image has fewer;
        unit descriptors (N, C); sigma (N,), standard deviation of a keypoint's place per axis, pixels; `find_blobs`.
    """

    def __init__(self, network: FeatureNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor, count: Tensor) -> tuple[Tensor, ...]:
        """One image at a time: batches gain nothing on a CPU."""
        blobs = find_blobs(image, count)
        full_scale = self._level(to_cells(image), *blobs[:2])
        half_scale = self._level(to_half_cells(image), *blobs[2:])
        keypoints = torch.cat([full_scale[0], 2.0 * half_scale[0] + 0.5])
        sigma = torch.cat([full_scale[3], 2.0 * half_scale[3]])
        scores, order = torch.cat([full_scale[1], half_scale[1]]).sort(descending=True)
        descriptors = torch.cat([full_scale[2], half_scale[2]])[order]
        return keypoints[order], scores, descriptors, sigma[order], *blobs

    def _level(self, cells: Tensor, places: Tensor, strengths: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        candidates, strength = places.unsqueeze(0), strengths.unsqueeze(0)
        maps = self.network(cells)
        quality = sample_map(maps.quality, candidates).squeeze(-1).sigmoid()
        strength = strength / strength.amax(dim=1, keepdim=True).clamp_min(1e-12)
        sigma = sample_map(maps.log_sigma, candidates).squeeze(-1).exp()
        # Relative strength of the blob and learned quality count alike; of strength zero is no blob.
        scores, order = (strength.sqrt() * quality).topk(places.shape[0] // _CANDIDATES_PER_KEYPOINT, dim=1)
        keypoints = candidates.gather(1, order.unsqueeze(-1).expand(-1, -1, 2))
        descriptors = self.network.describe(maps, keypoints)
        return keypoints[0], scores[0], descriptors[0], sigma.gather(1, order)[0]


def find_blobs(image: Tensor, count: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The strongest blobs for so many keypoints, of the image and of its half: places (K, 2) and strengths (K,)."""
    total: int = count.item()  # type: ignore[assignment]  # int() would freeze it in the graph
    torch._check(total >= 4)
    torch._check(total <= image.shape[2] * image.shape[3] // 8)
    half = total // _HALF_SHARE
    places, strengths = detect(to_cells(image), _CANDIDATES_PER_KEYPOINT * (total - half))
    of_half = detect(to_half_cells(image), _CANDIDATES_PER_KEYPOINT * half)
    return places[0], strengths[0], of_half[0][0], of_half[1][0]
