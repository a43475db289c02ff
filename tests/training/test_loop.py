import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from sigmaslam.errors import InputError
from sigmaslam.models.export import load_network
from sigmaslam.synthetic import pairs
from sigmaslam.training import loop, stream
from sigmaslam.training.loop import CARD_NAME, WEIGHTS_NAME, TrainingConfig, train
from sigmaslam.training.stream import MixedPairs, PairDataset, pair_loader
from sigmaslam.training.validation import matching_accuracy

TINY = TrainingConfig(steps=4, data="leaves", batch_size=2, size=96, points=16, validate_every=100, checkpoint_every=2)


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """Small textures and one held-out pair: the loop is tested, not the network."""
    monkeypatch.setattr(pairs, "_TEXTURE_SIZE", 128)
    monkeypatch.setattr(loop, "matching_accuracy", functools.partial(matching_accuracy, pairs=1, size=96))


def interrupt_before_step(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, pair_loss = [], loop.pair_loss

    def counted(*arguments):
        calls.append(1)
        if len(calls) > step:
            raise KeyboardInterrupt
        return pair_loss(*arguments)

    monkeypatch.setattr(loop, "pair_loss", counted)


def test_a_resumed_run_ends_with_the_weights_of_an_uninterrupted_one(tmp_path, monkeypatch):
    """Interrupted a step after its last checkpoint."""
    card = train(tmp_path / "whole", TINY, workers=0)
    with monkeypatch.context() as context:
        interrupt_before_step(3, context)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path / "parts", TINY, workers=0)
    assert not (tmp_path / "parts" / WEIGHTS_NAME).exists()
    resumed = train(tmp_path / "parts", TINY, workers=0, resume=True)
    whole, parts = (load_file(tmp_path / name / WEIGHTS_NAME) for name in ("whole", "parts"))
    assert whole.keys() == parts.keys()
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=1e-6, msg=name)
    assert resumed["metrics_on_held_out_renders"] == card["metrics_on_held_out_renders"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as context:
        context.setattr(pairs, "_TEXTURE_SIZE", 128)
        context.setattr(loop, "matching_accuracy", functools.partial(matching_accuracy, pairs=1, size=96))
        train(out, replace(TINY, steps=2), workers=0)
    return out


def test_run_folder_holds_weights_card_and_log(finished):
    load_network(finished / WEIGHTS_NAME)
    card = json.loads((finished / CARD_NAME).read_text())
    assert TrainingConfig(**card["config"]) == replace(TINY, steps=2)
    for key in ("seed", "commit", "command", "duration_s", "metrics_on_held_out_renders"):
        assert key in card
    log = [json.loads(line) for line in (finished / "log.jsonl").read_text().splitlines()]
    assert log[-1]["step"] == 2


def test_an_existing_checkpoint_is_not_overwritten(finished):
    before = (finished / WEIGHTS_NAME).read_bytes()
    with pytest.raises(InputError, match=r"checkpoint\.pt exists.*--resume"):
        train(finished, replace(TINY, steps=2), workers=0)
    assert (finished / WEIGHTS_NAME).read_bytes() == before


def test_resuming_without_a_checkpoint_is_refused(tmp_path):
    with pytest.raises(InputError, match="nothing to resume"):
        train(tmp_path / "empty", TINY, workers=0, resume=True)
    assert not (tmp_path / "empty").exists()


def test_resuming_with_another_recipe_is_refused(finished):
    with pytest.raises(InputError, match="same options"):
        train(finished, replace(TINY, steps=2, learning_rate=1e-4), workers=0, resume=True)


def test_resuming_a_finished_run_keeps_its_weights_and_metrics(finished, tmp_path):
    finished = Path(shutil.copytree(finished, tmp_path / "copy"))
    before = load_file(finished / WEIGHTS_NAME)
    card = json.loads((finished / CARD_NAME).read_text())
    again = train(finished, replace(TINY, steps=2), workers=0, resume=True)
    after = load_file(finished / WEIGHTS_NAME)
    for name, value in before.items():
        assert torch.equal(after[name], value), name
    assert again["metrics_on_held_out_renders"] == card["metrics_on_held_out_renders"]


def test_batches_do_not_depend_on_where_the_loader_begins():
    whole = list(pair_loader("leaves", 0, 96, 0, 6, 16, 2, workers=0))
    rest = list(pair_loader("leaves", 0, 96, 4, 6, 16, 2, workers=0))
    assert len(whole) == 3
    assert len(rest) == 1
    for a, b in zip(whole[2], rest[0], strict=True):
        assert torch.equal(a, b)


def test_corners_lie_in_the_image_and_have_the_promised_number():
    image0, image1, corners0, places1, visible, corners1 = PairDataset("leaves", 0, 96, 0, 4, corners=300)[3]
    assert image0.shape == image1.shape == (1, 96, 96)
    assert places1.shape == (300, 2)
    assert visible.shape == (300,)
    assert (places1[visible] >= 0).all()
    assert (places1[visible] <= 95).all()
    for corners in (corners0, corners1):
        assert corners.shape == (300, 2)
        assert corners.min() >= 0
        assert corners.max() <= 95
    with pytest.raises(IndexError):
        PairDataset("leaves", 0, 96, 0, 4, corners=300)[4]


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
