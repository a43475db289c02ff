"""`sigmaslam train`: networks trained and exported, and the renders that they learn from."""

import json
import re
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.cli.extras import RayAddress, need_extra
from sigmaslam.errors import InputError
from sigmaslam.files import printable
from sigmaslam.progress import open_progress
from sigmaslam_synthetic.render_choices import MOTIONS, PRESET_NAMES, SENSOR_NAMES, TRUTHS
from sigmaslam_training.mixes import MIXES, RECIPE_NAMES

# mypy reads the members of an enum from literals alone.
Data = StrEnum("Data", list(MIXES))  # type: ignore[misc]
"""What training pairs are made of."""
TrainingRecipe = StrEnum("TrainingRecipe", RECIPE_NAMES)  # type: ignore[misc]
"""Training runs by name."""
RenderPreset = StrEnum("RenderPreset", PRESET_NAMES)  # type: ignore[misc]
"""Rendered worlds."""
Motion = StrEnum("Motion", MOTIONS)  # type: ignore[misc]
"""Ways of moving through a rendered world."""
SensorGrade = StrEnum("SensorGrade", SENSOR_NAMES)  # type: ignore[misc]
"""How good the rendered camera is."""
Truth = StrEnum("Truth", TRUTHS)  # type: ignore[misc]
"""How much truth is written beside rendered images."""


def network(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, log, TensorBoard, samples, weights and card.")],
    recipe: Annotated[
        TrainingRecipe,
        typer.Option(
            help="full: an hour on 2 cores; quick: 7 minutes; endoscope, fine-tune: go on from the shipped weights, a "
            "quarter of an hour."
        ),
    ] = TrainingRecipe["full"],
    start: Annotated[
        Path | None, typer.Option("--from", help="Weights (.safetensors) to go on from.", show_default="the recipe's")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps.", show_default="the recipe's")] = None,
    data: Annotated[Data | None, typer.Option(help="What pairs are made of.", show_default="the recipe's")] = None,
    worlds: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Instead of --data: worlds and textures, as organ,leaves.")
    ] = None,
    world: Annotated[
        Path | None, typer.Option(metavar="FILE.py", help="A world of your own, as examples/my_world.py.")
    ] = None,
    textures: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="Photographs of your own, as planes seen from anywhere.")
    ] = None,
    mix: Annotated[
        str | None,
        typer.Option(
            metavar="SHARES",
            help="Of --worlds, --world and --textures, in this order, 1 together, as 0.4,0.6.",
            show_default="equal ones",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of data, weights and sampling.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes that make training pairs.")] = 1,
    device: Annotated[str, typer.Option(help="auto (a GPU if there is one), cpu, cuda, cuda:1.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train the correspondence network on renders (needs the extra 'train').

    Ctrl-C saves the last step; the same command with --resume goes on. On several GPUs: torchrun --nproc-per-node N
    -m sigmaslam train ...
    """
    need_extra("train")
    from sigmaslam_training.devices import leads
    from sigmaslam_training.features.loop import TrainingStopped
    from sigmaslam_training.features.loop import train as run_training
    from sigmaslam_training.features.recipes import choose_config, starting_weights
    from sigmaslam_training.sources import choose_shares

    shares = choose_shares(worlds, world, textures, mix)
    config = choose_config(recipe.value, steps, None if data is None else data.value, seed, shares)
    # The checkpoint of a resumed run names its starting weights.
    weights = start if resume else starting_weights(recipe.value, start)
    try:
        card = run_training(out, config, workers, resume, recipe.value, weights, device)
    except TrainingStopped as stop:
        if leads():
            mend = "the same command with --resume goes on" if stop.saved else "give the same command again"
            typer.echo(f"Stopped: {stop.saved} of {stop.steps} steps are saved in {printable(out)}; {mend}", err=True)
        raise
    if leads():
        typer.echo(json.dumps(card, indent=2))
        typer.echo(f"Next: sigmaslam train export {printable(out)} --out graphs, for track --weights graphs", err=True)


def scorer(
    out: Annotated[Path, typer.Option(help="Folder for pairs, checkpoint, weights and card; new, or left to go on.")],
    pairs: Annotated[int, typer.Option(min=16, help="Rendered pairs to learn from; a tenth more to calibrate on.")] = (
        2400
    ),
    steps: Annotated[int, typer.Option(min=1, help="Optimiser steps of the scorer, 8 sets of matches each.")] = 4000,
    verifier_steps: Annotated[int, typer.Option(min=1, help="Of the verifier, 4,096 matches each.")] = 6000,
    seed: Annotated[int, typer.Option(min=0, help="Seed of pairs, weights and order.")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="Processes that render pairs.")] = 2,
) -> None:
    """Train what gives matches their probability and covariance, on renders alone (needs the extra 'train').

    On matches of the shipped features, SIFT and ORB: after training features of your own, export them first. Half an
    hour on 2 cores; stopped by Ctrl-C, the same command goes on.
    """
    need_extra("train")
    from sigmaslam_training.matching.scoring import ScoringConfig, train_scoring

    card = train_scoring(out, ScoringConfig(pairs, steps, verifier_steps, seed), workers)
    typer.echo(json.dumps(card, indent=2))


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
    need_extra("train")
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

    is_scorer = (run / SCORER_NAME).is_file()
    if is_scorer and scores is not None:
        raise InputError(f"--scores is of features, {run} is a run of 'train scorer': leave it out")
    with Console(stderr=True).status("exporting"):
        if is_scorer:
            differences = export_scoring(run, out)
        else:
            on_real_sets = None if scores is None else read_scores(scores)
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


def render(
    preset: Annotated[RenderPreset, typer.Argument(help="What world, and its stereo camera.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty, or left from the same command to go on with.")],
    frames: Annotated[int, typer.Option(min=1, help="Number of stereo pairs.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of world, path, cameras and noise.")] = 0,
    seeds: Annotated[
        str | None,
        typer.Option(metavar="FIRST-LAST", help="A sequence of each seed instead, in OUT/<preset><seed>: 100-109."),
    ] = None,
    motion: Annotated[Motion, typer.Option(help="How the camera moves; in 'tool' the tool.")] = Motion["normal"],
    movers: Annotated[
        float, typer.Option(min=0.0, max=0.5, help="Share of the image that moves on its own, 0 to 0.5.")
    ] = 0.0,
    sensor: Annotated[SensorGrade, typer.Option(help="Blur, noise, exposure and compression.")] = SensorGrade["normal"],
    disparity_offset: Annotated[
        float, typer.Option(help="Pixels by which disparities exceed what the written calibration says.")
    ] = 0.0,
    rotation_error: Annotated[
        float, typer.Option(help="Degrees by which the right camera is turned against its calibration.")
    ] = 0.0,
    profile: Annotated[
        Path | None, typer.Option(help="street: KITTI poses file whose motion the drive follows.")
    ] = None,
    world: Annotated[
        Path | None,
        typer.Option(metavar="FILE.py", help="A world of your own, as examples/my_world.py, by the preset's camera."),
    ] = None,
    imu: Annotated[
        float | None,
        typer.Option(
            metavar="RATE", help="Add an inertial sensor with so many samples a second, as 200, and its truth."
        ),
    ] = None,
    width: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    height: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    truth: Annotated[
        Truth, typer.Option(help="dense: depth, flow, masks of every pixel; sparse: landmark tracks alone.")
    ] = Truth["dense"],
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one a core")] = None,
    ray: RayAddress = None,
    device: Annotated[str, typer.Option(help="Where frames are drawn: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    """Render a stereo sequence, or many, with exact truth (needs the extra 'train').

    Writes a KITTI folder (drone and colon: EuRoC, unrectified), poses, truth/NNNNNN.npz, landmarks.npz, scene.json;
    with --imu imu0/data.csv with its YAML and truth.npz, where `track` finds it.
    """
    need_extra("train")
    from sigmaslam_synthetic.render_sequence import default_workers, write_sequence, write_sequences
    from sigmaslam_synthetic.simulation import Recipe
    from sigmaslam_training.devices import choose_device

    choose_device(device)
    numbers = _seeds(seeds) if seeds is not None else range(0)
    if numbers and seed:
        raise InputError(f"--seed {seed} and --seeds {seeds} are both given: leave one out")
    camera = motion.value, movers, sensor.value, disparity_offset, rotation_error, width, height
    files = None if profile is None else str(profile), None if world is None else str(world.resolve())
    recipe = Recipe(preset.value, frames, seed, *camera, *files, imu)
    workers = workers or default_workers()
    with open_progress() as progress:
        task = progress.add_task("making the world", total=len(numbers) or frames, note="")

        def done(count: int) -> None:
            progress.update(task, completed=count, description="sequences" if numbers else "frames")

        if numbers:
            recipes = [replace(recipe, seed=number) for number in numbers]
            write_sequences(out, recipes, truth.value, workers, device, ray, done)
            made, first = f"{len(numbers)} sequences of {frames} stereo pairs", out / recipes[0].name
        else:
            before = write_sequence(out, recipe, truth.value, workers, device, ray, done)
            kept = f" ({before} were there)" if before else ""
            made, first = f"{frames} stereo pairs{kept}", out
    typer.echo(f"{made} in {out}\nTry: sigmaslam track {first} --out run")


def _seeds(text: str) -> range:
    """FIRST-LAST, both included."""
    found = re.fullmatch(r"(\d+)-(\d+)", text)
    if found is None or int(found[1]) > int(found[2]):
        raise InputError(f"--seeds {text!r} is no range of seeds: give the first and the last one, as 100-109")
    return range(int(found[1]), int(found[2]) + 1)
