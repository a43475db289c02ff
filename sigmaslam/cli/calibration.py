"""`sigmaslam calibrate show` and `sigmaslam calibrate convert`."""

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.calibration_files.calibration import read_calibration
from sigmaslam.calibration_files.calibration_writer import describe_calibration
from sigmaslam.calibration_files.foreign_calibrations import FORMS, write_foreign_calibration
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera

# mypy reads the members of an enum from literals alone.
Form = StrEnum("Form", list(FORMS))  # type: ignore[misc]
"""Forms that can be written."""

Source = Annotated[
    Path,
    typer.Argument(
        metavar="FILE",
        help="Kalibr, OpenCV, ORB-SLAM, ROS, KITTI, EuRoC, ZED, OAK or 4Seasons file, our YAML, a folder with one, or "
        "two files as left.yaml,right.yaml.",
    ),
]
Size = Annotated[
    str | None,
    typer.Option("--size", metavar="WIDTHxHEIGHT", help="Of the images, for files that do not name it."),
]
Rectified = Annotated[
    bool,
    typer.Option("--rectified", help="The images are rectified: take the cameras of P (ROS and OpenCV have both)."),
]


def show(file: Source, size: Size = None, rectified: Rectified = False) -> None:
    """Print baseline, rotation, lens models and fields of view."""
    typer.echo(describe_calibration(read_sized(file, size, rectified)))


def convert(
    file: Source,
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="YAML file to write; kitti: a text file; ros and euroc: a folder.")
    ],
    to: Annotated[Form, typer.Option(help="Form to write; only our own keeps the covariance.")] = Form["own"],
    size: Size = None,
    rectified: Rectified = False,
) -> None:
    """Write a calibration of any form in another one, and print what is in it; what a form cannot say is refused."""
    camera = read_sized(file, size, rectified)
    write_foreign_calibration(out, camera, to.value)
    typer.echo(f"{describe_calibration(camera)}\nWritten: {out}")


def read_sized(file: Path, size: str | None, rectified: bool = False) -> StereoCamera:
    """A calibration of any form, with the size in words for those that lack it."""
    if size is None:
        return read_calibration(file, rectified=rectified)
    numbers = re.fullmatch(r"(\d{1,5})x(\d{1,5})", size)
    if numbers is None:
        raise InputError(f"--size is {size!r}: give width and height in pixels, as 752x480")
    return read_calibration(file, (int(numbers[1]), int(numbers[2])), rectified=rectified)
