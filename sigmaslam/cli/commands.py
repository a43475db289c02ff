"""All commands under one name, and the entry point of the console script."""

from __future__ import annotations

import logging
import sys
from importlib.metadata import entry_points, version
from typing import Annotated

import typer
from rich.console import Console
from rich.logging import RichHandler

from sigmaslam.cli.calibrate import calibrate
from sigmaslam.cli.calibration import calibration
from sigmaslam.cli.check import check
from sigmaslam.cli.denoise import denoise
from sigmaslam.cli.evaluate import evaluate
from sigmaslam.cli.export import export
from sigmaslam.cli.finish import finish
from sigmaslam.cli.geometry import geometry
from sigmaslam.cli.localize import localize
from sigmaslam.cli.match import match
from sigmaslam.cli.points import orient, triangulate
from sigmaslam.cli.reconstruct import reconstruct
from sigmaslam.cli.rectify import rectify
from sigmaslam.cli.refine import refine
from sigmaslam.cli.render import render
from sigmaslam.cli.track import demo, track
from sigmaslam.cli.train import train, train_scorer
from sigmaslam.errors import SigmaSlamError
from sigmaslam.files import printable

# Plain help: rich's tables cut long words and give flags a type.
app = typer.Typer(name="sigmaslam", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


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


# A line each for the list of commands, short enough for 80 columns.
for _command, _line in (
    (demo, "Track the sequence that ships with the package."),
    (check, "Look at an input before it is tracked."),
    (track, "Track a stereo sequence, recorded or live."),
    (finish, "Make the results of a run that was killed."),
    (evaluate, "Compare a trajectory with the truth."),
    (refine, "Adjust all of a run at once (extra 'graph')."),
    (reconstruct, "Make a dense cloud, and a mesh, of a run."),
    (localize, "Localise robots among known landmarks (extra 'train')."),
    (match, "Match two images."),
    (denoise, "Filter noise out of images."),
    (geometry, "Find how two views lie to each other."),
    (triangulate, "Points of a stereo pair from pixels in both images."),
    (orient, "Find how two frames lie from points in both."),
    (calibrate, "Calibrate one or two cameras from images of a board."),
    (rectify, "Write rectified pairs."),
    (render, "Render a stereo sequence with exact truth (extra 'train')."),
    (train, "Train the correspondence network (extra 'train')."),
    (train_scorer, "Train the probability of matches (extra 'train')."),
    (export, "Export trained weights to ONNX (extra 'train')."),
):
    app.command(short_help=_line)(_command)
app.add_typer(calibration)
# Commands of packages that are installed beside this one: `benchmark`, in a checkout.
for _entry in entry_points(group="sigmaslam.commands"):
    app.add_typer(_entry.load())


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
