"""`sigmaslam images triangulate` and `sigmaslam images orient`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.calibration import Size, read_sized
from sigmaslam.two_view.point_tables import orient_files, triangulate_file
from sigmaslam.two_view.triangulation import METHODS

# mypy reads the members of an enum from literals alone.
Method = StrEnum("Method", list(METHODS))  # type: ignore[misc]
"""Ways to triangulate."""


def triangulate(
    pixels: Annotated[
        Path,
        typer.Argument(
            metavar="PIXELS",
            help="CSV with the columns u0,v0,u1,v1 (left, right; pixels of the raw images) and, if wanted, id and "
            "sigma; or an .npz of `match`, left image first.",
        ),
    ],
    calibration: Annotated[Path, typer.Option(help="Calibration of the pair, in any form.")],
    out: Annotated[Path, typer.Option(help="CSV to write: id,x,y,z and covariance, in the left camera, metres.")],
    method: Annotated[
        Method,
        typer.Option(help="parallel (9.34, after rectification), midpoint, linear, or the least reprojection error."),
    ] = Method["optimal"],
    size: Size = None,
    sigma: Annotated[
        float, typer.Option(min=1e-6, help="Of a pixel coordinate, where the file does not say.", metavar="PX")
    ] = 0.5,
) -> None:
    """Points of a stereo pair from pixels in both images, each with its covariance."""
    typer.echo(triangulate_file(pixels, read_sized(calibration, size), out, method.value, sigma))


def orient(
    source: Annotated[Path, typer.Argument(metavar="SOURCE", help="CSV with the columns id,x,y,z, metres.")],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="The same control points in the other frame; a sigma if wanted.")
    ],
    out: Annotated[Path, typer.Option(help="JSON to write: T_target_source, scale, covariance, residuals.")],
    scale: Annotated[bool, typer.Option("--scale", help="Find a scale, too.")] = False,
    sigma: Annotated[
        float | None,
        typer.Option(min=1e-12, metavar="M", help="Of a target coordinate.", show_default="from the residuals"),
    ] = None,
) -> None:
    """Find how two frames lie to each other from points known in both (absolute orientation)."""
    typer.echo(orient_files(source, target, out, scale, sigma))
