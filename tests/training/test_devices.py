import json
import os
import subprocess
import sys
from dataclasses import asdict, replace

import pytest
import torch
from safetensors.torch import load_file

from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.devices import Bfloat16Network, NetworkLoss, Workplace, open_workplace
from sigmaslam_training.features.loop import WEIGHTS_NAME
from sigmaslam_training.features.stream import pair_loader

# One process of two: trains, then writes what it has come to, and the gradient of the first step.
PROCESS = """
import json, sys
import torch
from pathlib import Path
from safetensors.torch import save_file
from sigmaslam_synthetic import homography_pairs
from sigmaslam_training.features import loop
from sigmaslam_training.features.recipes import TrainingConfig

homography_pairs._TEXTURE_SIZE = 128
out, config = Path(sys.argv[1]), TrainingConfig(**json.loads(sys.argv[2]))
written, finish, clip = {}, loop._Run.finish, loop.nn.utils.clip_grad_norm_

def recorded(parameters, norm):
    parameters = list(parameters)
    if not written:
        written.update({f"gradient.{i}": p.grad.clone().contiguous() for i, p in enumerate(parameters)})
    return clip(parameters, norm)

def finished(run, workers):
    finish(run, workers)
    written.update({f"weight.{i}": p.detach().contiguous() for i, p in enumerate(run._state.network.parameters())})
    save_file(written, out.parent / f"rank{run._place.rank}.safetensors")

loop._Run.finish, loop.nn.utils.clip_grad_norm_ = finished, recorded
loop.train(out, config, workers=0)
"""


@pytest.mark.slow
def test_two_processes_end_with_the_same_weights_and_share_their_gradients(tiny, tmp_path, monkeypatch):
    config = replace(tiny, batch_size=4, validate_every=0)
    script = tmp_path / "process.py"
    script.write_text(PROCESS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(script)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    arguments = [str(tmp_path / "run"), json.dumps(asdict(config))]
    result = subprocess.run(
        command + arguments, capture_output=True, text=True, env=environment, check=False, timeout=300
    )
    assert result.returncode == 0, result.stderr
    one, other = (load_file(tmp_path / f"rank{rank}.safetensors") for rank in range(2))
    for name, value in one.items():
        assert torch.equal(other[name], value), name
    shipped = load_file(tmp_path / "run" / WEIGHTS_NAME)
    assert torch.equal(shipped["describer.2.bias"], one[f"weight.{len(one) // 2 - 1}"])

    monkeypatch.setattr("sigmaslam_synthetic.homography_pairs._TEXTURE_SIZE", 128)
    shares = [first_gradient(config, rank, 2) for rank in range(2)]
    for index, values in enumerate(zip(*shares, strict=True)):
        torch.testing.assert_close(one[f"gradient.{index}"], sum(values) / 2, rtol=1e-4, atol=1e-5)


@pytest.mark.usefixtures("small")
def test_the_mean_gradient_of_the_shares_is_nearly_that_of_the_batch(tiny):
    """Without batch statistics. The jitter differs, and a share of few visible points counts as much as one of many."""
    config = replace(tiny, batch_size=4)
    shares = [first_gradient(config, rank, 2, frozen=True) for rank in range(2)]
    mean = torch.cat([(sum(values) / 2).flatten() for values in zip(*shares, strict=True)])
    whole = torch.cat([value.flatten() for value in first_gradient(config, 0, 1, frozen=True)])
    assert torch.cosine_similarity(mean, whole, dim=0) > 0.9
    assert 0.8 < mean.norm() / whole.norm() < 1.25


def first_gradient(config, rank: int, ranks: int, frozen: bool = False) -> list[torch.Tensor]:
    torch.manual_seed(config.seed)
    network = FeatureNetwork().train(not frozen)
    network.to(memory_format=torch.channels_last)
    loader = pair_loader(replace(config, steps=1, data="leaves", seed=0), 0, 0, rank, ranks)
    loss = NetworkLoss(network)(next(iter(loader)), torch.Generator().manual_seed(rank * 500_000_003))
    (loss.descriptor + config.quality_weight * loss.quality + config.place_weight * loss.place).backward()
    return [parameter.grad for parameter in network.parameters()]


def test_a_batch_that_cannot_be_shared_is_refused(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "3")
    with (
        pytest.raises(InputError, match="batch of 16 pairs cannot be shared by 3 processes"),
        open_workplace("cpu", 16),
    ):
        pass


@pytest.mark.parametrize(("name", "message"), [("tpu9", "is unknown"), ("meta", "not for training")])
def test_devices_that_are_none_are_refused(name, message):
    with pytest.raises(InputError, match=f"{name}.*{message}"), open_workplace(name, 16):
        pass


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_a_run_works_on_the_processor():
    with pytest.raises(InputError, match=r"cuda:0 does not exist.*0 GPUs"), open_workplace("cuda", 16):
        pass
    with open_workplace("auto", 16) as place:
        assert place == Workplace(torch.device("cpu"))
        assert place.leads
        assert place.agree(True)


def test_bfloat16_maps_are_float32_and_near_those_of_float32():
    torch.manual_seed(0)
    network = FeatureNetwork().eval()
    cells = torch.rand(1, 16, 24, 24)
    with torch.no_grad():
        exact, found = network(cells), Bfloat16Network(network)(cells)
    for a, b in zip(exact, found, strict=True):
        assert b.dtype == torch.float32
        torch.testing.assert_close(a, b, rtol=0.05, atol=0.05)
