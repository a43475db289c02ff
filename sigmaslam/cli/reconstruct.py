"""`sigmaslam reconstruct`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def reconstruct(
    run: Annotated[Path, typer.Argument(help="Run folder that `sigmaslam track` wrote.")],
    out: Annotated[Path, typer.Option(help="PLY file for the cloud.")],
    mesh: Annotated[Path | None, typer.Option(help="PLY file for a mesh, too (extra 'dense').")] = None,
    input: Annotated[
        Path | None, typer.Option(help="Where the run's input is now.", show_default="where the run found it")
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(
            help="ONNX file of a stereo network: two images (1, C, H, W), grey values 0 to 255, to a disparity.",
            show_default="semi-global matching",
        ),
    ] = None,
    voxel: Annotated[
        float | None,
        typer.Option(
            min=1e-6,
            help="Side of the voxels that points are merged in, metres.",
            show_default="5 pixels at the median",
        ),
    ] = None,
) -> None:
    """Reconstruct the surfaces that the keyframes of a run saw: a dense cloud in which each point has a covariance.

    Depths of each keyframe are fused with those of the keyframes around it; what these do not confirm, and what moves,
    is left out. The cloud is in the report of the run, too.
    """
    from sigmaslam.reconstruction.reconstruct import reconstruct_run

    summary = reconstruct_run(run, out, mesh, input, network, voxel)
    typer.echo(
        f"{summary.points} points of {summary.keyframes} keyframes in {out}, one per voxel of {summary.voxel:g} m, "
        f"sigma {summary.median_sigma:.2g} m in the median.\n"
        f"Disparities of {summary.measured:.0%} of the pixels, {summary.confirmed:.0%} of these confirmed by other "
        f"keyframes; {summary.seconds_a_keyframe:.2f} s a keyframe."
    )
    if mesh is not None:
        typer.echo(f"Mesh: {mesh}")
    typer.echo(f"Report: {run / 'report.html'}")
