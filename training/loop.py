"""The training loop: resumable at any checkpoint, the same result whether it was interrupted or not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from safetensors.torch import save_file
from torch import nn

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.models.network import FeatureNetwork
from sigmaslam.training.step import pair_loss
from sigmaslam.training.stream import MIXES, pair_loader
from sigmaslam.training.validation import matching_accuracy

WEIGHTS_NAME = "features.safetensors"
CARD_NAME = "features.json"
_CHECKPOINT_NAME = "checkpoint.pt"
_VALIDATION_SEED_OFFSET = 1_000_003


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """What one run is made of.

    Attributes:
        steps: optimiser steps.
        data: what the pairs are made of, a key of `stream.MIXES`.
        batch_size: pairs a step.
        size: side of the training images, pixels.
        points: corners per image in the loss.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        quality_weight, place_weight: of the losses of quality and log-sigma beside the descriptor loss.
        seed: of the data, the initial weights and the sampling.
        validate_every: in steps, and at the end; 0: never.
        checkpoint_every: in steps.
    """

    steps: int = 3400
    data: str = "leaves"
    batch_size: int = 16
    size: int = 224
    points: int = 256
    learning_rate: float = 2e-3
    weight_decay: float = 1e-4
    quality_weight: float = 0.5
    place_weight: float = 0.1
    seed: int = 0
    validate_every: int = 1700
    checkpoint_every: int = 250


def train(out: Path, config: TrainingConfig, workers: int = 1, resume: bool = False) -> dict[str, Any]:
    """Trains the correspondence network on procedural textures and writes weights and card into `out`.

    Args:
        out: run folder; gets checkpoint.pt, log.jsonl, features.safetensors and features.json.
        config: the recipe.
        workers: processes that make pairs.
        resume: go on from the checkpoint in `out`.
    Returns:
        The card: config, seed, commit, command, duration, metrics on held-out renders.
    Raises:
        InputError: `out` holds a checkpoint and `resume` is off, or the other way round, or another recipe made it.
    """
    checkpoint_path = out / _CHECKPOINT_NAME
    if checkpoint_path.exists() and not resume:
        raise InputError(f"{checkpoint_path} exists: give --resume to go on with it, or another --out")
    if resume and not checkpoint_path.exists():
        raise InputError(f"{checkpoint_path} does not exist: there is nothing to resume; leave --resume out")
    out.mkdir(parents=True, exist_ok=True)

    commit = _commit()  # before the run: the tree may move on while it lasts
    torch.manual_seed(config.seed)
    network = FeatureNetwork()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=config.learning_rate, total_steps=config.steps, pct_start=0.1
    )
    first, seconds = 0, 0.0
    metrics: dict[str, float] = {}
    if resume:
        state = torch.load(checkpoint_path, weights_only=True)
        if state["config"] != asdict(config):
            raise InputError(
                f"{checkpoint_path} was made with {state['config']}, not {asdict(config)}: resume with the same options"
            )
        network.load_state_dict(state["network"])
        optimizer.load_state_dict(state["optimizer"])
        schedule.load_state_dict(state["schedule"])
        first, seconds, metrics = int(state["step"]), float(state["seconds"]), dict(state["metrics"])

    loader = pair_loader(
        config.data,
        config.seed,
        config.size,
        first * config.batch_size,
        config.steps * config.batch_size,
        config.points,
        config.batch_size,
        workers,
    )
    began = time.monotonic() - seconds
    with _progress() as progress:
        task = progress.add_task("training", total=config.steps, completed=first, note="")
        for step, (image0, image1, keypoints0, places1, visible, keypoints1) in enumerate(loader, start=first):
            generator = torch.Generator().manual_seed(config.seed * 1_000_000_007 + step)
            network.train()
            loss = pair_loss(network, image0, image1, keypoints0, places1, visible, keypoints1, generator)
            optimizer.zero_grad(set_to_none=True)
            (loss.descriptor + config.quality_weight * loss.quality + config.place_weight * loss.place).backward()
            nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimizer.step()
            schedule.step()
            done = step + 1
            progress.update(task, advance=1, note=f"loss {loss.descriptor.item():.3f} recall {loss.recall.item():.3f}")
            if done % 50 == 0 or done == config.steps:
                _log(out, done, loss.descriptor.item(), loss.quality.item(), loss.recall.item())
            if config.validate_every and (done % config.validate_every == 0 or done == config.steps):
                metrics = matching_accuracy(network, config.seed + _VALIDATION_SEED_OFFSET)
                progress.console.print(f"step {done}: " + ", ".join(f"{k} {v:.3f}" for k, v in metrics.items()))
            if done % config.checkpoint_every == 0 or done == config.steps:
                state = {
                    "network": network.state_dict(),
                    "optimizer": optimizer.state_dict(),
                    "schedule": schedule.state_dict(),
                    "config": asdict(config),
                    "step": done,
                    "seconds": time.monotonic() - began,
                    "metrics": metrics,
                }
                with atomic_path(checkpoint_path) as path:
                    torch.save(state, path)
    card = {
        "config": asdict(config),
        "seed": config.seed,
        "commit": commit,
        # The folder's name alone: where it lay on this machine is nobody's business.
        "command": " ".join(["sigmaslam", *sys.argv[1:]]).replace(str(out), out.name),
        "duration_s": round(time.monotonic() - began, 1),
        "hardware": f"{os.cpu_count()} CPU cores, torch {torch.__version__}",
        "parameters": sum(p.numel() for p in network.parameters()),
        "data": f"renders alone, no photograph: {', '.join(MIXES[config.data])} in turn",
        "metrics_on_held_out_renders": {k: round(v, 4) for k, v in metrics.items()},
    }
    with atomic_path(out / WEIGHTS_NAME) as path:
        save_file({k: v.contiguous() for k, v in network.state_dict().items()}, path)
    with atomic_path(out / CARD_NAME) as path:
        path.write_text(json.dumps(card, indent=2) + "\n")
    return card


def _log(out: Path, step: int, descriptor: float, quality: float, recall: float) -> None:
    with (out / "log.jsonl").open("a") as log:
        log.write(json.dumps({"step": step, "descriptor": descriptor, "quality": quality, "recall": recall}) + "\n")


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )


def _commit() -> str:
    """The commit of the source tree, or 'unknown' when installed from a wheel."""
    try:
        result = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).resolve().parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()
