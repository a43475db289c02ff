"""Losses of the correspondence network."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_FREEDOM = 3.0


class MatchLoss(NamedTuple):
    """How well the descriptors of a batch match.

    Attributes:
        descriptor: negative log-likelihood of the true matches under the dual softmax.
        quality: binary cross-entropy of the predicted quality.
        recall: share of true matches that are mutual nearest neighbours.
    """

    descriptor: Tensor
    quality: Tensor
    recall: Tensor


class PairLoss(NamedTuple):
    """Losses of one batch and what there is to watch.

    Attributes:
        descriptor, quality, recall: as in `MatchLoss`.
        place: negative log-likelihood of the distances between keypoints that show the same point.
    """

    descriptor: Tensor
    quality: Tensor
    recall: Tensor
    place: Tensor


def match_loss(
    descriptors0: Tensor,
    descriptors1: Tensor,
    distractors1: Tensor,
    quality0: Tensor,
    visible: Tensor,
    repeated: Tensor,
    inverse_temperature: float = 20.0,
) -> MatchLoss:
    """Dual-softmax loss with distractors, and quality trained on what the matcher gets right.

    Args:
        descriptors0, descriptors1: (B, N, C) unit descriptors; row i of both shows the same point where visible.
        distractors1: (B, D, C) unit descriptors of other keypoints of image 1.
        quality0: (B, N) quality logits in image 0.
        visible: (B, N) bool, the point lies inside image 1.
        repeated: (B, N) bool, a keypoint was also found near the true place in image 1.
        inverse_temperature: factor on cosine similarity before the softmax.
    """
    candidates1 = torch.cat([descriptors1, distractors1], dim=1)
    similarity = inverse_temperature * descriptors0 @ candidates1.transpose(1, 2)
    # A point outside image 1 has no place there: its column is not a candidate.
    hidden = torch.cat([~visible, torch.zeros_like(distractors1[..., 0], dtype=torch.bool)], dim=1)
    similarity = similarity.masked_fill(hidden.unsqueeze(1), -1e4)
    count = descriptors0.shape[1]
    forward = functional.log_softmax(similarity, dim=2)[:, :, :count].diagonal(dim1=1, dim2=2)
    backward = functional.log_softmax(similarity[:, :, :count], dim=1).diagonal(dim1=1, dim2=2)
    weight = visible.to(similarity.dtype)
    total = weight.sum().clamp_min(1.0)
    descriptor = -((forward + backward) * weight).sum() / total
    with torch.no_grad():
        rows = torch.arange(count, device=similarity.device)
        best_forward = similarity.argmax(dim=2) == rows
        best_backward = similarity[:, :, :count].argmax(dim=1) == rows
        right = best_forward & best_backward & visible
        target = (right & repeated).to(similarity.dtype)
    # A point that leaves the image has no label for its quality.
    quality = (functional.binary_cross_entropy_with_logits(quality0, target, reduction="none") * weight).sum() / total
    return MatchLoss(descriptor, quality, right.to(similarity.dtype).sum() / total)


def place_loss(distance: Tensor, log_sigma0: Tensor, log_sigma1: Tensor, zoom: Tensor, partnered: Tensor) -> Tensor:
    """Mean negative log-likelihood of distances under a bivariate Student t law of 3 degrees of freedom.

    Up to a constant. Its heavy tails bear the wrong partners that chance brings near.

    Args:
        distance: (B, N) from the true place in image 1 of a keypoint of image 0 to the keypoint found there, pixels.
        log_sigma0, log_sigma1: (B, N) predicted for the one and the other: logarithms of the law's standard deviation
            per axis, of pixels of their images.
        zoom: (B, 1) pixels of image 1 a pixel of image 0.
        partnered: (B, N) bool, the rows that count.
    """
    variance = zoom.square() * (2.0 * log_sigma0).exp() + (2.0 * log_sigma1).exp()
    # The law's own scale is that variance over freedom / (freedom - 2).
    tail = torch.log1p(distance.square() / ((_FREEDOM - 2.0) * variance))
    likelihood = variance.log() + 0.5 * (_FREEDOM + 2.0) * tail
    weight = partnered.to(distance.dtype)
    return (likelihood * weight).sum() / weight.sum().clamp_min(1.0)
