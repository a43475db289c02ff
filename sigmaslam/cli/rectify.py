"""`sigmaslam calibrate rectify`."""

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.calibration.rectified_folder import write_rectified
from sigmaslam.cli.track import InputFormat
from sigmaslam.progress import open_progress
from sigmaslam.readers import open_sequence


def rectify(
    source: Annotated[Path, typer.Argument(metavar="INPUT", help="KITTI, EuRoC or plain folder, video or ROS bag.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
    format: Annotated[InputFormat, typer.Option(help="Kind of input.")] = InputFormat["auto"],
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of any form instead of the input's own.")
    ] = None,
) -> None:
    """Write rectified pairs without distortion: left/, right/, times.txt, calibration.yaml."""
    sequence = open_sequence(source, format.value, calibration)
    with open_progress() as progress:
        task = progress.add_task("pairs", total=sequence.length, note="")
        count = write_rectified(sequence, out, lambda done: progress.update(task, completed=done))
    typer.echo(f"{count} rectified pairs in {out}\nTry: sigmaslam track {out} --out run")
