"""The match scorer: which putative matches are right, from their neighbours and what the matcher knows of each."""

from itertools import pairwise

import torch
from torch import Tensor, nn

SIDE_CHANNELS = 9
"""Of `sigmaslam.frontend.scorer_inputs.side_information`."""
NEIGHBOURS = 12
"""Of `sigmaslam.frontend.scorer_inputs.nearest_matches`."""
_WIDTH = 32
_ROUNDS = 2
# A neighbour supports a hypothesis as far as it lies near where that has it: scales in pixels, for a neighbour next to
# the match; for one that is far away the scale grows by this share of the distance.
_SCALES = (2.0, 6.0)
_GROWTH = 0.03
# Only the nearest neighbours make hypotheses; all vote.
_HYPOTHESES = 8
# Nearer neighbours say nothing of rotation and scale, pixels.
_MIN_DISTANCE = 2.0
_MIN_ZOOM = 0.2


class MatchScorer(nn.Module):
    """Logit of every putative match of a set, whatever their order.

    A match i and one of its neighbours j fix a similarity of the images near i. The other neighbours vote for it as
    far as they agree with it, each by how much it is trusted; what the best similarity and all of them together got
    is what a match learns of its surroundings in a round. Trust begins with what the matcher knows. Beside its
    surroundings a match sees the whole set through its trust-weighted mean and spread (context normalisation, Yi et
    al. 2018).
    """

    def __init__(self, rounds: int = _ROUNDS) -> None:
        super().__init__()
        votes = 2 * len(_SCALES)
        self.first = _layers(SIDE_CHANNELS, _WIDTH, _WIDTH)
        self.first_trust = nn.Linear(_WIDTH, 1)
        self.local = nn.ModuleList(_layers(_WIDTH + votes + 1, _WIDTH, _WIDTH) for _ in range(rounds))
        self.context = nn.ModuleList(_layers(_WIDTH + 4, _WIDTH, _WIDTH) for _ in range(rounds))
        self.overall = nn.ModuleList(nn.Linear(2, _WIDTH) for _ in range(rounds))
        self.trust = nn.ModuleList(_layers(_WIDTH, _WIDTH, 1) for _ in range(rounds))

    def forward(self, points0: Tensor, points1: Tensor, side: Tensor, near: Tensor, weight: Tensor) -> Tensor:
        """Logits by round.

        Args:
            points0, points1: (B, M, 2) matched pixels.
            side: (B, M, 9) side information of the matches.
            near: (B, M, K) int64, neighbours of each match; itself where there are too few.
            weight: (B, M) 1 for a match, 0 for what fills up a batch.
        Returns:
            (R, B, M) logit that the match is right, from the first to the last round.
        """
        batch, count, neighbours = near.shape
        flat = (near + count * torch.arange(batch, device=near.device).view(-1, 1, 1)).flatten()
        # Coordinates first: what is done with many short rows is slow in ONNX Runtime.
        coordinates = torch.cat([points0, points1], dim=2).flatten(0, 1)
        from_match = coordinates.index_select(0, flat).transpose(0, 1).view(4, batch, count, neighbours)
        u0, v0, u1, v1 = (from_match - coordinates.transpose(0, 1).view(4, batch, count, 1)).unbind(0)
        square0, square1 = u0 * u0 + v0 * v0, u1 * u1 + v1 * v1
        # The similarity that takes a neighbour's offset in image 0 to that in image 1, as a complex number.
        inner, outer = u1 * u0 + v1 * v0, v1 * u0 - u1 * v0
        real, imaginary = inner / square0.clamp_min(1.0), outer / square0.clamp_min(1.0)
        zoom2 = real * real + imaginary * imaginary
        sound = ((square0 > _MIN_DISTANCE**2) & (zoom2 > _MIN_ZOOM**2) & (zoom2 < _MIN_ZOOM**-2)).to(side.dtype)
        # Squared distance |d1_k - z_j d0_k|^2 of neighbour k (fourth axis) from where hypothesis j (third) has it.
        growth = 1.0 / (1.0 + _GROWTH**2 * square1)
        of_hypothesis = torch.stack([torch.ones_like(real), zoom2, -2.0 * real, -2.0 * imaginary], dim=3)
        of_neighbour = torch.stack([square1 * growth, square0 * growth, inner * growth, outer * growth], dim=2)
        distance2 = torch.matmul(of_hypothesis[:, :, :_HYPOTHESES], of_neighbour).clamp_min(0.0)
        scale = torch.tensor([each**-2 for each in _SCALES], dtype=side.dtype, device=side.device).view(-1, 1, 1)
        falling = (distance2.unsqueeze(2) * scale + 1.0).reciprocal()
        agreement = (falling * falling).flatten(2, 3)  # (B, M, 2 J, K)
        position = torch.cat([_standardised(points0, weight), _standardised(points1, weight)], dim=2)
        hidden = self.first(side)
        logit = self.first_trust(hidden).squeeze(2)
        logits = [logit]
        for local, context, overall, trust in zip(self.local, self.context, self.overall, self.trust, strict=True):
            trusted = torch.sigmoid(logit) * weight
            supporter = trusted.flatten().index_select(0, flat).view(batch, count, neighbours) * sound
            proposer = supporter[:, :, :_HYPOTHESES].unsqueeze(2)
            # Its own vote, which agrees with it, does not count.
            heard = torch.matmul(agreement, supporter.unsqueeze(3)).view(batch, count, len(_SCALES), _HYPOTHESES)
            votes = (heard - proposer) * proposer
            counts = torch.log1p(torch.cat([votes.amax(dim=3), votes.sum(dim=3)], dim=2))
            expected = supporter.mean(dim=2, keepdim=True)
            hidden = hidden + local(torch.cat([hidden, counts, expected], dim=2))
            seen = context(torch.cat([hidden, position], dim=2))
            total = trusted.sum(dim=1, keepdim=True).clamp_min(1e-3).unsqueeze(2)
            importance = trusted.unsqueeze(2) / total
            mean = (importance * seen).sum(dim=1, keepdim=True)
            spread = ((importance * (seen - mean) ** 2).sum(dim=1, keepdim=True) + 1e-3).sqrt()
            size = weight.sum(dim=1, keepdim=True).unsqueeze(2).clamp_min(1.0)
            set_wide = overall(torch.cat([total / size, torch.log(size) / 7.0], dim=2))
            hidden = hidden + 0.5 * (seen - mean) / spread + set_wide
            logit = trust(hidden).squeeze(2)
            logits.append(logit)
        return torch.stack(logits)


class ScoredMatches(nn.Module):
    """The scorer as its graph is called: one set, the logits of the last round."""

    def __init__(self, scorer: MatchScorer) -> None:
        super().__init__()
        self.scorer = scorer

    def forward(self, points0: Tensor, points1: Tensor, side: Tensor, near: Tensor) -> tuple[Tensor]:
        """(M,) logits alone; arguments as of `MatchScorer.forward`, without the axis of the batch."""
        inputs = (each.unsqueeze(0) for each in (points0, points1, side, near))
        return (self.scorer(*inputs, torch.ones_like(points0[:, 0]).unsqueeze(0))[-1, 0],)


def _layers(*sizes: int) -> nn.Sequential:
    """Linear layers with ReLU between them."""
    layers: list[nn.Module] = []
    for before, after in pairwise(sizes):
        layers += [nn.Linear(before, after), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def _standardised(points: Tensor, weight: Tensor) -> Tensor:
    """Points of mean 0 and root mean square 1 over those that count."""
    mask = weight.unsqueeze(2)
    total = mask.sum(dim=1, keepdim=True).clamp_min(1.0)
    centred = (points - (points * mask).sum(dim=1, keepdim=True) / total) * mask
    spread = ((centred * centred).sum(dim=(1, 2), keepdim=True) / total).clamp_min(1.0).sqrt()
    return centred / spread
