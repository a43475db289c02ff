"""`sigmaslam train` and `sigmaslam train scorer`."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.extras import need_train_extra
from sigmaslam.files import printable
from sigmaslam_training.mixes import MIXES, RECIPE_NAMES

# mypy reads the members of an enum from literals alone.
Data = StrEnum("Data", list(MIXES))  # type: ignore[misc]
"""What training pairs are made of."""
TrainingRecipe = StrEnum("TrainingRecipe", RECIPE_NAMES)  # type: ignore[misc]
"""Training runs by name."""


def train(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, log, TensorBoard, samples, weights and card.")],
    recipe: Annotated[
        TrainingRecipe,
        typer.Option(
            help="full: an hour on 2 cores; quick: 7 minutes; endoscope, fine-tune: go on from the shipped weights, a "
            "quarter of an hour."
        ),
    ] = TrainingRecipe["full"],
    start: Annotated[
        Path | None,
        typer.Option("--from", help="Weights (.safetensors) to go on from.", show_default="the recipe's"),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps.", show_default="the recipe's")] = None,
    data: Annotated[Data | None, typer.Option(help="What pairs are made of.", show_default="the recipe's")] = None,
    worlds: Annotated[
        str | None,
        typer.Option(metavar="NAMES", help="Instead of --data: worlds and textures, as organ,leaves."),
    ] = None,
    world: Annotated[
        Path | None, typer.Option(metavar="FILE.py", help="A world of your own, as examples/my_world.py.")
    ] = None,
    textures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Photographs of your own, as planes seen from anywhere.")
    ] = None,
    mix: Annotated[
        str | None,
        typer.Option(
            metavar="SHARES",
            help="Of --worlds, --world and --textures, in this order, 1 together, as 0.4,0.6.",
            show_default="equal ones",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of data, weights and sampling.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes that make training pairs.")] = 1,
    device: Annotated[str, typer.Option(help="auto (a GPU if there is one), cpu, cuda, cuda:1.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train the correspondence network on renders (needs the extra 'train').

    Ctrl-C saves the last step; the same command with --resume goes on. On several GPUs: torchrun --nproc-per-node N
    -m sigmaslam train ...
    """
    need_train_extra()
    from sigmaslam_training.devices import leads
    from sigmaslam_training.features.loop import TrainingStopped
    from sigmaslam_training.features.loop import train as run_training
    from sigmaslam_training.features.recipes import choose_config, starting_weights
    from sigmaslam_training.sources import choose_shares

    shares = choose_shares(worlds, world, textures, mix)
    config = choose_config(recipe.value, steps, None if data is None else data.value, seed, shares)
    # The checkpoint of a resumed run names its starting weights.
    weights = start if resume else starting_weights(recipe.value, start)
    try:
        card = run_training(out, config, workers, resume, recipe.value, weights, device)
    except TrainingStopped as stop:
        if leads():
            _tell_stop(out, stop.saved, stop.steps)
        raise
    if leads():
        typer.echo(json.dumps(card, indent=2))


def _tell_stop(out: Path, saved: int, steps: int) -> None:
    """What a run that was stopped has left, and how to go on with it."""
    typer.echo(
        f"Stopped: {saved} of {steps} steps are saved in {printable(out)}; the same command with --resume goes on"
        if saved
        else f"Stopped: none of {steps} steps is saved; give the same command again",
        err=True,
    )


def train_scorer(
    out: Annotated[Path, typer.Option(help="Folder for pairs, checkpoint, weights and card; new, or left to go on.")],
    pairs: Annotated[int, typer.Option(min=16, help="Rendered pairs to learn from; a tenth more to calibrate on.")] = (
        2400
    ),
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps of the scorer, 8 sets of matches each.")] = 4000,
    verifier_steps: Annotated[int, typer.Option(min=1, help="Of the verifier, 4,096 matches each.")] = 6000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of pairs, weights and order.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render pairs.")] = 2,
) -> None:
    """Train what gives matches their probability and covariance, on renders alone (needs the extra 'train').

    On matches of the shipped features, SIFT and ORB: after training features of your own, export them first. Half an
    hour on 2 cores; stopped by Ctrl-C, the same command goes on.
    """
    need_train_extra()
    from sigmaslam_training.matching.scoring import ScoringConfig, train_scoring

    card = train_scoring(out, ScoringConfig(pairs, steps, verifier_steps, seed), workers)
    typer.echo(json.dumps(card, indent=2))
