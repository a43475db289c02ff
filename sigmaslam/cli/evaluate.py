"""`sigmaslam evaluate`."""

import json
from pathlib import Path
from typing import Annotated, Literal

import typer

from sigmaslam.plot_style import NO_MATPLOTLIB, has_matplotlib


def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN_OR_TRAJECTORY", help="Run folder, or a TUM or KITTI file.")],
    truth: Annotated[
        Path, typer.Option(help="TUM, KITTI (with times.txt beside it) or EuRoC csv, or the recording's folder.")
    ],
    truth_kind: Annotated[
        Literal["gps", "mocap", "exact"] | None,
        typer.Option(help="What measured the truth: GPS/INS, motion capture, or nothing, as a render's is exact."),
    ] = None,
    truth_sigma_position: Annotated[
        float | None, typer.Option(metavar="M", min=0.0, help="Of each coordinate of the true positions, metres.")
    ] = None,
    truth_sigma_rotation: Annotated[
        float | None, typer.Option(metavar="DEG", min=0.0, help="Of the true rotations about each axis, degrees.")
    ] = None,
    truth_frame: Annotated[
        Literal["camera", "body"],
        typer.Option(help="Whose poses the truth has: of the camera (z ahead), or of a body with x ahead."),
    ] = "camera",
    truth_inverse: Annotated[bool, typer.Option("--truth-inverse", help="The truth is T_camera_world.")] = False,
    truth_quaternion: Annotated[
        Literal["xyzw", "wxyz"], typer.Option(help="Order of a TUM truth's quaternions.")
    ] = "xyzw",
    truth_unit: Annotated[Literal["m", "cm", "mm"], typer.Option(help="Of the true positions.")] = "m",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, KITTI t_rel and r_rel, NEES; draws evaluation.png.

    The picture needs the extra 'report'; the figures are the same without it.

    Poses of a run are also judged relative to earlier ones, 1, 10, 50, 100 m or 1, 5, 20 s back. Say how good the truth
    is with --truth-kind, or --truth-sigma-position and --truth-sigma-rotation: it counts in every NEES, and you see
    where it is no better than the estimate. What you do not say is guessed and printed.

    Where the truth would fit in another frame, order or unit, a line says so with the option that applies it; seconds,
    milli-, micro- and nanoseconds are found out. Between its poses the truth is interpolated.

    Of a run with --track-object the truth is T_camera_object of any frame that is fixed to the body.
    """
    from sigmaslam_evaluation.evaluation_summary import format_evaluation
    from sigmaslam_evaluation.run_evaluation import evaluate_run
    from sigmaslam_evaluation.truth_conventions import TruthConvention

    evaluation = evaluate_run(
        run,
        truth,
        truth_sigma_position=truth_sigma_position,
        truth_sigma_rotation=truth_sigma_rotation,
        truth_convention=TruthConvention(truth_frame, truth_inverse, truth_quaternion, truth_unit),
        truth_kind=truth_kind,
    )
    typer.echo(json.dumps(evaluation.to_dict(), indent=2) if as_json else format_evaluation(evaluation))
    if not has_matplotlib():
        typer.echo(f"No picture: {NO_MATPLOTLIB}", err=True)
