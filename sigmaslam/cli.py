"""The command line: parses, calls, prints. Exit code 2 on bad input."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.errors import InputError, SigmaSlamError

app = typer.Typer(
    name="sigmaslam",
    help="Stereo visual SLAM: poses with an honest covariance, a sparse map, on a plain CPU.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


@app.callback()
def _root() -> None:
    """Stereo visual SLAM: poses with an honest covariance, a sparse map, on a plain CPU."""


@app.command()
def train(
    out: Annotated[
        Path, typer.Option(help="Folder for the checkpoint, the log, the weights and their card.")
    ],
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps; about 3 a second on 2 cores.")] = 4500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of data, weights and sampling.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes that make training pairs.")] = 1,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train the correspondence network on procedural textures (needs the extra 'train')."""
    _need_train_extra()
    from sigmaslam.training.loop import TrainingConfig
    from sigmaslam.training.loop import train as run_training

    card = run_training(out, TrainingConfig(steps=steps, seed=seed), workers=workers, resume=resume)
    Console().print_json(data=card)


def _need_train_extra() -> None:
    try:
        import kornia  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[train]'") from error


def main() -> None:
    """Entry point of the console script."""
    try:
        app()
    except SigmaSlamError as error:
        Console(stderr=True).print(f"[bold red]error:[/] {error}", highlight=False, soft_wrap=True)
        sys.exit(2)
