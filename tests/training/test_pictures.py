import numpy as np
import pytest
import torch

from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features import pictures
from sigmaslam_training.features.pictures import draw_sample
from sigmaslam_training.features.stream import open_stream
from sigmaslam_training.features.validation import PairMatches


def coloured(picture: np.ndarray, channel: int) -> np.ndarray:
    """Where a channel (1 green, 2 red) stands out."""
    others = np.delete(picture, [channel], axis=2)
    return picture[..., channel].astype(int) - others.max(axis=2) > 80


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize(("error", "shown", "not_shown"), [(2.9, 1, 2), (3.1, 2, 1)], ids=["right", "wrong"])
def test_right_matches_are_green_and_wrong_ones_red(
    monkeypatch: pytest.MonkeyPatch, error: float, shown: int, not_shown: int
):
    """From the point in image 0 to the point in image 1, twice as large and side by side."""
    point = torch.tensor([[30.0, 8.0]])
    found = PairMatches(point, point, torch.tensor([error]), torch.zeros(1))
    monkeypatch.setattr(pictures, "match_pair", lambda network, pair: found)
    picture = draw_sample(FeatureNetwork(), open_stream("leaves", 5, 96).pair(0))
    assert not coloured(picture, not_shown).any()
    rows, columns = np.nonzero(coloured(picture, shown))
    assert abs(rows - 16.5).max() <= 4
    assert columns.min() == pytest.approx(60.5, abs=4)
    assert columns.max() == pytest.approx(192 + 60.5, abs=4)


@pytest.mark.usefixtures("small")
def test_a_sample_shows_both_images_and_leaves_the_network_as_it_was():
    torch.manual_seed(0)
    network = FeatureNetwork().train()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    picture = draw_sample(network, open_stream("leaves", 5, 96).pair(0))
    assert picture.shape == (192, 384, 3)
    assert coloured(picture, 1).any() or coloured(picture, 2).any()
    assert network.training
    assert all(torch.equal(before[name], value) for name, value in network.state_dict().items())
