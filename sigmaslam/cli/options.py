"""Options that several commands have."""

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.checks.calibration import check_calibration
from sigmaslam.checks.finding import wrong
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.inference.session import PROVIDERS
from sigmaslam.readers.open import FORMATS

# mypy reads the members of an enum from literals alone.
InputFormat = StrEnum("InputFormat", FORMATS)  # type: ignore[misc]
"""Kinds of input."""
Provider = StrEnum("Provider", list(PROVIDERS))  # type: ignore[misc]
"""Where ONNX Runtime computes the networks."""

Input = typer.Argument(metavar="INPUT", help="KITTI, EuRoC or plain folder, video or ROS bag.", show_default=False)
Format = Annotated[InputFormat, typer.Option(help="Kind of input.")]
Calibration = Annotated[
    Path | None,
    typer.Option(help="Calibration of any form, or two as left.yaml,right.yaml, instead of the input's own."),
]
TopicLeft = Annotated[
    str | None, typer.Option(help="Image topic in a bag.", show_default="the one with 'left', cam0 or infra1")
]
TopicRight = Annotated[
    str | None, typer.Option(help="Image topic in a bag.", show_default="the one with 'right', cam1 or infra2")
]
Imu = Annotated[
    str | None,
    typer.Option(
        metavar="FILE|TOPIC|off",
        help="Inertial sensor: CSV (time, rad/s, m/s^2) with its YAML beside, KITTI's oxts, or a bag's topic; off: "
        "use none.",
        show_default="the one in INPUT, if files say all of it",
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        help="Your own networks, as `sigmaslam train export` writes them; of those that it lacks, the ones that ship.",
        show_default="what ships",
    ),
]
Size = Annotated[
    str | None, typer.Option("--size", metavar="WIDTHxHEIGHT", help="Of the images, for files that do not name it.")
]


def read_sized(file: Path, size: str | None, rectified: bool = False) -> StereoCamera:
    """A calibration of any form, with the size in words for those that lack it; warns of lengths that no rig has."""
    numbers = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size or "")
    if size is not None and numbers is None:
        raise InputError(f"--size is {size!r}: give width and height in pixels, as 752x480")
    image_size = (int(numbers[1]), int(numbers[2])) if numbers is not None else None
    camera = read_calibration(file, image_size, rectified=rectified)
    for finding in wrong(check_calibration(camera)):
        typer.echo(f"warning: {file}: {finding.message}", err=True)
    return camera
