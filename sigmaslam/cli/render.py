"""`sigmaslam train render`."""

import re
from dataclasses import replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.extras import RayAddress, need_train_extra
from sigmaslam.errors import InputError
from sigmaslam.progress import open_progress
from sigmaslam_synthetic.render_choices import MOTIONS, PRESET_NAMES, SENSOR_NAMES, TRUTHS

# mypy reads the members of an enum from literals alone.
RenderPreset = StrEnum("RenderPreset", PRESET_NAMES)  # type: ignore[misc]
"""Rendered worlds."""
Motion = StrEnum("Motion", MOTIONS)  # type: ignore[misc]
"""Ways of moving through a rendered world."""
SensorGrade = StrEnum("SensorGrade", SENSOR_NAMES)  # type: ignore[misc]
"""How good the rendered camera is."""
Truth = StrEnum("Truth", TRUTHS)  # type: ignore[misc]
"""How much truth is written beside rendered images."""


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
    need_train_extra()
    from sigmaslam_synthetic.render_sequence import default_workers, write_sequence, write_sequences
    from sigmaslam_synthetic.simulation import Recipe

    numbers = _seeds(seeds) if seeds is not None else range(0)
    if numbers and seed:
        raise InputError(f"--seed {seed} and --seeds {seeds} are both given: leave one out")
    recipe = Recipe(
        preset.value,
        frames,
        seed,
        motion.value,
        movers,
        sensor.value,
        disparity_offset,
        rotation_error,
        width,
        height,
        None if profile is None else str(profile),
        None if world is None else str(world.resolve()),
        imu,
    )
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
