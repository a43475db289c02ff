"""`sigmaslam localize`."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import typer
from rich.console import Console
from rich.table import Table

from sigmaslam.cli.extras import need_extra
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text, check_new_folder, csv_text, make_folder

FilterKind = Literal["ukf", "ekf", "iterated"]
"""Filters to localise with."""
_Pose = tuple[float, float, float]
"""In the plane: metres, metres, radians."""
Knowledge = Literal["known", "unknown"]
"""Whether the places of the landmarks are known, or which of them a sighting is of."""


def localize(
    path: Annotated[Path, typer.Argument(help="Folder (MRCLAM or CSV) or .mat file of a recording.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
    format: Annotated[
        Literal["auto", "mrclam", "tubes", "csv", "starry"], typer.Option(help="Kind of recording; auto: by the files.")
    ] = "auto",
    robot: Annotated[int | None, typer.Option(help="Number of a robot.", show_default="all, as one batch")] = None,
    filter: Annotated[FilterKind, typer.Option(help="Unscented, extended or iterated unscented.")] = "ukf",
    map: Annotated[
        Knowledge, typer.Option(help="Places of the landmarks: as the recording has them, or to be found on the way.")
    ] = "known",
    association: Annotated[
        Knowledge, typer.Option(help="Landmark of each sighting: as the recording has it, or to be found.")
    ] = "known",
    compare: Annotated[
        bool, typer.Option("--compare", help="All filters one after the other, each in a folder of its name.")
    ] = False,
    start: Annotated[
        str | None,
        typer.Option(metavar="X,Y,HEADING", help="First pose: metres, radians.", show_default="that of the truth"),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Also write what is known when all was seen, and with a fixed lag.")
    ] = False,
    lag: Annotated[float, typer.Option(metavar="S", min=0.1, help="With --smooth: seconds of the fixed lag.")] = 5.0,
    max_range: Annotated[
        float | None, typer.Option(metavar="M", min=0.0, help="Leave out landmarks further away.")
    ] = None,
) -> None:
    """Localise robots, or a stereo camera, among known landmarks (needs the extra 'train').

    Writes trajectory.csv with covariance and belief, trajectory_first_pass.csv, innovations.csv, run.json, map.png and
    report.html; with --smooth trajectory_smoothed.csv and trajectory_lagged.csv as well.
    Noise, delay and systematic errors are found from the recording's innovations, not from its truth.
    With --map unknown the landmarks are found as well, and landmarks.csv is written (SLAM). With --association unknown
    nothing but the sightings themselves says which landmark they are of. With --compare there is such a folder for each
    filter, and comparison.csv with errors, consistency and time of all.
    """
    need_extra("train", "torch")
    from sigmaslam_filters import FilterError
    from sigmaslam_localisation.formats import detect_format

    check_new_folder(out)
    first_pose = None if start is None else _parse_pose(start)
    if not path.exists():
        raise InputError(f"{path}: is not there: give the folder or the .mat file of a recording")
    kind = detect_format(path) if format == "auto" else format
    if kind == "starry" and (robot is not None or first_pose is not None or max_range is not None):
        raise InputError("--robot, --start and --max-range are for robots in the plane: leave them out here")
    if kind == "starry" and "unknown" in (map, association):
        raise InputError("--map unknown and --association unknown are for robots in the plane: leave them out here")
    if smooth and map == "unknown":
        raise InputError("--smooth does not go with --map unknown: leave one of them out")
    settings = {"source": str(path), "format": kind, "max_range": max_range, "start": start, "map": map}
    settings |= {"association": association, "lag": lag if smooth else None}
    rows: list[_Row] = []
    with Console(stderr=True).status("reading") as status:
        for name in get_args(FilterKind) if compare else [filter]:
            folder, run = out / name if compare else out, {**settings, "filter": name}
            try:
                if kind == "starry":
                    summaries = _localise_body(path, folder, run, status.update)
                else:
                    summaries = _localise_robots(path, folder, run, status.update, robot, first_pose)
            except FilterError as error:
                raise InputError(f"{path}: the filter {name} cannot go on: {error}") from error
            rows += [(name, each, summary) for each, summary in summaries.items()]
    _print_rows(rows)
    if any(summary.get("nis_per_dof_median", 0.0) > _MOST_NIS for _, _, summary in rows):
        typer.echo("sightings contradict controls, start or map: are all in seconds, metres, radians, one world?")
    if compare:
        shown = _shown(rows)
        cells = ([name, each, *(summary.get(label, "") for label in shown)] for name, each, summary in rows)
        atomic_write_text(out / "comparison.csv", csv_text([["filter", "robot", *shown], *cells]))
        typer.echo(f"Comparison: {out / 'comparison.csv'}")
    else:
        typer.echo(f"Report: {out / 'report.html'}")


def _localise_robots(
    path: Path, out: Path, settings: dict[str, Any], tell: Callable[[str], None], robot: int | None, start: _Pose | None
) -> dict[str, dict[str, Any]]:
    from sigmaslam_localisation.association import associate
    from sigmaslam_localisation.formats import read_recordings
    from sigmaslam_localisation.output import write_robots
    from sigmaslam_localisation.robots import localise_robots

    mapping, associated = settings["map"] == "unknown", settings["association"] == "known"
    recordings = read_recordings(path, settings["format"], robot, mapping, associated)
    if settings["max_range"] is not None:
        recordings = [recording.within(settings["max_range"]) for recording in recordings]
    begin = time.process_time()
    if not associated:
        recordings = associate(recordings, settings["filter"], start, tell, mapping)
    first, second = localise_robots(recordings, settings["filter"], start, tell, mapping, settings["lag"])
    seconds = time.process_time() - begin
    make_folder(out)
    summaries = write_robots(out, path.resolve().name, first, second, recordings, settings)
    # The robots are one batch: each has the time of all.
    return {name: {**summary, "cpu_seconds": seconds} for name, summary in summaries.items()}


def _localise_body(
    path: Path, out: Path, settings: dict[str, Any], tell: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    from sigmaslam_localisation.body import localise_body, write_body
    from sigmaslam_localisation.starry import read_starry

    recording = read_starry(path)
    begin = time.process_time()
    first, second = localise_body(recording, settings["filter"], tell, settings["lag"])
    seconds = time.process_time() - begin
    make_folder(out)
    summaries = write_body(out, recording, first, second, settings)
    return {name: {**summary, "cpu_seconds": seconds} for name, summary in summaries.items()}


def _parse_pose(text: str) -> _Pose:
    try:
        x, y, heading = (float(part) for part in text.split(","))
        if not math.isfinite(x + y + heading):
            raise ValueError("not finite")
    except ValueError as error:
        raise InputError(f"--start {text}: is not X,Y,HEADING, such as 1.5,-0.2,3.14") from error
    return x, y, heading


# Noise is learned from the innovations, so theirs is one where models fit; of the median, as outliers decide a mean.
_MOST_NIS = 3.0
_Row = tuple[str, str, dict[str, Any]]
"""Filter, robot and summary."""
_ERRORS = ("position_rmse", "heading_rmse", "rotation_rmse", "nees_median", "nees_mean")
_SHOWN = (
    *_ERRORS,
    *(f"{kind}_{label}" for kind in ("smoothed", "lagged") for label in _ERRORS),
    "landmark_rmse",
    "landmark_rmse_aligned",
    "landmark_nees",
    "nis_per_dof",
    "delay",
    "cpu_seconds",
)


def _shown(rows: Sequence[_Row]) -> list[str]:
    return [label for label in _SHOWN if any(label in summary for _, _, summary in rows)]


def _print_rows(rows: Sequence[_Row]) -> None:
    """A table for each filter, with a column for each robot: five fit into 80 characters."""
    console = Console(highlight=False)
    for name in dict.fromkeys(each for each, _, _ in rows):
        robots = {robot: summary for each, robot, summary in rows if each == name}
        table = Table(name, *robots)
        for label in _shown(rows):
            table.add_row(label.replace("_", " "), *(_cell(summary.get(label)) for summary in robots.values()))
        console.print(table)


def _cell(value: Any) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
