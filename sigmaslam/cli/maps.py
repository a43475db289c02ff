"""`sigmaslam map show`, `sigmaslam map merge`."""

from pathlib import Path
from typing import Annotated

import typer

_FILE = "map.npz of a run of `sigmaslam track`, or its folder"


def show(maps: Annotated[list[Path], typer.Argument(metavar="MAP", help=f"{_FILE}; any number.")]) -> None:
    """Print what maps hold: keyframes, points, extent, front-end, camera."""
    from sigmaslam.slam.map_merging import MapFile

    typer.echo("\n\n".join(MapFile(path).describe() for path in maps))


def merge(
    one: Annotated[Path, typer.Argument(metavar="MAP", help=f"{_FILE}: the one whose world is kept.")],
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="Map of the same camera that overlaps with it.")],
    out: Annotated[Path, typer.Option(help="Map file, for `sigmaslam track --map`.")],
) -> None:
    """Make one map of two runs in one place.

    Keyframes of the second map are found in the first; two must lie to each other as their own map says. All of them
    hang at one keyframe of the first from then on, with its certainty.
    """
    from sigmaslam.files import save_arrays
    from sigmaslam.slam.map_merging import MapFile
    from sigmaslam.slam.map_merging import merge as merge_files

    save_arrays(out, **merge_files(MapFile(one), MapFile(other)))
    typer.echo(MapFile(out).describe())
