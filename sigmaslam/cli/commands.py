"""All commands under one name, and the entry point of the console script."""

from __future__ import annotations

import logging
import sys
from importlib.metadata import version
from typing import Annotated

import typer
from rich.console import Console
from rich.logging import RichHandler

from sigmaslam.cli.benchmark import benchmark
from sigmaslam.cli.calibrate import calibrate
from sigmaslam.cli.calibration import calibration
from sigmaslam.cli.check import check
from sigmaslam.cli.evaluate import evaluate
from sigmaslam.cli.export import export
from sigmaslam.cli.finish import finish
from sigmaslam.cli.geometry import geometry
from sigmaslam.cli.match import match
from sigmaslam.cli.rectify import rectify
from sigmaslam.cli.refine import refine
from sigmaslam.cli.render import render
from sigmaslam.cli.track import demo, track
from sigmaslam.cli.train import train, train_scorer
from sigmaslam.errors import SigmaSlamError
from sigmaslam.files import printable

app = typer.Typer(name="sigmaslam", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sigmaslam {version('sigmaslam')}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Stereo visual SLAM: poses with an honest covariance and a sparse map, on a plain CPU."""


for _command in (
    demo,
    check,
    track,
    finish,
    match,
    geometry,
    calibrate,
    rectify,
    evaluate,
    refine,
    render,
    train,
    train_scorer,
    export,
    benchmark,
):
    app.command()(_command)
app.add_typer(calibration)


def main() -> None:
    """Entry point of the console script.

    Exit codes: 1 on errors that `check` finds, 2 on bad input or output, 3 where too little was tracked, 130 on Ctrl-C.
    """
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=Console(stderr=True), show_time=False, show_path=False)],
    )
    try:
        app()
    except SigmaSlamError as error:
        Console(stderr=True).print(
            f"error: {printable(str(error))}", style="red", highlight=False, markup=False, soft_wrap=True
        )
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
