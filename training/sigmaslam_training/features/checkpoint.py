"""A run that trains the features, in memory and as a checkpoint."""

import hashlib
from dataclasses import asdict, dataclass, field
from pathlib import Path

import torch

from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.network_export import load_network
from sigmaslam_training.devices import Workplace, place_network
from sigmaslam_training.features.recipes import TrainingConfig
from sigmaslam_training.snapshot import check_same, read_snapshot, restore, write_snapshot

CHECKPOINT_NAME = "checkpoint.safetensors"
_OLD_NAME = "checkpoint.pt"


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
    network = place_network(FeatureNetwork() if start is None else _load_start(start), place)
    optimizer = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    # The rate rises for a tenth of the steps; a rise of one step, that of ten steps, is a division by zero in torch.
    rising = 0.1 if config.steps < 3 else max(0.1, 2 / config.steps)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, max_lr=config.learning_rate, total_steps=config.steps, pct_start=rising
    )
    return TrainingState(config, recipe, _identify(start), network, optimizer, schedule)


def save_checkpoint(path: Path, state: TrainingState) -> None:
    """Writes the state; the file appears whole or not at all."""
    facts = {
        "config": asdict(state.config),
        "recipe": state.recipe,
        "started_from": state.started_from,
        "origin": state.origin,
        "seconds": state.seconds,
        "metrics": state.metrics,
        "validated": state.validated,
    }
    write_snapshot(path, state.network, state.optimizer, state.schedule, state.step, facts)


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
    snapshot = read_snapshot(path)
    facts = snapshot.facts
    written = {"shares": {}, **facts["config"], "recipe": facts["recipe"]}  # no shares in those of earlier versions
    check_same(path, "", {**asdict(config), "recipe": recipe}, written)
    if start is not None:
        check_same(path, "weights with ", _identify(start) or {}, facts["started_from"] or {})
    state = begin(config, recipe, None, place)
    state.step = restore(snapshot, state.network, state.optimizer, state.schedule)
    state.started_from, state.origin = facts["started_from"], facts["origin"]
    state.seconds, state.metrics = float(facts["seconds"]), dict(facts["metrics"])
    state.validated = int(facts["validated"])
    return state


def _load_start(path: Path) -> FeatureNetwork:
    try:
        return load_network(path)
    except InputError as error:
        advice = "give weights that fit with --from, or train from nothing with --recipe full"
        raise InputError(f"{error}\nThe run was to start from these: {advice}") from error


def _identify(weights: Path | None) -> dict[str, str] | None:
    if weights is None:
        return None
    if not weights.is_file():
        raise InputError(f"{weights} does not exist: give the path of a .safetensors file with --from")
    return {"name": weights.name, "sha256": hashlib.sha256(weights.read_bytes()).hexdigest()}
