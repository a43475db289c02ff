"""`sigmaslam map`: what can be made of a run."""

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

_FILE = "map.npz of a run of `sigmaslam track`, or its folder"


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
            help="Side of the finest voxels that points are merged in, metres; doubled up to a point's sigma.",
            show_default="2 pixels at the median",
        ),
    ] = None,
    max_sigma: Annotated[
        float | None,
        typer.Option(min=1e-6, help="Largest sigma of a point, metres.", show_default="a twentieth of its distance"),
    ] = None,
    min_views: Annotated[int | None, typer.Option(min=1, help="Views that a point needs.", show_default="2")] = None,
    every: Annotated[int, typer.Option(min=1, help="Use one of so many keyframes.")] = 1,
    export: Annotated[
        Path | None, typer.Option(help="New folder for images, poses and points as nerfstudio and COLMAP read them.")
    ] = None,
) -> None:
    """Reconstruct the surfaces that the keyframes of a run saw: a dense cloud in which each point has a covariance.

    Depths of each keyframe are fused with those of the keyframes around it; what these do not confirm, and what moves,
    is left out. The cloud is in the report of the run, too.
    """
    import cv2

    from sigmaslam.reconstruction.reconstruct import reconstruct_run

    # Views are measured in one thread and fused in another: more would wait for each other.
    cv2.setNumThreads(1)
    summary = reconstruct_run(run, out, mesh, input, network, voxel, max_sigma, min_views, every, export)
    typer.echo(
        f"{summary.points} points of {summary.keyframes} keyframes in {out}, voxels of {summary.voxel:g} m and more, "
        f"sigma {summary.median_sigma:.2g} m in the median.\n"
        f"Disparities of {summary.measured:.0%} of the pixels, {summary.confirmed:.0%} of these confirmed by other "
        f"keyframes; {summary.seconds_a_keyframe:.2f} s a keyframe."
    )
    if mesh is not None:
        typer.echo(f"Mesh: {mesh}")
    if export is not None:
        typer.echo(f"Images and poses: {export}")
    typer.echo(f"Report: {run / 'report.html'}")


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


def show(maps: Annotated[list[Path], typer.Argument(metavar="MAP", help=f"{_FILE}; any number.")]) -> None:
    """Print what maps hold: keyframes, points, extent, front-end, camera."""
    from sigmaslam.slam.map_merging import MapFile

    typer.echo("\n\n".join(MapFile(path).describe() for path in maps))


def merge(
    one: Annotated[Path, typer.Argument(metavar="MAP", help=f"{_FILE}: the one whose world is kept.")],
    other: Annotated[Path, typer.Argument(metavar="OTHER", help="Map of the same camera that overlaps with it.")],
    out: Annotated[Path, typer.Option(help="Map file, for `sigmaslam track --map`.")],
) -> None:
    """Make one map of two runs in one place.

    Keyframes of the second map are found in the first; two must lie to each other as their own map says. All of them
    hang at one keyframe of the first from then on, with its certainty.
    """
    from sigmaslam.files import save_arrays
    from sigmaslam.slam.map_merging import MapFile
    from sigmaslam.slam.map_merging import merge as merge_files

    save_arrays(out, **merge_files(MapFile(one), MapFile(other)))
    typer.echo(MapFile(out).describe())
