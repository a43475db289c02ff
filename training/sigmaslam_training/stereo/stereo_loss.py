"""Loss of the stereo network: votes for the right step, a first disparity, and a likelihood with tails."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.stereo_network import LEVELS, STRIDE, StereoMaps

_GROSS_RANGE = 128.0  # pixels that a gross error is anywhere in
_LEAST_SCALE = 0.03  # pixels
_VOTES, _HALF = 0.3, 0.3  # weights
_FAR = (LEVELS - 1) * STRIDE


def stereo_loss(maps: StereoMaps, disparity: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Sum of the losses, and figures for the log.

    Args:
        maps: of the network.
        disparity: (B, 1, H, W) pixels; NaN where it is not known.
    """
    known = disparity.isfinite()
    truth = torch.where(known, disparity, torch.zeros_like(disparity))
    weight = known.float()
    total = weight.sum().clamp_min(1.0)
    # What is nearer than the steps reach is a gross error, and teaches the network to say so.
    reached = weight * (truth < _FAR)
    error = (maps.disparity - truth).abs()
    likelihood = negative_log_likelihood(error, maps.log_scale, maps.gross)
    # Of the first disparity the places that are nearest to its grid's.
    first = (maps.half - truth[:, :, ::2, ::2]).abs()
    half = functional.huber_loss(first, torch.zeros_like(first), reduction="none", delta=2.0).clamp_max(30.0)
    half = (half * reached[:, :, ::2, ::2]).sum() / reached[:, :, ::2, ::2].sum().clamp_min(1.0)
    middle = truth[:, 0, 1::STRIDE, 1::STRIDE] / STRIDE
    lower = middle.floor().clamp(0, LEVELS - 2)
    share = (middle - lower).clamp(0.0, 1.0)
    logs = maps.logits.float().log_softmax(dim=1)
    index = lower.long()[:, None]
    votes = -((1.0 - share) * logs.gather(1, index)[:, 0] + share * logs.gather(1, index + 1)[:, 0])
    counted = reached[:, 0, 1::STRIDE, 1::STRIDE]
    votes = (votes * counted).sum() / counted.sum().clamp_min(1.0)
    likelihood = (likelihood * weight).sum() / total
    figures = {
        "likelihood": likelihood.detach(),
        "votes": votes.detach(),
        "half": half.detach(),
        "error": (error.clamp_max(30.0) * weight).sum().detach() / total,
        "beyond 1": ((error > 1.0) * weight).sum().detach() / total,
        "beyond 3": ((error > 3.0) * weight).sum().detach() / total,
    }
    return likelihood + _VOTES * votes + _HALF * half, figures


def negative_log_likelihood(error: Tensor, log_scale: Tensor, gross: Tensor) -> Tensor:
    """Of absolute errors under a mixture of Laplace's law and a uniform one."""
    scale = log_scale.clamp(-8.0, 6.0).exp() + _LEAST_SCALE
    right = functional.logsigmoid(-gross) - torch.log(2.0 * scale) - error / scale
    wrong = functional.logsigmoid(gross) - math.log(_GROSS_RANGE)
    return -torch.logaddexp(right, wrong.expand_as(right))
