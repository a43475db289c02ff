"""Runs so small that the loop is tested, not the network."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.features.recipes import TrainingConfig
from tests.support.tiny_runs import make_small


@pytest.fixture
def small(monkeypatch):
    make_small(monkeypatch)


@pytest.fixture(scope="session")
def tiny() -> TrainingConfig:
    return TrainingConfig(
        steps=4, data="leaves", batch_size=2, size=96, points=16, validate_every=100, checkpoint_every=2
    )


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a network that was never trained."""
    torch.manual_seed(7)
    path = tmp_path_factory.mktemp("weights") / "others.safetensors"
    save_file({name: value.contiguous() for name, value in FeatureNetwork().state_dict().items()}, path)
    return path
