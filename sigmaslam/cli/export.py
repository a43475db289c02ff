"""`sigmaslam train export`."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.cli.extras import need_train_extra
from sigmaslam.errors import InputError


def export(
    run: Annotated[Path | None, typer.Argument(help="Folder of a finished training run.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the graphs, the weights and their card.")] = None,
    scores: Annotated[
        Path | None, typer.Option(help="The .json of 'benchmark features' for these weights: into the card.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compare the graphs that ship with torch; without RUN.")
    ] = False,
    page: Annotated[
        Path | None, typer.Option(help="Write a page (Markdown, and CSV) of the graphs that ship; without RUN.")
    ] = None,
) -> None:
    """Export what a run made to ONNX and check the graphs against torch (needs the extra 'train').

    A run of 'train network' gives the features' graph, a run of 'train scorer' scorer and verifiers.
    """
    need_train_extra()
    if check or page is not None:
        if run is not None or out is not None:
            raise InputError("--check and --page are of the graphs that ship: leave out RUN and --out")
        _tell_of_shipped(check, page)
        return
    if run is None or out is None:
        raise InputError("give the folder of a run and --out, or --check, or --page")
    from sigmaslam_models.model_card import read_scores
    from sigmaslam_models.network_export import export_scoring
    from sigmaslam_models.onnx_export import export_run
    from sigmaslam_training.features.loop import WEIGHTS_NAME
    from sigmaslam_training.matching.scoring import SCORER_NAME
    from sigmaslam_training.run_card import CARD_NAME

    if (run / SCORER_NAME).is_file():
        if scores is not None:
            raise InputError(f"--scores is of features, {run} is a run of 'train scorer': leave it out")
        with Console(stderr=True).status("exporting three graphs"):
            differences = export_scoring(run, out)
        _tell_differences(differences)
        return
    on_real_sets = None if scores is None else read_scores(scores)
    with Console(stderr=True).status("exporting a graph"):
        differences = export_run(run / WEIGHTS_NAME, run / CARD_NAME, out, on_real_sets)
    _tell_differences(differences)


def _tell_of_shipped(check: bool, page: Path | None) -> None:
    from sigmaslam.files import atomic_write_text
    from sigmaslam.inference.onnx_graph import shipped_weights
    from sigmaslam_models.graph_page import PAGE_COMMAND, graph_page
    from sigmaslam_models.onnx_export import check_graphs

    folder = shipped_weights("features.onnx").parent
    if page is not None:
        for path, text in zip((page, page.with_suffix(".csv")), graph_page(folder, PAGE_COMMAND), strict=True):
            atomic_write_text(path, text)
    if check:
        _tell_differences(check_graphs(folder))


def _tell_differences(differences: dict[str, float]) -> None:
    for name, difference in differences.items():
        typer.echo(f"{name}.onnx differs from torch by {difference:.1e}")
