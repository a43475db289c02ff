"""`sigmaslam finish`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.run_summary import tell_summary


def finish(
    run: Annotated[Path, typer.Argument(help="Run folder of a `sigmaslam track` that was killed.")],
) -> None:
    """Write trajectory, covariance and report of a run that was killed, or whose disk was full.

    Every pose until then is there. The map and the trajectory after the fact are lost: track again if you need them.
    Exit codes as of track.
    """
    from sigmaslam.runs.finish import finish_run

    summary = finish_run(run)
    if summary is None:
        typer.echo(f"{run} is finished: there is nothing to do.")
    else:
        tell_summary(summary, run)
