"""A run at the end of a step, in memory and as a safetensors file: going on from it is as if it had not stopped."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.models.export import load_network
from sigmaslam.models.network import FeatureNetwork
from sigmaslam.training.devices import Workplace, place_network
from sigmaslam.training.recipes import TrainingConfig

CHECKPOINT_NAME = "checkpoint.safetensors"
_OLD_NAME = "checkpoint.pt"
_FORMAT = "sigmaslam training 2"


@dataclass(slots=True)
class TrainingState:
    """Everything that changes while a run lasts, and what it is made of.

    The data have no state of their own: item i is a function of (seed, i), so the step says where they stand.

    Attributes:
        config: what the run is made of.
        recipe: its name, if it has one.
        started_from: name and sha256 of the weights that it began with; None: random ones.
        origin: commit and command that began it.
        network, optimizer, schedule: in training.
        step: steps that are done.
        seconds: that they took.
        metrics: of the last validation ...
        validated: ... and the step after which it was made; -1: never.
    """

    config: TrainingConfig
    recipe: str | None
    started_from: dict[str, str] | None
    network: FeatureNetwork
    optimizer: torch.optim.AdamW
    schedule: torch.optim.lr_scheduler.OneCycleLR
    step: int = 0
    seconds: float = 0.0
    metrics: dict[str, float] = field(default_factory=dict)
    validated: int = -1
    origin: dict[str, str] = field(default_factory=dict)


def check_run_folder(out: Path, resume: bool) -> None:
    """Refuses to overwrite a run, and to go on with one that is not there.

    Raises:
        InputError: `out` holds a checkpoint and `resume` is off, or the other way round, or one of an older version.
    """
    path = out / CHECKPOINT_NAME
    if (out / _OLD_NAME).exists() and not path.exists():
        raise InputError(
            f"{out / _OLD_NAME} was written by an older version, which alone can go on with it: give another --out"
        )
    if path.exists() and not resume:
        raise InputError(f"{path} exists: give --resume to go on with it, or another --out")
    if resume and not path.exists():
        raise InputError(f"{path} does not exist: there is nothing to resume; leave --resume out")


def begin(config: TrainingConfig, recipe: str | None, start: Path | None, place: Workplace) -> TrainingState:
    """A run before its first step, from random weights or from those of `start`.

    Raises:
        InputError: the weights of `start` are missing or of another network.
    """
    torch.manual_seed(config.seed)
    size, stride = config.descriptor_size, config.stride
    network = FeatureNetwork(size, stride) if start is None else _load_start(start, size, stride)
    network = place_network(network, place)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    # The rate rises for a tenth of the steps; a rise of one step, that of ten steps, is a division by zero in torch.
    rising = 0.1 if config.steps < 3 else max(0.1, 2 / config.steps)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=config.learning_rate, total_steps=config.steps, pct_start=rising
    )
    return TrainingState(config, recipe, _identify(start), network, optimizer, schedule)


def save_checkpoint(path: Path, state: TrainingState) -> None:
    """Writes the state; the file appears whole or not at all."""
    optimizer = state.optimizer.state_dict()
    tensors = {f"network.{name}": value for name, value in state.network.state_dict().items()}
    for index, values in optimizer["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in values.items()}
    tensors["random.torch"] = torch.get_rng_state()
    metadata = {
        "config": asdict(state.config),
        "recipe": state.recipe,
        "started_from": state.started_from,
        "origin": state.origin,
        "step": state.step,
        "seconds": state.seconds,
        "metrics": state.metrics,
        "validated": state.validated,
        "optimizer": optimizer["param_groups"],
        "schedule": state.schedule.state_dict(),
    }
    written = {"format": _FORMAT, **{name: json.dumps(value) for name, value in metadata.items()}}
    with atomic_path(path) as temporary:
        save_file({name: value.cpu().contiguous() for name, value in tensors.items()}, temporary, written)


def resume_checkpoint(
    path: Path, config: TrainingConfig, recipe: str | None, start: Path | None, place: Workplace
) -> TrainingState:
    """The state that `save_checkpoint` wrote.

    Args:
        path: of the checkpoint.
        config, recipe: of the run, as it was begun.
        start: the weights that it was begun from; None: whatever they were.
        place: where it goes on.
    Raises:
        InputError: the file cannot be read, or the run was begun with something else.
    """
    metadata, tensors = _read(path)
    _check_same(path, "", {**asdict(config), "recipe": recipe}, {**metadata["config"], "recipe": metadata["recipe"]})
    if start is not None:
        _check_same(path, "weights with ", _identify(start) or {}, metadata["started_from"] or {})
    state = begin(config, recipe, None, place)
    state.started_from, state.origin = metadata["started_from"], metadata["origin"]
    state.network.load_state_dict(_below("network", tensors))
    state.optimizer.load_state_dict({"state": _optimizer_state(state, tensors), "param_groups": metadata["optimizer"]})
    state.schedule.load_state_dict(metadata["schedule"])
    state.step, state.seconds = int(metadata["step"]), float(metadata["seconds"])
    state.metrics, state.validated = dict(metadata["metrics"]), int(metadata["validated"])
    torch.set_rng_state(tensors["random.torch"])
    return state


def _load_start(path: Path, descriptor_size: int, stride: int) -> FeatureNetwork:
    try:
        return load_network(path, descriptor_size, stride)
    except InputError as error:
        advice = "give weights that fit with --from, or train from nothing with --recipe full"
        raise InputError(f"{error}\nThe run was to start from these: {advice}") from error


def _identify(weights: Path | None) -> dict[str, str] | None:
    if weights is None:
        return None
    if not weights.is_file():
        raise InputError(f"{weights} does not exist: give the path of a .safetensors file with --from")
    return {"name": weights.name, "sha256": hashlib.sha256(weights.read_bytes()).hexdigest()}


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            written = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path} cannot be read ({error}): begin again in another --out") from error
    if written.pop("format", None) != _FORMAT:
        raise InputError(f"{path} is no checkpoint of this version: begin again in another --out")
    return {name: json.loads(value) for name, value in written.items()}, tensors


def _check_same(path: Path, what: str, given: dict[str, Any], written: dict[str, Any]) -> None:
    other = [name for name in {**given, **written} if given.get(name) != written.get(name)]
    if other:
        was, now = (", ".join(f"{name} {values.get(name)}" for name in other) for values in (written, given))
        raise InputError(f"{path} was made with {what}{was}, not {now}: resume with the same options")


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}


def _optimizer_state(state: TrainingState, tensors: dict[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    """By the number of the parameter, laid out in memory as the parameter is."""
    parameters = list(state.network.parameters())
    found: dict[int, dict[str, Tensor]] = {}
    for key, value in _below("optimizer", tensors).items():
        number, name = key.split(".")
        parameter = parameters[int(number)]
        if value.shape == parameter.shape:
            value = torch.empty_like(parameter, requires_grad=False).copy_(value)
        found.setdefault(int(number), {})[name] = value
    return found
