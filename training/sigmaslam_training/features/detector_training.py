"""Trains the learned response of the detector, with everything else of the network as it was."""

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file
from torch import Tensor

from sigmaslam.files import atomic_path, atomic_write_text, make_folder
from sigmaslam.progress import open_progress
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.network_export import load_network
from sigmaslam_training.devices import describe_processor
from sigmaslam_training.features.detector_loss import detector_loss
from sigmaslam_training.features.loop import WEIGHTS_NAME
from sigmaslam_training.features.stream import open_stream, take_turn
from sigmaslam_training.features.validation import held_out_seed, matching_accuracy
from sigmaslam_training.run_card import CARD_NAME, describe_origin
from sigmaslam_training.small_loop import train_steps

# Planes keep what they have while relief is learned.
_TURNS = ("wide scenes", "turned leaves", "wide scenes", "leaves")
_CHECKPOINT_NAME = "checkpoint.safetensors"
_LIMITS = [
    "the response alone is trained; descriptors, quality and sigma are those of the weights that it started from",
    "textures of renders: very dark, very noisy and textureless images give few keypoints",
]


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """What one run is made of.

    Attributes:
        steps: of the optimiser.
        batch_size: pairs a step.
        size: side of the square images, pixels.
        learning_rate: peak of the one-cycle schedule.
        seed: of everything.
    """

    steps: int = 3000
    batch_size: int = 4
    size: int = 320
    learning_rate: float = 3e-3
    seed: int = 0


def train_detector(out: Path, config: DetectorConfig, start: Path) -> dict[str, Any]:
    """Writes the weights with a trained response, and their card, into `out`; returns the card.

    What an interrupted run of the same configuration left there is used.

    Args:
        out: run folder.
        config: of the run.
        start: weights of the network.
    Raises:
        InputError: the weights do not fit, or the folder holds a run of another configuration.
        KeyboardInterrupt: the run was stopped; the same call goes on.
    """
    torch.set_num_threads(1)
    torch.manual_seed(config.seed)
    network = _with_response(load_network(start))
    assert network.response is not None
    make_folder(out)
    origin = describe_origin([out, start])
    began = time.monotonic()
    optimizer = torch.optim.AdamW(network.response.parameters(), config.learning_rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, config.learning_rate, total_steps=config.steps + 1)
    made_of = {**asdict(config), "start": start.name}
    with open_progress() as progress:
        task = progress.add_task("training the detector", total=config.steps, note="")
        train_steps(
            network.response,
            optimizer,
            schedule,
            config.steps,
            lambda done: _losses(network, config, done),
            out / _CHECKPOINT_NAME,
            made_of,
            lambda step, note: progress.update(task, completed=step, note=note),
            max_gradient=1.0,
        )
    metrics = matching_accuracy(network, held_out_seed(config.seed), ("wide scenes", "leaves", "patterns"))
    card = {
        "recipe": "detector",
        "config": made_of,
        "seed": config.seed,
        **origin,
        "duration_s": round(time.monotonic() - began, 1),
        "hardware": describe_processor(),
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "data": f"renders alone, no photograph: {', '.join(_TURNS)} in turn",
        "limits": _LIMITS,
        "metrics_on_held_out_renders": {name: round(value, 4) for name, value in metrics.items()},
    }
    with atomic_path(out / WEIGHTS_NAME) as path:
        save_file({name: value.contiguous() for name, value in network.state_dict().items()}, path)
    atomic_write_text(out / CARD_NAME, json.dumps(card, indent=2) + "\n")
    return card


def _with_response(network: FeatureNetwork) -> FeatureNetwork:
    """The network with a response, that of the Hessian where it has none."""
    if network.response is not None:
        return network
    detecting = FeatureNetwork(detects=True)
    detecting.load_state_dict({**detecting.state_dict(), **network.state_dict()})
    return detecting.requires_grad_(False).eval()


def _losses(network: FeatureNetwork, config: DetectorConfig, done: int) -> Iterator[Tensor]:
    """The mean loss of each further batch."""
    assert network.response is not None
    network.response.requires_grad_(True)
    streams = {source: open_stream(source, config.seed, config.size) for source in set(_TURNS)}
    for step in count(done):
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + step)
        losses = []
        for index in range(step * config.batch_size, (step + 1) * config.batch_size):
            source, of_source = take_turn(_TURNS, index)
            pair = streams[source].pair(of_source)
            images = [torch.from_numpy(image)[None] for image in (pair.image0, pair.image1)]
            losses.append(detector_loss(network, images[0], images[1], pair.transfer, generator))
        yield torch.stack(losses).mean()
