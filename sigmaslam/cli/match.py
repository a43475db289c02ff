"""`sigmaslam images match`."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.track import Provider, Weights
from sigmaslam.frontend.image_pair import DETECTORS, match_files

# mypy reads the members of an enum from literals alone.
Detector = StrEnum("Detector", list(DETECTORS))  # type: ignore[misc]
"""What finds and describes keypoints in a single image."""


def match(
    image0: Annotated[Path, typer.Argument(metavar="IMAGE0", help="Image file, grey or colour, 8 or 16 bits.")],
    image1: Annotated[Path, typer.Argument(metavar="IMAGE1", help="Another view of the scene, of any size.")],
    out: Annotated[Path, typer.Option(help="File to write, ends in .npz.")],
    frontend: Annotated[Detector, typer.Option(help="What finds and describes keypoints.")] = Detector["learned"],
    max_keypoints: Annotated[int, typer.Option(help="Most keypoints an image, at least 4.")] = 1024,
    min_probability: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Matches less probable than this are left out; 0 keeps all mutual.")
    ] = 0.5,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to draw: both images, lines from purple (unlikely) to yellow (certain).")
    ] = None,
    provider: Annotated[
        Provider, typer.Option(help="Where ONNX Runtime computes the networks, if installed.")
    ] = Provider["cpu"],
    weights: Weights = None,
) -> None:
    """Match two images: which points show the same, how probably and how exactly; prints one line.

    Writes an .npz, best match first: keypoints0, keypoints1 (M, 2) pixels (u, v); probability (M,) that a match is
    right to 3 px; covariance (M, 2, 2) of keypoints1 given keypoints0; index0, index1 (M,). numpy.load reads it.
    """
    typer.echo(
        match_files(
            image0, image1, out, frontend.value, max_keypoints, min_probability, picture, provider.value, weights
        )
    )
