"""`sigmaslam export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.cli.extras import need_train_extra
from sigmaslam.errors import InputError


def export(
    run: Annotated[Path, typer.Argument(help="Folder of a finished training run.")],
    out: Annotated[Path, typer.Option(help="Folder for the graphs, the weights and their card.")],
    scores: Annotated[
        Path | None, typer.Option(help="The .json of 'benchmark features' for these weights: into the card.")
    ] = None,
) -> None:
    """Export what a run made to ONNX and check the graphs against torch (needs the extra 'train').

    A run of 'train' gives the features' graph and those of the tracker's estimator, a run of 'train-scorer' scorer and
    verifier.
    """
    need_train_extra()
    from sigmaslam.evaluation.matching import read_scores
    from sigmaslam.models.onnx_export import export_all, export_scoring
    from sigmaslam.training.features.loop import WEIGHTS_NAME
    from sigmaslam.training.matching.scoring import SCORER_NAME
    from sigmaslam.training.run_card import CARD_NAME

    if (run / SCORER_NAME).is_file():
        if scores is not None:
            raise InputError(f"--scores is of features, {run} is a run of train-scorer: leave it out")
        with Console(stderr=True).status("exporting three graphs"):
            differences = export_scoring(run, out)
        _tell_differences(differences)
        return

    on_real_sets = None if scores is None else read_scores(scores)
    with Console(stderr=True).status("exporting eight graphs (some minutes)"):
        differences = export_all(run / WEIGHTS_NAME, run / CARD_NAME, out, on_real_sets)
    _tell_differences(differences)


def _tell_differences(differences: dict[str, float]) -> None:
    for name, difference in differences.items():
        typer.echo(f"{name}.onnx differs from torch by {difference:.1e}")
