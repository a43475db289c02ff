"""A training at the end of a step as one safetensors file: going on from it is as if it had not stopped."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path

_FORMAT = "sigmaslam training 2"


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a file holds.

    Attributes:
        facts: step, settings of optimiser and schedule, and what the writer added, by name.
        tensors: of network, optimiser and random state, by name.
    """

    facts: dict[str, Any]
    tensors: dict[str, Tensor]


def write_snapshot(
    path: Path,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    step: int,
    facts: Mapping[str, Any],
) -> None:
    """Writes everything that changes while a training lasts; the file appears whole or not at all.

    Args:
        network, optimizer, schedule: in training.
        step: steps that are done.
        facts: to be kept beside them, as JSON.
    """
    state = optimizer.state_dict()
    tensors = {f"network.{name}": value for name, value in network.state_dict().items()}
    for index, values in state["state"].items():
        tensors |= {f"optimizer.{index}.{name}": value for name, value in values.items()}
    tensors["random.torch"] = torch.get_rng_state()
    metadata = {**facts, "step": step, "optimizer": state["param_groups"], "schedule": schedule.state_dict()}
    written = {"format": _FORMAT, **{name: json.dumps(value) for name, value in metadata.items()}}
    save_tensors(path, tensors, written)


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> None:
    """Writes tensors by name as .safetensors; the file appears whole or not at all."""
    with atomic_path(path) as temporary:
        save_file({name: value.cpu().contiguous() for name, value in tensors.items()}, temporary, metadata)


def read_snapshot(path: Path) -> Snapshot:
    """What `write_snapshot` wrote.

    Raises:
        InputError: the file cannot be read, or is of another version.
    """
    try:
        with safe_open(path, framework="pt") as file:
            written = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - no dict
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path} cannot be read ({error}): begin again in another --out") from error
    if written.pop("format", None) != _FORMAT:
        raise InputError(f"{path} is no checkpoint of this version: begin again in another --out")
    return Snapshot({name: json.loads(value) for name, value in written.items()}, tensors)


def restore(
    snapshot: Snapshot,
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
) -> int:
    """Puts the state into a network, its optimiser and schedule, and torch's random state; returns the steps done."""
    network.load_state_dict(_below("network", snapshot.tensors))
    moments = _optimizer_state(network, snapshot.tensors)
    optimizer.load_state_dict({"state": moments, "param_groups": snapshot.facts["optimizer"]})
    schedule.load_state_dict(snapshot.facts["schedule"])
    torch.set_rng_state(snapshot.tensors["random.torch"])
    return int(snapshot.facts["step"])


def check_same(path: Path, what: str, given: Mapping[str, Any], written: Mapping[str, Any]) -> None:
    """Refuses to go on with what was begun otherwise.

    Raises:
        InputError: names what differs between the options given and those written.
    """
    other = [name for name in {**given, **written} if given.get(name) != written.get(name)]
    if other:
        was, now = (", ".join(f"{name} {values.get(name)}" for name in other) for values in (written, given))
        raise InputError(f"{path} was made with {what}{was}, not {now}: resume with the same options")


def _below(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name.removeprefix(f"{prefix}."): value for name, value in tensors.items() if name.startswith(f"{prefix}.")}


def _optimizer_state(network: nn.Module, tensors: dict[str, Tensor]) -> dict[int, dict[str, Tensor]]:
    """By the number of the parameter, laid out in memory as the parameter is."""
    parameters = list(network.parameters())
    found: dict[int, dict[str, Tensor]] = {}
    for key, value in _below("optimizer", tensors).items():
        number, name = key.split(".")
        parameter = parameters[int(number)]
        if value.shape == parameter.shape:
            value = torch.empty_like(parameter, requires_grad=False).copy_(value)
        found.setdefault(int(number), {})[name] = value
    return found
