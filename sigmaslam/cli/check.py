"""`sigmaslam check`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from sigmaslam.checks import Finding, check_sequence, has_errors
from sigmaslam.checks.finding import verdict
from sigmaslam.cli.options import Calibration, Format, Imu, Input, InputFormat, TopicLeft, TopicRight
from sigmaslam.runs.request import InputOptions

_STYLES = {"ok": "green", "unknown": "dim", "warning": "yellow", "error": "bold red"}


def check(
    source: Annotated[Path | None, Input] = None,
    format: Format = InputFormat["auto"],
    calibration: Calibration = None,
    camera: Annotated[
        str | None, typer.Option(metavar="LEFT,RIGHT", help="Live cameras in place of INPUT, as `track` takes them.")
    ] = None,
    topic_left: TopicLeft = None,
    topic_right: TopicRight = None,
    imu: Imu = None,
    out: Annotated[
        Path | None, typer.Option(metavar="PAGE.HTML", help="Page to write: the findings, and pairs with matches.")
    ] = None,
) -> None:
    """Check images, calibration and time stamps before they are trusted; seconds, from a few pairs.

    Finds exchanged, mirrored or unsynchronised eyes, rows that do not agree, a turned camera, a wrong calibration, dark
    or blurred images and wrong units; of an inertial sensor, by some seconds of tracking, units, axes, T_cam_imu and
    the clock. Exit code 1 where tracking would fail or be wrong.
    """
    options = InputOptions(
        source, format.value, calibration, camera=camera, topic_left=topic_left, topic_right=topic_right, imu=imu
    )
    sequence = options.open()
    result = check_sequence(sequence, track_imu=True)
    _print_table(result.findings)
    typer.echo(f"Verdict: {verdict(result.findings)[1]}.")
    if out is not None:
        from sigmaslam.report.check_page import write_page  # loads jinja2

        write_page(out, result, str(sequence.source))
        typer.echo(f"Page: {out}")
    if has_errors(result.findings):
        raise typer.Exit(1)


def _print_table(findings: list[Finding]) -> None:
    table = Table("check", "result", "what was seen")
    for each in findings:
        style = _STYLES[each.severity]
        table.add_row(each.name, f"[{style}]{each.severity}[/{style}]", each.message)
    Console(highlight=False).print(table)
