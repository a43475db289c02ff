"""`sigmaslam calibrate`: cameras from images of a board; a calibration shown, converted or used."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.calibration.board_images import find_board_images, read_board_views
from sigmaslam.calibration.boards import BOARD_FORMS, parse_board
from sigmaslam.calibration.calibrate import LENSES
from sigmaslam.calibration.calibrate import calibrate as solve
from sigmaslam.calibration.calibration_report import (
    describe_board_calibration,
    draw_board_calibration,
    write_board_calibration,
)
from sigmaslam.calibration.image_bootstrap import RESAMPLES, bootstrap_rigs, widened
from sigmaslam.calibration.imu_calibration import MAX_ROUNDS, calibrate_imu
from sigmaslam.calibration.imu_report import board_path, describe_imu_calibration, image_times, write_imu_calibration
from sigmaslam.calibration.lens_choice import USUAL_LENS, calibrate_whole_images
from sigmaslam.calibration.rectified_folder import write_rectified
from sigmaslam.calibration_files.calibration_writer import describe_calibration
from sigmaslam.calibration_files.foreign_calibrations import FORMS, write_foreign_calibration
from sigmaslam.checks.inertial import check_inertial
from sigmaslam.cli.extras import need_extra
from sigmaslam.cli.options import Calibration, Format, Input, InputFormat, Size, read_sized
from sigmaslam.errors import InputError
from sigmaslam.progress import counted
from sigmaslam.readers import open_sequence
from sigmaslam.readers.inertial import read_imu
from sigmaslam.runs.calibrate_imu import calibrate_imu_by_run

# mypy reads the members of an enum from literals alone.
Lens = StrEnum("Lens", ["auto", *LENSES])  # type: ignore[misc]
"""Lens models."""
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
Rectified = Annotated[
    bool,
    typer.Option("--rectified", help="The images are rectified: take the cameras of P (ROS and OpenCV have both)."),
]


def board(
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGES",
            help="Image files, or folders of images or folders; pairs where all names, of files or folders, tell the "
            "eye (left/right, cam0/cam1, image_0/image_1, infra1/infra2, _0/_1, L/R, ...); else of one camera. With "
            "--imu and without --board a run of `track`.",
        ),
    ],
    out: Annotated[Path, typer.Option(help="YAML file to write, which `track` reads; of one camera, its K and lens.")],
    board: Annotated[str | None, typer.Option(help=f"{BOARD_FORMS}; metres.")] = None,
    lens: Annotated[
        Lens,
        typer.Option(
            help="Lens model: radial-tangential with 4, 5 or 8 coefficients, or fisheye; auto: radtan5, or the best "
            "other one where that folds in the image."
        ),
    ] = Lens["auto"],
    picture: Annotated[Path | None, typer.Option(help="PNG to draw: corners, residuals, the rms of images.")] = None,
    imu: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV of an inertial sensor with its noise beside: also calibrate T_cam_imu and its clock's delay, "
            "into OUT-camchain-imucam.yaml, by a board before the moved rig, or by a run of `track --imu off`.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the resamples of images that sigmas are compared with.")] = 0,
) -> None:
    """Calibrate a stereo pair, or one camera, from images of a board, with the covariance of all parameters."""
    if out.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(f"{out}: a calibration is YAML; choose a name that ends in .yaml")
    if not out.parent.is_dir():
        raise InputError(f"{out}: there is no folder {out.parent}: create it, or choose another")
    recording = None if imu is None else read_imu(imu, is_mounted=False)
    if recording is not None and not recording.sensor.has_accelerometer:
        raise InputError(f"{imu}: a gyro alone says nothing of the lever arm: give the specific force, too")
    if recording is not None and (judged := check_inertial(recording, None)).severity == "error":
        raise InputError(judged.message)
    chain = out.with_name(f"{out.stem}-camchain-imucam.yaml")
    if board is None:
        if recording is None or len(images) != 1:
            raise InputError("--board is missing; only a run of `sigmaslam track`, with --imu, goes without it")
        with counted("inertial rounds", MAX_ROUNDS) as done:
            found, camera = calibrate_imu_by_run(images[0], recording, done)
        typer.echo(describe_imu_calibration(found))
        write_imu_calibration(chain, (camera.left, camera.right), camera.T_left_right, found)
        typer.echo(f"Written: {chain}")
        return
    if picture is not None:
        need_extra("report")
    plan = parse_board(board)
    moments = find_board_images(images)
    if recording is not None:
        image_times([each.name for each in moments])
    with counted("images", len(moments)) as done:
        seen = read_board_views(moments, plan, done)
    for name, reason in seen.unreadable:
        typer.echo(f"left out  {name}: {reason}")
    if lens.value == "auto":
        result = calibrate_whole_images(seen.names, seen.views, plan.points, seen.sizes)
        if len(result.rig.eyes[0].distortion) != LENSES[USUAL_LENS][1]:
            typer.echo(f"lens      not {USUAL_LENS}, which folds inside the images")
    else:
        result = solve(seen.names, seen.views, plan.points, seen.sizes, lens.value)
    describe_board_calibration(result)  # what makes no stereo pair says so before long work
    with counted("sigmas", RESAMPLES) as done:
        result = widened(result, bootstrap_rigs(result, RESAMPLES, seed, done))
    typer.echo(describe_board_calibration(result))
    write_board_calibration(out, result)
    if picture is not None:
        draw_board_calibration(picture, result)
        typer.echo(f"Picture: {picture}")
    typer.echo(f"Written: {out}")
    if recording is not None:
        with counted("inertial rounds", MAX_ROUNDS) as done:
            found = calibrate_imu(board_path(result), recording.samples, recording.sensor, done=done)
        typer.echo(describe_imu_calibration(found))
        write_imu_calibration(chain, result.rig.eyes, result.rig.T_left_right, found)
        typer.echo(f"Written: {chain}")


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


def rectify(
    source: Annotated[Path, Input],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
    format: Format = InputFormat["auto"],
    calibration: Calibration = None,
) -> None:
    """Write rectified pairs without distortion: left/, right/, times.txt, calibration.yaml."""
    sequence = open_sequence(source, format.value, calibration)
    with counted("pairs", sequence.length) as done:
        count = write_rectified(sequence, out, done)
    typer.echo(f"{count} rectified pairs in {out}\nTry: sigmaslam track {out} --out run")
