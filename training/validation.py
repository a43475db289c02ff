"""How well a network matches held-out renders, in the terms of the field."""

from __future__ import annotations

import torch

from sigmaslam.models.extractor import FeatureExtractor
from sigmaslam.models.network import FeatureNetwork
from sigmaslam.training.stream import open_stream

_PAIRS = 48
_KEYPOINTS = 256
_SOURCES = ("leaves", "patterns", "scenes")


@torch.no_grad()
def matching_accuracy(network: FeatureNetwork, seed: int, pairs: int = _PAIRS, size: int = 224) -> dict[str, float]:
    """Mutual nearest neighbours on held-out pairs: leaves, patterns and scenes in turn, whatever it learned from.

    Returns:
        mma_1, mma_3: share of the matches within 1 and 3 px of the truth (mean over pairs); correct_3: number of
        matches within 3 px; repeatability_1: share of the keypoints seen again within 1 px.
    """
    was_training = network.training
    network.eval()
    extractor = FeatureExtractor(network)
    count = torch.tensor(_KEYPOINTS)
    streams = [open_stream(source, seed, size) for source in _SOURCES]
    sums = {"mma_1": 0.0, "mma_3": 0.0, "correct_3": 0.0, "repeatability_1": 0.0}
    for index in range(pairs):
        pair = streams[index % len(streams)].pair(index // len(streams))
        keypoints0, _, descriptors0, _ = extractor(torch.from_numpy(pair.image0)[None, None], count)
        keypoints1, _, descriptors1, _ = extractor(torch.from_numpy(pair.image1)[None, None], count)
        similarity = descriptors0 @ descriptors1.T
        best1 = similarity.argmax(dim=1)
        mutual = similarity.argmax(dim=0)[best1] == torch.arange(len(best1))
        places1, visible = pair.transfer(keypoints0.numpy())
        places = torch.from_numpy(places1).float()
        shown = torch.from_numpy(visible)
        error = torch.where(shown, (places - keypoints1[best1]).norm(dim=1), torch.inf)[mutual]
        seen = shown & ((places >= 8) & (places < size - 8)).all(dim=1)
        nearest = torch.cdist(places, keypoints1).amin(dim=1)
        sums["mma_1"] += float((error < 1).float().mean())
        sums["mma_3"] += float((error < 3).float().mean())
        sums["correct_3"] += float((error < 3).sum())
        sums["repeatability_1"] += float((nearest[seen] < 1).float().mean()) if bool(seen.any()) else 0.0
    network.train(was_training)
    return {name: value / pairs for name, value in sums.items()}
