from dataclasses import replace

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from sigmaslam.errors import InputError
from sigmaslam_training.devices import Workplace
from sigmaslam_training.features.checkpoint import TrainingState, begin, resume_checkpoint, save_checkpoint

PLACE = Workplace(torch.device("cpu"))


def walk(state: TrainingState, steps: int) -> None:
    """Steps down a made-up slope, with random numbers in it."""
    for _ in range(steps):
        state.optimizer.zero_grad()
        sum((torch.rand(()) * p.square()).sum() for p in state.network.parameters()).backward()
        state.optimizer.step()
        state.schedule.step()
        state.step += 1


@pytest.fixture
def walked(tiny, tmp_path):
    state = begin(tiny, "quick", None, PLACE)
    walk(state, 2)
    state.metrics, state.validated, state.seconds = {"mma_3": 1 / 3}, 2, 12.5
    save_checkpoint(tmp_path / "checkpoint.safetensors", state)
    return state, tmp_path / "checkpoint.safetensors"


def test_what_is_read_is_what_was_written(walked, tiny):
    state, path = walked
    random = torch.get_rng_state()
    torch.rand(5)
    again = resume_checkpoint(path, tiny, "quick", None, PLACE)
    assert torch.equal(torch.get_rng_state(), random)
    for name in ("step", "seconds", "metrics", "validated", "recipe", "config", "started_from"):
        assert getattr(again, name) == getattr(state, name), name
    for name, value in state.network.state_dict().items():
        assert torch.equal(again.network.state_dict()[name], value)
        assert again.network.state_dict()[name].stride() == value.stride()
    assert again.schedule.state_dict() == state.schedule.state_dict()
    written, read = state.optimizer.state_dict(), again.optimizer.state_dict()
    for index, values in written["state"].items():
        for name, value in values.items():
            assert torch.equal(read["state"][index][name], value)
            assert read["state"][index][name].stride() == value.stride()


def test_going_on_from_a_checkpoint_is_as_not_stopping(walked, tiny):
    state, path = walked
    walk(state, 2)
    again = resume_checkpoint(path, tiny, "quick", None, PLACE)
    walk(again, 2)
    for name, value in state.network.state_dict().items():
        assert torch.equal(again.network.state_dict()[name], value), name


def test_the_file_names_its_tensors_and_tells_what_it_is(walked):
    _, path = walked
    with safe_open(path, framework="pt") as file:
        assert file.metadata()["step"] == "2"
        assert {"network.judge.weight", "optimizer.0.exp_avg", "optimizer.0.step", "random.torch"} <= set(file.keys())


def test_files_that_are_no_checkpoints_are_refused(tmp_path, tiny):
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"cannot be read.*another --out"):
        resume_checkpoint(path, tiny, None, None, PLACE)
    save_file({"weight": torch.zeros(1)}, path)
    with pytest.raises(InputError, match="no checkpoint of this version"):
        resume_checkpoint(path, tiny, None, None, PLACE)


def test_weights_of_another_network_are_refused_with_what_to_do(tmp_path, tiny, weights):
    others = load_file(weights)
    others["judge.weight"] = others["judge.weight"][:1].clone()
    save_file(others, tmp_path / "others.safetensors")
    with pytest.raises(InputError, match=r"(?s)others\.safetensors.*judge\.weight.*--from.*--recipe full"):
        begin(tiny, "endoscope", tmp_path / "others.safetensors", PLACE)


@pytest.mark.parametrize("steps", [1, 2, 3, 9, 10, 11, 20])
def test_runs_of_any_length_have_a_schedule(tiny, steps):
    state = begin(replace(tiny, steps=steps), None, None, PLACE)
    rates = []
    for _ in range(steps):
        rates.append(state.schedule.get_last_lr()[0])
        state.optimizer.step()
        state.schedule.step()
    assert all(0 < rate <= tiny.learning_rate * 1.001 for rate in rates)
    assert steps < 3 or max(rates) == pytest.approx(tiny.learning_rate, rel=1e-2)
