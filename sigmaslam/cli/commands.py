"""All commands under one name, and the entry point of the console script."""

from __future__ import annotations

import logging
import os
import sys
from importlib import import_module
from importlib.metadata import entry_points, version
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler

from sigmaslam.errors import SigmaSlamError
from sigmaslam.files import printable


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sigmaslam {version('sigmaslam')}")
        raise typer.Exit


def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Stereo visual SLAM: poses with an honest covariance and a sparse map, on a plain CPU."""


# Each with its module and a line for the list of commands, short enough for 80 columns.
_COMMANDS = (
    ("demo", "track", "Track the sequence that ships with the package."),
    ("check", "check", "Look at an input before it is tracked."),
    ("track", "track", "Track a stereo sequence, recorded or live."),
    ("finish", "finish", "Make the results of a run that was killed."),
    ("evaluate", "evaluate", "Compare a trajectory with the truth."),
    ("refine", "refine", "Adjust all of a run at once (extra 'graph')."),
    ("reconstruct", "reconstruct", "Make a dense cloud, and a mesh, of a run."),
    ("localize", "localize", "Localise robots among known landmarks (extra 'train')."),
    ("match", "match", "Match two images."),
    ("denoise", "denoise", "Filter noise out of images."),
    ("geometry", "geometry", "Find how two views lie to each other."),
    ("triangulate", "points", "Points of a stereo pair from pixels in both images."),
    ("orient", "points", "Find how two frames lie from points in both."),
    ("calibrate", "calibrate", "Calibrate one or two cameras from images of a board."),
    ("rectify", "rectify", "Write rectified pairs."),
    ("render", "render", "Render a stereo sequence with exact truth (extra 'train')."),
    ("train", "train", "Train the correspondence network (extra 'train')."),
    ("train-scorer", "train", "Train the probability of matches (extra 'train')."),
    ("export", "export", "Export trained weights to ONNX (extra 'train')."),
)
_GROUPS = (("calibration", "Show or convert a stereo calibration."),)


def build_app(chosen: str | None = None) -> typer.Typer:
    """All commands; of those that are not chosen nothing is loaded but their names. None: all are loaded."""
    # Plain help: rich's tables cut long words and give flags a type.
    app = typer.Typer(name="sigmaslam", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)
    app.callback()(_root)

    def load(name: str, module: str) -> Any:
        return getattr(import_module(f"sigmaslam.cli.{module}"), name.replace("-", "_"))

    for name, module, line in _COMMANDS:
        app.command(name, short_help=line)(load(name, module) if chosen in (None, name) else lambda: None)
    for name, line in _GROUPS:
        app.add_typer(load(name, name) if chosen in (None, name) else typer.Typer(name=name, help=line))
    # Commands of packages that are installed beside this one: `benchmark`, in a checkout.
    for entry in entry_points(group="sigmaslam.commands"):
        if chosen in (None, "", entry.name):
            app.add_typer(entry.load())
    return app


def __getattr__(name: str) -> typer.Typer:
    """`app`, whole."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return build_app()


def main() -> None:
    """Entry point of the console script.

    Exit codes: 1 on errors that `check` finds, 2 on bad input or output, 3 where too little was tracked, 130 on Ctrl-C.
    """
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=Console(stderr=True), show_time=False, show_path=False)],
    )
    # A shell that completes a line asks for options of any command.
    words = [word for word in sys.argv[1:] if not word.startswith("-")]
    try:
        build_app(None if "_SIGMASLAM_COMPLETE" in os.environ else "".join(words[:1]))()
    except SigmaSlamError as error:
        Console(stderr=True).print(
            f"error: {printable(str(error))}", style="red", highlight=False, markup=False, soft_wrap=True
        )
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
