from dataclasses import dataclass

import numpy as np
import pytest
import torch

from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features import validation
from sigmaslam_training.features.validation import PairMatches, held_out_sources, match_pair, matching_accuracy
from sigmaslam_training.mixes import MIXES


@dataclass(frozen=True)
class Same:
    """An image twice."""

    image0: np.ndarray

    @property
    def image1(self) -> np.ndarray:
        return self.image0

    def transfer(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return points, np.ones(len(points), dtype=bool)


@pytest.fixture
def network() -> FeatureNetwork:
    torch.manual_seed(0)
    return FeatureNetwork()


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((96, 96), dtype=np.float32)


def test_an_image_matches_itself(network):
    metrics = match_pair(network, Same(noise(0))).metrics()
    assert metrics["repeatability_1"] == 1.0
    assert metrics["mma_1"] > 0.95
    assert metrics["correct_3"] > 50


def test_what_fills_up_where_an_image_has_few_keypoints_does_not_count(network):
    image = np.full((96, 96), 0.5, np.float32)
    image[40:56, 40:56] = noise(1)[:16, :16]
    found = match_pair(network, Same(image))
    assert 5 < len(found.error) < 60
    assert ((found.points0 > 30) & (found.points0 < 66)).all()


def test_metrics_of_a_pair_count_what_their_names_say():
    error, nearest = torch.tensor([0.5, 2.0, 9.0, torch.inf]), torch.tensor([0.2, 1.5])
    found = PairMatches(torch.zeros(4, 2), torch.zeros(4, 2), error, nearest).metrics()
    assert found == {"mma_1": 0.25, "mma_3": 0.5, "correct_3": 2.0, "repeatability_1": 0.5}
    empty = PairMatches(torch.zeros(0, 2), torch.zeros(0, 2), torch.zeros(0), torch.zeros(0)).metrics()
    assert set(empty.values()) == {0.0}


def test_the_mean_over_all_pairs_is_that_of_its_sources(network, monkeypatch):
    class Stream:
        def __init__(self, offset: int) -> None:
            self.offset = offset

        def pair(self, index: int) -> Same:
            return Same(noise(self.offset + index))

    monkeypatch.setattr(validation, "open_stream", lambda source, seed, size: Stream(10 * len(source)))
    found = matching_accuracy(network, 1, ("leaves", "endoscopy"), pairs=4, size=96)
    assert found["mma_3"] == pytest.approx((found["mma_3_leaves"] + found["mma_3_endoscopy"]) / 2)
    assert set(found) == {"mma_1", "mma_3", "correct_3", "repeatability_1", "mma_3_leaves", "mma_3_endoscopy"}


def test_every_run_is_validated_on_the_same_and_endoscopes_on_endoscopy_too():
    usual = held_out_sources("turned")
    assert usual == ("leaves", "patterns", "scenes")
    assert all(held_out_sources(mix) == usual for mix in MIXES if mix != "endoscope")
    assert held_out_sources("endoscope") == (*usual, "endoscopy")


def test_an_image_that_shows_nothing_has_no_matches(network):
    assert set(match_pair(network, Same(np.zeros((96, 96), np.float32))).metrics().values()) == {0.0}
