"""`sigmaslam images geometry`."""

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.match import Detector
from sigmaslam.errors import InputError
from sigmaslam.two_view.image_geometry import describe_files


def geometry(
    image0: Annotated[Path, typer.Argument(metavar="IMAGE0", help="Image file, grey or colour, 8 or 16 bits.")],
    image1: Annotated[Path, typer.Argument(metavar="IMAGE1", help="Another view of the scene.")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Of the pair that took the images, in any form; without it the cameras are unknown."),
    ] = None,
    eyes: Annotated[
        str, typer.Option(metavar="EYE,EYE", help="With --calibration: which of its cameras took which image.")
    ] = "left,left",
    picture: Annotated[Path | None, typer.Option(help="PNG to draw: matches, and epipolar lines of a dozen.")] = None,
    frontend: Annotated[Detector, typer.Option(help="What finds and describes keypoints.")] = Detector["learned"],
    max_keypoints: Annotated[int, typer.Option(help="Most keypoints an image, at least 4.")] = 1024,
) -> None:
    """Find how two views lie to each other: rotation and direction with sigmas; without calibration the epipoles."""
    pair = eyes.split(",")
    if len(pair) != 2:
        raise InputError(f"--eyes is {eyes!r}: give two of left and right, as left,right")
    names = (pair[0].strip(), pair[1].strip())
    typer.echo(describe_files(image0, image1, calibration, names, picture, frontend.value, max_keypoints))
