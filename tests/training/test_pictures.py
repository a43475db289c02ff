import numpy as np
import pytest
import torch

from sigmaslam.models.network import FeatureNetwork
from sigmaslam.training.pictures import draw_matches, draw_sample
from sigmaslam.training.stream import open_stream


def coloured(picture: np.ndarray, channel: int) -> np.ndarray:
    """Where a channel (1 green, 2 red) stands out."""
    others = np.delete(picture, [channel], axis=2)
    return picture[..., channel].astype(int) - others.max(axis=2) > 80


def test_right_matches_are_green_and_wrong_ones_red():
    points = np.array([[4.0, 8.0], [4.0, 24.0]])
    picture = draw_matches(np.zeros((32, 32)), np.ones((32, 32)), points, points, np.array([True, False]))
    assert picture.shape == (64, 128, 3)
    assert picture.dtype == np.uint8
    green, red = coloured(picture, 1), coloured(picture, 2)
    assert set(np.flatnonzero(green.any(axis=1))) <= {16, 17}
    assert set(np.flatnonzero(red.any(axis=1))) <= {48, 49}
    # From the point in image 0 to the point in image 1, twice as large and side by side.
    columns = np.flatnonzero(green.any(axis=0))
    assert columns.min() == pytest.approx(8, abs=1)
    assert columns.max() == pytest.approx(64 + 8, abs=1)


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
