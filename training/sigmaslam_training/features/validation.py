"""How well a network matches held-out renders, in the terms of the field."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sigmaslam_models.extractor import FeatureExtractor
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features.stream import Pair, open_stream
from sigmaslam_training.sources import Mix, label, turns_of

PAIRS = 48
_KEYPOINTS = 256
_SEED_OFFSET = 1_000_003
_SOURCES = ("leaves", "patterns", "scenes")
# Sources that validate only the runs which train on them, as those of one's own do.
_SPECIAL_SOURCES = ("endoscopy",)


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Mutual nearest neighbours between the images of a pair whose truth is known.

    Attributes:
        points0, points1: (M, 2) matched keypoints of either image, pixels.
        error: (M,) pixels from the true place of points0 in image 1 to points1, infinite where it is not seen there.
        nearest: (K,) pixels from the true place of each keypoint that both images show to the next keypoint there.
    """

    points0: Tensor
    points1: Tensor
    error: Tensor
    nearest: Tensor

    def metrics(self) -> dict[str, float]:
        """See `matching_accuracy`."""
        return {
            "mma_1": _share(self.error < 1),
            "mma_3": _share(self.error < 3),
            "correct_3": float((self.error < 3).sum()),
            "repeatability_1": _share(self.nearest < 1),
        }


def held_out_seed(seed: int) -> int:
    """Seed of the held-out pairs of a run with that seed: no run of a usual seed learns from them."""
    return seed + _SEED_OFFSET


def held_out_sources(mix: Mix) -> tuple[str, ...]:
    """What a run on that mix is validated on and shown with: what every run is, and what is special to it."""
    turns = turns_of(mix)
    special = _SPECIAL_SOURCES if isinstance(mix, str) else dict.fromkeys(turns)
    return (*_SOURCES, *(source for source in special if source in turns and source not in _SOURCES))


@torch.no_grad()
def matching_accuracy(
    network: FeatureNetwork, seed: int, sources: Sequence[str] = _SOURCES, pairs: int = PAIRS, size: int = 224
) -> dict[str, float]:
    """Mutual nearest neighbours on pairs of the sources in turn, whatever the network learned from.

    Returns:
        mma_1, mma_3: share of the matches within 1 and 3 px of the truth (mean over pairs); correct_3: number of
        matches within 3 px; repeatability_1: share of the keypoints seen again within 1 px; mma_3_leaves and so on:
        of the pairs of one source.
    """
    streams = [open_stream(source, seed, size) for source in sources]
    pair_metrics: list[dict[str, float]] = []
    for index in range(pairs):
        pair = streams[index % len(streams)].pair(index // len(streams))
        pair_metrics.append(match_pair(network, pair).metrics())
    overall = {name: sum(each[name] for each in pair_metrics) / pairs for name in pair_metrics[0]}
    for turn, source in enumerate(sources[:pairs]):
        of_source = pair_metrics[turn :: len(sources)]
        overall[f"mma_3_{label(source)}"] = sum(each["mma_3"] for each in of_source) / len(of_source)
    return overall


@torch.no_grad()
def match_pair(network: FeatureNetwork, pair: Pair) -> PairMatches:
    """The matches of a pair, as the run time makes them; the network is left as it was."""
    was_training = network.training
    network.eval()
    extractor = FeatureExtractor(network)
    device = next(network.parameters()).device

    def extract(image: np.ndarray) -> tuple[Tensor, Tensor]:
        features = extractor(torch.from_numpy(image)[None, None].to(device), torch.tensor(_KEYPOINTS))
        keypoints, scores, descriptors, _ = (values.cpu() for values in features[:4])
        return keypoints[scores > 0], descriptors[scores > 0]

    (keypoints0, descriptors0), (keypoints1, descriptors1) = extract(pair.image0), extract(pair.image1)
    network.train(was_training)
    similarity = descriptors0 @ descriptors1.T
    if not similarity.numel():  # an image that shows nothing
        return PairMatches(keypoints0[:0], keypoints1[:0], torch.empty(0), torch.empty(0))
    best1 = similarity.argmax(dim=1)
    mutual = similarity.argmax(dim=0)[best1] == torch.arange(len(best1))
    places1, visible = pair.transfer(keypoints0.numpy())
    places, shown = torch.from_numpy(places1).float(), torch.from_numpy(visible)
    error = torch.where(shown, (places - keypoints1[best1]).norm(dim=1), torch.inf)
    last = torch.tensor(pair.image1.shape[::-1])
    seen = shown & ((places >= 8) & (places < last - 8)).all(dim=1)
    nearest = torch.cdist(places, keypoints1, compute_mode="donot_use_mm_for_euclid_dist").amin(dim=1)
    return PairMatches(keypoints0[mutual], keypoints1[best1][mutual], error[mutual], nearest[seen])


def _share(right: Tensor) -> float:
    return float(right.float().mean()) if len(right) else 0.0
