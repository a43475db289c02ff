"""`sigmaslam localize`."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from sigmaslam.cli.extras import need_train_extra
from sigmaslam.errors import InputError
from sigmaslam.files import check_new_folder, make_folder


class RecordingFormat(StrEnum):
    """Kinds of recordings; auto tells by the files."""

    auto = "auto"
    mrclam = "mrclam"
    tubes = "tubes"
    csv = "csv"
    starry = "starry"


class FilterKind(StrEnum):
    """Filters to localise with."""

    ukf = "ukf"
    ekf = "ekf"
    iterated = "iterated"


def localize(
    path: Annotated[Path, typer.Argument(help="Folder (MRCLAM or CSV) or .mat file of a recording.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
    format: Annotated[RecordingFormat, typer.Option(help="Kind of recording.")] = RecordingFormat["auto"],
    robot: Annotated[int | None, typer.Option(help="Number of a robot.", show_default="all, as one batch")] = None,
    filter: Annotated[FilterKind, typer.Option(help="Unscented, extended or iterated unscented.")] = FilterKind["ukf"],
    start: Annotated[
        str | None,
        typer.Option(metavar="X,Y,HEADING", help="First pose: metres, radians.", show_default="that of the truth"),
    ] = None,
    max_range: Annotated[
        float | None, typer.Option(metavar="M", min=0.0, help="Leave out landmarks further away.")
    ] = None,
) -> None:
    """Localise robots, or a stereo camera, among known landmarks (needs the extra 'train').

    Writes trajectory.csv with covariance and belief, trajectory_first_pass.csv, innovations.csv, run.json, map.png and
    report.html. Noise, delay and systematic errors are found from the recording's innovations, not from its truth.
    """
    need_train_extra()
    from sigmaslam.localisation.formats import detect_format

    check_new_folder(out)
    first_pose = None if start is None else _parse_pose(start)
    if not path.exists():
        raise InputError(f"{path}: is not there: give the folder or the .mat file of a recording")
    kind = detect_format(path) if format is RecordingFormat.auto else format.value
    settings = {"source": str(path), "format": kind, "filter": filter.value, "max_range": max_range, "start": start}
    with Console(stderr=True).status("reading") as status:
        if kind == "starry":
            if robot is not None or first_pose is not None or max_range is not None:
                raise InputError("--robot, --start and --max-range are for robots in the plane: leave them out here")
            summaries = _localise_body(path, out, settings, status.update)
        else:
            summaries = _localise_robots(path, out, kind, robot, first_pose, max_range, settings, status.update)
    _print_summaries(summaries)
    typer.echo(f"Report: {out / 'report.html'}")


def _localise_robots(
    path: Path,
    out: Path,
    kind: str,
    robot: int | None,
    start: tuple[float, float, float] | None,
    max_range: float | None,
    settings: dict[str, Any],
    tell: Callable[[str], None],
) -> dict[str, dict[str, Any]]:
    from sigmaslam.localisation.formats import read_recordings
    from sigmaslam.localisation.output import write_robots
    from sigmaslam.localisation.robots import localise_robots

    recordings = read_recordings(path, kind, robot)
    if max_range is not None:
        recordings = [recording.within(max_range) for recording in recordings]
    first, second = localise_robots(recordings, settings["filter"], start, tell)
    make_folder(out)
    return write_robots(out, path.resolve().name, first, second, recordings[0].landmarks, settings)


def _localise_body(
    path: Path, out: Path, settings: dict[str, Any], tell: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    from sigmaslam.localisation.body import localise_body, write_body
    from sigmaslam.localisation.starry import read_starry

    recording = read_starry(path)
    first, second = localise_body(recording, settings["filter"], tell)
    make_folder(out)
    return write_body(out, recording, first, second, settings)


def _parse_pose(text: str) -> tuple[float, float, float]:
    try:
        x, y, heading = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--start {text}: is not X,Y,HEADING, such as 1.5,-0.2,3.14") from error
    return x, y, heading


_SHOWN = ("position_rmse", "heading_rmse", "rotation_rmse", "nees_median", "nees_mean", "nis_per_dof", "delay")


def _print_summaries(summaries: dict[str, dict[str, Any]]) -> None:
    shown = [label for label in _SHOWN if any(label in each for each in summaries.values())]
    table = Table("", *(label.replace("_", " ") for label in shown))
    for name, summary in summaries.items():
        table.add_row(name, *(_cell(summary.get(label)) for label in shown))
    Console(highlight=False).print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
