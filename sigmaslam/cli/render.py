"""`sigmaslam render`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from sigmaslam.cli.extras import need_train_extra
from sigmaslam.progress import open_progress
from sigmaslam.synthetic.render_choices import MOTIONS, PRESET_NAMES, SENSOR_NAMES, TRUTHS

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
    width: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    height: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    truth: Annotated[
        Truth, typer.Option(help="dense: depth, flow, masks of every pixel; sparse: landmark tracks alone.")
    ] = Truth["dense"],
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one a core")] = None,
    ray: Annotated[bool, typer.Option("--ray", help="Spread the frames over a Ray cluster (extra 'scale').")] = False,
    device: Annotated[str, typer.Option(help="Where frames are drawn: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    """Render a stereo sequence with exact truth (needs the extra 'train').

    Writes a KITTI folder (drone and colon: EuRoC, unrectified), poses, truth/NNNNNN.npz, landmarks.npz, scene.json.
    """
    need_train_extra()
    from sigmaslam.synthetic.render_sequence import default_workers, write_sequence
    from sigmaslam.synthetic.simulation import Recipe

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
    )
    with open_progress() as progress:
        task = progress.add_task("making the world", total=frames, note="")

        def done(count: int) -> None:
            progress.update(task, completed=count, description="frames")

        before = write_sequence(out, recipe, truth.value, workers or default_workers(), device, ray, done)
    kept = f" ({before} were there)" if before else ""
    typer.echo(f"{frames} stereo pairs{kept} in {out}\nTry: sigmaslam track {out} --out run")
