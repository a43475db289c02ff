"""`sigmaslam evaluate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN_OR_TRAJECTORY", help="Run folder, or a TUM or KITTI file.")],
    truth: Annotated[Path, typer.Option(help="Ground truth: TUM, KITTI (with times.txt beside it) or EuRoC csv.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, KITTI t_rel and r_rel, NEES; draws evaluation.png.

    Of a run with --track-object the truth is T_camera_object of any frame that is fixed to the body.
    """
    from sigmaslam.evaluation.run_evaluation import evaluate_run, format_evaluation

    evaluation = evaluate_run(run, truth)
    typer.echo(json.dumps(evaluation.to_dict(), indent=2) if as_json else format_evaluation(evaluation))
