import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam_models.network_export import load_network
from sigmaslam_training import devices
from sigmaslam_training.features import loop
from sigmaslam_training.features.checkpoint import CHECKPOINT_NAME
from sigmaslam_training.features.loop import WEIGHTS_NAME, train
from sigmaslam_training.features.recipes import TrainingConfig
from sigmaslam_training.journal import Journal
from sigmaslam_training.run_card import CARD_NAME
from tests.support.tiny_runs import make_small

pytestmark = pytest.mark.usefixtures("small")


def in_step(step: int, happens, monkeypatch: pytest.MonkeyPatch) -> None:
    """Something happens in the middle of the step after `step` whole ones."""
    calls, pair_loss = [], devices.pair_loss

    def counted(*arguments):
        calls.append(1)
        if len(calls) == step + 1:
            happens()
        return pair_loss(*arguments)

    monkeypatch.setattr(devices, "pair_loss", counted)


def fail() -> None:
    raise KeyboardInterrupt


def logged_steps(out: Path) -> list[int]:
    return [json.loads(line)["step"] for line in (out / "log.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory, tiny: TrainingConfig) -> Path:
    out = tmp_path_factory.mktemp("run") / "whole"
    with pytest.MonkeyPatch.context() as context:
        make_small(context)
        train(out, tiny, workers=0, recipe="quick")
    return out


@pytest.mark.long
@pytest.mark.parametrize(
    ("happens", "saved"),
    [
        (lambda: os.kill(os.getpid(), signal.SIGINT), 3),
        (lambda: os.kill(os.getpid(), signal.SIGTERM), 3),
        # Torn apart in the middle of a step, which is not saved: it goes on from the last checkpoint.
        (fail, 2),
    ],
    ids=["interrupted", "terminated", "torn"],
)
def test_a_stopped_run_ends_as_one_that_was_not_stopped(finished, tiny, tmp_path, monkeypatch, happens, saved):
    whole_steps_before = 2
    with monkeypatch.context() as context:
        in_step(whole_steps_before, happens, context)
        with pytest.raises(KeyboardInterrupt):
            train(tmp_path, tiny, workers=0, recipe="quick")
    assert not (tmp_path / WEIGHTS_NAME).exists()
    with safe_open(tmp_path / CHECKPOINT_NAME, framework="pt") as file:
        assert int(file.metadata()["step"]) == saved
    card = train(tmp_path, tiny, workers=0, resume=True, recipe="quick")
    whole, parts = (load_file(folder / WEIGHTS_NAME) for folder in (finished, tmp_path))
    assert whole.keys() == parts.keys()
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=1e-6, msg=name)
    expected = json.loads((finished / CARD_NAME).read_text())["metrics_on_held_out_renders"]
    assert card["metrics_on_held_out_renders"] == expected
    assert logged_steps(tmp_path) == [4]


@pytest.mark.long
def test_a_loss_that_is_no_number_ends_the_run_and_keeps_its_checkpoint(tiny, tmp_path, monkeypatch):
    pair_loss, calls = devices.pair_loss, []

    def spoilt(*arguments):
        calls.append(1)
        loss = pair_loss(*arguments)
        return loss if len(calls) <= 2 else loss._replace(descriptor=np.nan * loss.descriptor)

    monkeypatch.setattr(devices, "pair_loss", spoilt)
    with pytest.raises(SigmaSlamError, match="step 2: loss or gradient is not finite"):
        train(tmp_path, tiny, workers=0, recipe="quick")
    with safe_open(tmp_path / CHECKPOINT_NAME, framework="pt") as file:
        assert int(file.metadata()["step"]) == 2


@pytest.mark.long
def test_run_folder_holds_weights_card_log_curves_and_samples(finished, tiny):
    load_network(finished / WEIGHTS_NAME)
    card = json.loads((finished / CARD_NAME).read_text())
    assert TrainingConfig(**card["config"]) == tiny
    assert card["recipe"] == "quick"
    assert card["started_from"] is None
    for key in ("seed", "commit", "command", "duration_s", "hardware", "parameters", "data", "limits"):
        assert key in card
    assert "mma_3_leaves" in card["metrics_on_held_out_renders"]
    assert logged_steps(finished) == [4]
    for step in (0, 4):
        picture = cv2.imread(str(finished / "samples" / f"step_{step:05d}.png"))
        # A pair of each source of the validation, one below the other: leaves, patterns and scenes.
        assert picture.shape == (3 * 192, 384, 3)
        assert len({row.tobytes() for row in np.split(picture, 3)}) == 3
    events = EventAccumulator(str(finished / "tensorboard")).Reload()
    scalars = set(events.Tags()["scalars"])
    assert scalars >= {f"train/{name}" for name in ("descriptor", "quality", "place", "recall", "learning_rate")}
    assert scalars >= {"train/steps_per_second", "held_out/mma_3"}
    assert [image.step for image in events.Images("matches")] == [0, 4]


@pytest.mark.long
def test_a_trial_is_validated_on_a_tenth_of_what_it_learns_from(tiny, tmp_path, monkeypatch, capsys):
    counts = []
    monkeypatch.setattr(loop, "matching_accuracy", lambda network, seed, sources, count: counts.append(count) or {})
    monkeypatch.setattr(loop, "draw_sample", lambda network, pair: np.zeros((2, 2, 3), np.uint8))
    train(tmp_path, replace(tiny, steps=5, batch_size=2), workers=0)
    assert counts == [2]
    assert "step 5: matching 2 held-out pairs" in capsys.readouterr().err


def test_a_log_that_a_power_cut_tore_is_gone_on_with(finished, tmp_path):
    log = tmp_path / "log.jsonl"
    log.write_text('{"step": 2}\n{"step": 4}\n{"step": 6, "des')
    Journal(tmp_path, 2).close()
    assert log.read_text() == '{"step": 2}\n'


def test_a_resumed_run_tells_of_the_command_that_began_it(finished, tiny, tmp_path, monkeypatch):
    finished = Path(shutil.copytree(finished, tmp_path / "copy"))
    card = json.loads((finished / CARD_NAME).read_text())
    monkeypatch.setattr("sys.argv", ["sigmaslam", "train", "--resume"])
    again = train(finished, tiny, workers=0, resume=True, recipe="quick")
    assert again["command"] == card["command"]
    assert "--resume" not in again["command"]


def test_a_file_in_the_way_of_the_run_folder_is_refused(tiny, tmp_path):
    (tmp_path / "run").touch()
    with pytest.raises(InputError, match=r"run cannot be made a folder"):
        train(tmp_path / "run", tiny, workers=0)


@pytest.mark.parametrize("seed", [2**40])
def test_a_time_stamp_will_do_for_a_seed(tiny, tmp_path, seed):
    train(tmp_path, replace(tiny, steps=1, seed=seed, validate_every=0), workers=0)


def test_an_existing_checkpoint_is_not_overwritten(finished, tiny):
    before = (finished / WEIGHTS_NAME).read_bytes()
    with pytest.raises(InputError, match=r"checkpoint\.safetensors exists.*--resume"):
        train(finished, tiny, workers=0, recipe="quick")
    assert (finished / WEIGHTS_NAME).read_bytes() == before


def test_a_checkpoint_of_an_older_version_is_refused(tmp_path, tiny):
    (tmp_path / "checkpoint.pt").touch()
    for resume in (False, True):
        with pytest.raises(InputError, match=r"older version.*another --out"):
            train(tmp_path, tiny, workers=0, resume=resume)


def test_resuming_without_a_checkpoint_is_refused(tmp_path, tiny):
    with pytest.raises(InputError, match="nothing to resume"):
        train(tmp_path / "empty", tiny, workers=0, resume=True)
    assert not (tmp_path / "empty").exists()


def test_resuming_with_other_options_is_refused(finished, tiny, weights):
    with pytest.raises(InputError, match=r"learning_rate 0\.002, not learning_rate 0\.0001.*same options"):
        train(finished, replace(tiny, learning_rate=1e-4), workers=0, resume=True, recipe="quick")
    with pytest.raises(InputError, match="recipe quick, not recipe full"):
        train(finished, tiny, workers=0, resume=True, recipe="full")
    with pytest.raises(InputError, match=r"name None.*not name others\.safetensors"):
        train(finished, tiny, workers=0, resume=True, recipe="quick", start=weights)


def test_resuming_a_finished_run_keeps_its_weights_and_metrics(finished, tiny, tmp_path):
    finished = Path(shutil.copytree(finished, tmp_path / "copy"))
    before = load_file(finished / WEIGHTS_NAME)
    card = json.loads((finished / CARD_NAME).read_text())
    again = train(finished, tiny, workers=0, resume=True, recipe="quick")
    after = load_file(finished / WEIGHTS_NAME)
    for name, value in before.items():
        assert torch.equal(after[name], value), name
    assert again["metrics_on_held_out_renders"] == card["metrics_on_held_out_renders"]


def test_a_run_starts_from_given_weights_and_remembers_them(tmp_path, tiny, weights):
    card = train(tmp_path, replace(tiny, steps=1, validate_every=0, learning_rate=1e-9), workers=0, start=weights)
    begun, ended = load_file(weights), load_file(tmp_path / WEIGHTS_NAME)
    torch.testing.assert_close(ended["judge.weight"], begun["judge.weight"], rtol=0, atol=1e-6)
    assert card["started_from"]["name"] == "others.safetensors"
    assert len(card["started_from"]["sha256"]) == 64
    # What it began with need not be there any more, and is still told.
    again = train(tmp_path, replace(tiny, steps=1, validate_every=0, learning_rate=1e-9), workers=0, resume=True)
    assert again["started_from"] == card["started_from"]
    assert not (tmp_path / "samples").exists()


def test_training_from_no_weights_is_refused_before_anything_is_written(tmp_path, tiny):
    with pytest.raises(InputError, match=r"no\.safetensors does not exist"):
        train(tmp_path / "run", tiny, workers=0, start=tmp_path / "no.safetensors")
    assert not (tmp_path / "run").exists()
