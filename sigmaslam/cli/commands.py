"""All commands under one name, read when one is asked for, and the entry point of the console script."""

import logging
import sys
from collections import UserDict
from importlib import import_module
from importlib.metadata import entry_points, version
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from typer.core import TyperGroup

from sigmaslam.cli.panels import PanelCommand
from sigmaslam.errors import SigmaSlamError

# A line each, short enough for 80 columns. The first ones are what a user needs to know; a group has its own table.
FIRST = {
    "demo": "Track the sequence that ships with the package.",
    "check": "Look at an input before it is tracked.",
    "track": "Track a stereo sequence, recorded or live.",
    "evaluate": "Compare a trajectory with the truth.",
    "report": "Make the report of a run anew, or compare several runs.",
    "calibrate": "Calibrate cameras; show, convert or use a calibration.",
}
GROUPS = {
    "sigmaslam": FIRST
    | {
        "images": "Match, measure and denoise single images.",
        "map": "Make more of a run: a dense cloud, an adjusted map.",
        "train": "Render sequences, train networks, export them (extra 'train').",
        "localize": "Localise robots among known landmarks (extra 'train').",
    },
    "calibrate": {
        "board": "The default: from images of a board, or an IMU by a run.",
        "show": "Print baseline, rotation, lens models and fields of view.",
        "convert": "Write a calibration of any form in another one.",
        "rectify": "Write rectified pairs.",
    },
    "images": {
        "match": "Match two images.",
        "geometry": "Find how two views lie to each other.",
        "triangulate": "Points of a stereo pair from pixels in both images.",
        "orient": "Find how two frames lie from points in both.",
        "denoise": "Filter noise out of images.",
    },
    "map": {
        "reconstruct": "Make a dense cloud, and a mesh, of a run.",
        "refine": "Adjust all of a run at once (extra 'graph').",
        "show": "Print what maps hold.",
        "merge": "Make one map of two runs in one place.",
    },
    "train": {
        "network": "The default: train the correspondence network.",
        "scorer": "Train the probability of matches.",
        "export": "Export trained weights to ONNX.",
        "render": "Render a stereo sequence with exact truth.",
    },
}
# What a group does whose first word is none of its commands.
DEFAULTS = {"calibrate": "board", "train": "network"}
# Names of the release before.
RENAMED = {
    "calibration": "calibrate",
    "rectify": "calibrate rectify",
    **{name: f"images {name}" for name in GROUPS["images"]},
    **{name: f"map {name}" for name in ("reconstruct", "refine")},
    "train-scorer": "train scorer",
    "export": "train export",
    "render": "train render",
    "finish": "report",
}


class _Commands(UserDict[str, Any]):
    """Commands of a group by name; the group's module, or the command's own, is imported when one is asked for."""

    group = ""

    def __getitem__(self, name: str) -> Any:
        found = self.data[name]
        if not isinstance(found, str):
            return found
        if name in GROUPS:
            return CommandGroup(name=name, help=found, no_args_is_help=True, rich_markup_mode=None)
        module = "track" if name == "demo" else name if self.group == "sigmaslam" else self.group
        # Plain help: rich's tables cut long words and give flags a type.
        alone = typer.Typer(add_completion=False, rich_markup_mode=None)
        function = getattr(import_module(f"sigmaslam.cli.{module}"), name)
        alone.command(name, cls=PanelCommand, short_help=found)(function)
        return typer.main.get_command(alone)


class CommandGroup(TyperGroup):
    """A group of `GROUPS`, with the names of the release before."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands: Any = _Commands(GROUPS[str(self.name)] | dict(self.commands))
        self.commands.group = str(self.name)

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """The command of the first words; those of the release before are understood, with a word on stderr."""
        name = str(self.name)
        if name == "sigmaslam" and args[0] in RENAMED:
            now = RENAMED[args[0]]
            typer.echo(f"`sigmaslam {args[0]}` is `sigmaslam {now}` now", err=True)
            args = [*now.split(), *args[1:]]
        elif name in DEFAULTS and args[0] not in self.commands:
            args = [DEFAULTS[name], *args]
        return super().resolve_command(ctx, args)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Options before a command's name are those of the group's own command."""
        if str(self.name) in DEFAULTS and args and args[0].startswith("-") and args[0] != "--help":
            args = [DEFAULTS[str(self.name)], *args]
        return super().parse_args(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """The list of commands, from the tables alone."""
        found = self.commands.data.items()
        lines = {name: each if isinstance(each, str) else each.get_short_help_str() for name, each in found}
        first = FIRST if self.name == "sigmaslam" else {}
        for title, names in (("First of all", first), ("Commands", lines.keys() - first.keys())):
            if names:
                with formatter.section(title):
                    formatter.write_dl([(name, line) for name, line in lines.items() if name in names])


app = typer.Typer(
    name="sigmaslam", cls=CommandGroup, no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False
)


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
        from sigmaslam.files import printable

        Console(stderr=True).print(
            f"error: {printable(str(error))}", style="red", highlight=False, markup=False, soft_wrap=True
        )
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
