"""From an image to keypoints, scores and descriptors: the graph that is exported and shipped."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

from sigmaslam.models.corners import corner_response, corner_scores, select_peaks
from sigmaslam.models.network import FeatureNetwork, sample_map

# Twice as many corners are described as are kept; the learned quality decides which.
CANDIDATES_PER_KEYPOINT = 2


class FeatureExtractor(nn.Module):
    """Keypoints with descriptors, best first.

    Args:
        network: trained descriptors and quality.
        max_keypoints: number of keypoints returned for every image.

    Shapes:
        image (1, 1, H, W) float32 in [0, 1], H and W multiples of 16 and H W >= 2 max_keypoints -> keypoints (N, 2)
        pixel coordinates (u, v); scores (N,), zero where the image has fewer corners; unit descriptors (N, 64).
    """

    def __init__(self, network: FeatureNetwork, max_keypoints: int) -> None:
        super().__init__()
        self.network = network
        self.max_keypoints = max_keypoints

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One image at a time: batches gain nothing on a CPU."""
        response = corner_response(image)
        candidates, strength = select_peaks(
            corner_scores(response), response, CANDIDATES_PER_KEYPOINT * self.max_keypoints
        )
        dense, logits = self.network(image)
        quality = sample_map(logits, candidates).squeeze(-1).sigmoid()
        # Relative strength of the corner and learned quality count alike; a corner of strength zero is no corner.
        strength = strength / strength.amax(dim=1, keepdim=True).clamp_min(1e-12)
        scores, order = (strength.sqrt() * quality).topk(self.max_keypoints, dim=1)
        keypoints = candidates.gather(1, order.unsqueeze(-1).expand(-1, -1, 2))
        descriptors = functional.normalize(sample_map(dense, keypoints), dim=-1)
        return keypoints[0], scores[0], descriptors[0]
