"""Training pairs: their order, and what they are made of."""

import itertools

import numpy as np
import pytest
import torch

from sigmaslam.errors import InputError
from sigmaslam_synthetic import homography_pairs
from sigmaslam_training.features import stream
from sigmaslam_training.features.recipes import TrainingConfig
from sigmaslam_training.features.stream import MixedPairs, PairDataset, open_stream, pair_loader
from sigmaslam_training.mixes import MIXES


@pytest.fixture(autouse=True)
def small_textures(monkeypatch):
    monkeypatch.setattr(homography_pairs, "_TEXTURE_SIZE", 128)


def test_batches_do_not_depend_on_where_the_loader_begins():
    config = TrainingConfig(steps=3, batch_size=2, size=96, points=16)
    whole = list(pair_loader(config, 0, workers=0))
    rest = list(pair_loader(config, 2, workers=0))
    assert len(whole) == 3
    assert len(rest) == 1
    for a, b in zip(whole[2], rest[0], strict=True):
        assert torch.equal(a, b)


def test_keypoints_lie_in_the_image_and_have_the_promised_number():
    pairs = PairDataset(TrainingConfig(steps=4, batch_size=1, size=96, points=300), 0)
    image0, image1, keypoints0, places1, visible, keypoints1 = pairs[3]
    assert image0.shape == image1.shape == (1, 96, 96)
    assert places1.shape == (300, 2)
    assert visible.shape == (300,)
    assert (places1[visible] >= 0).all()
    assert (places1[visible] <= 95).all()
    assert keypoints0.shape == (300, 2)
    assert keypoints1.shape == (600, 2)
    found1 = keypoints1[(keypoints1 != stream.NOWHERE).all(dim=1)]
    assert 0 < len(found1) < 600
    for keypoints in (keypoints0, found1):
        assert keypoints.min() >= 0
        assert keypoints.max() <= 95
    with pytest.raises(IndexError):
        pairs[4]


def test_sources_of_a_mix_take_turns_and_see_neighbouring_numbers(monkeypatch):
    asked = []

    class Recorder:
        def __init__(self, source):
            self.source = source

        def pair(self, index):
            asked.append((self.source, index))

    monkeypatch.setattr(stream, "open_stream", lambda source, seed, size: Recorder(source))
    mixed = MixedPairs("mix", 0, 96)
    for index in range(10):
        mixed.pair(index)
    assert [source for source, _ in asked] == ["leaves", "scenes", "leaves", "scenes", "leaves"] * 2
    assert [index for source, index in asked if source == "leaves"] == list(range(6))
    assert [index for source, index in asked if source == "scenes"] == list(range(4))


def test_an_unknown_mix_is_refused():
    with pytest.raises(InputError, match="choose one of leaves"):
        MixedPairs("photographs", 0, 96)


@pytest.mark.long
@pytest.mark.parametrize("ranks", [2, 4])
def test_shares_of_the_processes_make_up_the_batches_of_one(ranks):
    config = TrainingConfig(steps=3, batch_size=4, size=96, points=16)
    whole = list(pair_loader(config, 1, workers=0))
    shares = [list(pair_loader(config, 1, 0, rank, ranks)) for rank in range(ranks)]
    for index, batch in enumerate(whole):
        for part, expected in enumerate(batch):
            found = torch.stack([share[index][part] for share in shares], dim=1).flatten(0, 1)
            assert torch.equal(found, expected)


@pytest.mark.long
def test_turned_leaves_are_turned_further():
    def turns(source: str) -> np.ndarray:
        """Degrees by which the middle of the second view is turned against the first."""
        stream = open_stream(source, 0, 96)
        middle = np.array([[47.5, 47.5], [48.5, 47.5], [47.5, 48.5]])
        moved = np.stack([stream.pair(index).transfer(middle)[0] for index in range(150)])
        along_u, along_v = moved[:, 1] - moved[:, 0], moved[:, 2] - moved[:, 0]
        turn = np.arctan2(along_u[:, 1] - along_v[:, 0], along_u[:, 0] + along_v[:, 1])
        return np.abs(np.degrees(turn))

    usual, further = turns("leaves"), turns("turned leaves")
    # Angles of the two views are uniform to 20 and 40 degrees, or to 40 and 50; strong perspectives add a little.
    assert (usual > 50).mean() < 0.06 < 0.1 < (further > 50).mean()
    assert 75 < np.quantile(further, 0.97) < 95


@pytest.mark.parametrize("mix", ["turned", "endoscope", "mix"])
def test_sources_of_a_mix_share_no_textures(mix):
    banks = [source._bank for source in MixedPairs(mix, 3, 96)._streams.values() if hasattr(source, "_bank")]
    textures = [bank.texture(index) for bank in banks for index in (0, 1, 40)]
    for one, other in itertools.combinations(textures, 2):
        assert one.shape != other.shape or np.abs(one.astype(float) - other).mean() > 1


def test_endoscopy_shows_the_inside_of_bodies_alone():
    assert open_stream("endoscopy", 0, 96).domains == ("colon", "organ")
    assert MIXES["endoscope"].count("endoscopy") == 2


@pytest.mark.slow
def test_workers_make_the_same_batches_after_this_process_has_computed(monkeypatch):
    """Forked workers would wait for ever: drawing a sample before the first step did that."""
    monkeypatch.undo()  # workers know nothing of the small textures
    config = TrainingConfig(steps=2, batch_size=2, size=96, points=16)
    alone = list(pair_loader(config, 0, workers=0))
    helped = list(pair_loader(config, 0, workers=1))
    for batch, other in zip(alone, helped, strict=True):
        for a, b in zip(batch, other, strict=True):
            assert torch.equal(a, b)
