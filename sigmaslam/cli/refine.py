"""`sigmaslam map refine`."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console


def refine(
    run: Annotated[Path, typer.Argument(help="Run folder that 'track --tracks' wrote.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
) -> None:
    """Adjust all keyframes, landmarks and the disparity offset of a run at once (needs the extra 'graph').

    The offline reference for the filter. Writes trajectory, covariance, map and refine.json; prints the latter.
    """
    from sigmaslam.bundle_adjustment import refine_run

    with Console(stderr=True).status("reading") as status:
        summary = refine_run(run, out, tell=status.update)
    typer.echo(json.dumps(summary, indent=2))
