"""`sigmaslam report`."""

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.run_summary import tell_summary


def report(
    run: Annotated[Path, typer.Argument(help="Run folder of `sigmaslam track`.")],
) -> None:
    """Make report.html of a run anew; of one that was killed, or whose disk was full, all results that it lacks.

    Every pose until then is there. The map and the trajectory after the fact are lost: track again if you need them.
    Exit codes as of track.
    """
    from sigmaslam.report.report import write_report
    from sigmaslam.runs.finish import finish_run

    summary = finish_run(run)
    if summary is None:
        typer.echo(f"Report: {write_report(run)}")
    else:
        tell_summary(summary, run)
