"""`sigmaslam report`."""

from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.run_summary import tell_summary


def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Run folder of `sigmaslam track`, or up to six.")],
    out: Annotated[Path | None, typer.Option(help="Page; by default RUN/report.html, or comparison.html.")] = None,
) -> None:
    """Make report.html of a run anew, or one page that compares several runs.

    Of a run that was killed, or whose disk was full, all results are made that it lacks. Every pose until then is
    there. The map and the trajectory after the fact are lost: track again if you need them. Exit codes as of track.
    """
    from sigmaslam.report.report import write_report
    from sigmaslam.runs.finish import finish_run
    from sigmaslam_evaluation.comparison import write_comparison

    finished = [(run, finish_run(run)) for run in runs]
    if len(runs) > 1:
        typer.echo(f"Report: {write_comparison(runs, out or Path('comparison.html'))}")
    elif out is not None or finished[0][1] is None:
        typer.echo(f"Report: {write_report(runs[0], out)}")
    for run, summary in finished:
        if summary is not None:
            tell_summary(summary, run)
