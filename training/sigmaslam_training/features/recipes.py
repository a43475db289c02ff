"""What a training run is made of, and the runs that have a name."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from sigmaslam.errors import InputError
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam_training.sources import Mix, check_sources, turns_of


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """What one run is made of.

    Attributes:
        steps: optimiser steps.
        data: what the pairs are made of, a key of `mixes.MIXES`.
        batch_size: pairs a step, of all processes together.
        size: side of the training images, pixels.
        points: keypoints per image in the loss.
        learning_rate: peak of the one-cycle schedule.
        weight_decay: of AdamW.
        quality_weight, place_weight: of the losses of quality and log-sigma beside the descriptor loss.
        seed: of the data, the initial weights and the sampling.
        validate_every: in steps, and at the end; 0: never.
        checkpoint_every: in steps.
        shares: of the pairs by source, see `sources`, in place of `data`; none: as `data` says.
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
    shares: Mapping[str, float] = field(default_factory=dict)

    @property
    def mix(self) -> Mix:
        """What the pairs are made of."""
        return self.shares or self.data


RECIPES = {
    # What the shipped weights are made with.
    "full": TrainingConfig(steps=5000, data="turned"),
    # To see that everything works: five to seven minutes on two cores.
    "quick": TrainingConfig(steps=600, data="leaves", validate_every=600),
    # Goes on from trained weights, and keeps seeing leaves so that it forgets nothing.
    "endoscope": TrainingConfig(steps=800, data="endoscope", learning_rate=5e-4, validate_every=400),
    # The same for a scene of one's own.
    "fine-tune": TrainingConfig(steps=800, data="mix", learning_rate=5e-4, validate_every=400),
}
# These go on from the shipped weights unless others are given.
_FINE_TUNING = ("endoscope", "fine-tune")


def choose_config(
    recipe: str,
    steps: int | None = None,
    data: str | None = None,
    seed: int = 0,
    shares: Mapping[str, float] | None = None,
) -> TrainingConfig:
    """The configuration of a recipe, with what was asked for instead of its own.

    Args:
        recipe: a key of `RECIPES`.
        steps, data: instead of the recipe's.
        seed: of everything.
        shares: of sources, instead of the recipe's data.
    Raises:
        InputError: the recipe, the data or a source are unknown, both are given, or there are no steps.
    """
    if recipe not in RECIPES:
        raise InputError(f"recipe {recipe!r} is unknown; choose one of {', '.join(RECIPES)}")
    config = replace(RECIPES[recipe], seed=seed)
    config = config if steps is None else replace(config, steps=steps)
    config = config if data is None else replace(config, data=data)
    if shares and data is not None:
        raise InputError(f"--data {data} and sources of one's own are given: leave one out")
    config = config if not shares else replace(config, shares=shares)
    check_config(config)
    return config


def check_config(config: TrainingConfig) -> None:
    """Refuses what cannot be trained, before long work starts.

    Raises:
        InputError: names the value and what is possible.
    """
    check_sources(turns_of(config.mix))
    for name in ("steps", "batch_size", "points", "checkpoint_every"):
        if getattr(config, name) < 1:
            raise InputError(f"{name} {getattr(config, name)} is too small: give 1 or more")
    if config.validate_every < 0:
        raise InputError(f"validate_every {config.validate_every} is negative: give steps, or 0 for never")
    if 8 * config.points > config.size**2:
        raise InputError(f"points {config.points} are too many for {config.size}x{config.size} pixels: give less")
    if config.size < 64 or config.size % 32:
        raise InputError(f"size {config.size} does not fit the network: give a multiple of 32 from 64 up")


def starting_weights(recipe: str, given: Path | None) -> Path | None:
    """The weights that a run goes on from; None: it starts from nothing."""
    if given is None and recipe in _FINE_TUNING:
        return shipped_weights("features.safetensors")
    return given
