"""`sigmaslam demo` and `sigmaslam track`."""

import logging
import tempfile
from contextlib import suppress
from dataclasses import fields, replace
from enum import StrEnum
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from sigmaslam.checks.check import SAMPLES_BEFORE_TRACKING, check_sequence
from sigmaslam.checks.finding import Finding, wrong
from sigmaslam.cli.extras import need_extra
from sigmaslam.cli.options import Calibration, Format, Imu, Input, InputFormat, Provider, TopicLeft, TopicRight, Weights
from sigmaslam.cli.panels import HelpAll
from sigmaslam.cli.run_summary import tell_summary
from sigmaslam.cli.track_sinks import open_sinks
from sigmaslam.errors import InputError
from sigmaslam.files import check_new_folder, printable
from sigmaslam.frontend import FRONTENDS
from sigmaslam.frontend.build import own_networks
from sigmaslam.inference.backends import backend_names
from sigmaslam.inference.session import check_provider
from sigmaslam.plot_style import NO_MATPLOTLIB
from sigmaslam.readers import StereoSequence
from sigmaslam.runs.request import InputOptions, LiveOptions, OutputOptions, TrackerOptions, TrackRequest

if TYPE_CHECKING:
    from sigmaslam.slam.config import TrackerConfig

logger = logging.getLogger(__name__)

_Part = TypeVar("_Part", InputOptions, OutputOptions, TrackerOptions, LiveOptions)

# mypy reads the members of an enum from literals alone.
Frontend = StrEnum("Frontend", FRONTENDS)  # type: ignore[misc]
"""Where correspondences come from."""
Backend = StrEnum("Backend", backend_names())  # type: ignore[misc]
"""What runs the network and the filter."""


def demo(
    out: Annotated[
        Path | None, typer.Option(help="Run folder, new or empty.", show_default="a new temporary folder")
    ] = None,
    frontend: Annotated[Frontend, typer.Option(help="Where correspondences come from.")] = Frontend["learned"],
) -> None:
    """Track the rendered sequence that ships with the package and print the errors against its exact truth."""
    from sigmaslam_evaluation.evaluation_summary import format_evaluation
    from sigmaslam_evaluation.run_evaluation import evaluate_run

    folder = out or Path(tempfile.mkdtemp(prefix="sigmaslam-demo-"))
    with as_file(files("sigmaslam_synthetic") / "demo") as sequence:
        _track(TrackRequest(InputOptions(sequence, "kitti"), OutputOptions(folder), TrackerOptions(frontend.value)))
        evaluation = evaluate_run(folder, sequence / "poses.txt")
    picture = f"Picture: {evaluation.figure_path}" if evaluation.figure_path else f"No picture: {NO_MATPLOTLIB}"
    typer.echo(f"{format_evaluation(evaluation)}\nReport: {folder / 'report.html'}\n{picture}")


def track(
    out: Annotated[Path, typer.Option(help="Run folder, new or empty.")],
    source: Annotated[Path | None, Input] = None,
    format: Format = InputFormat["auto"],
    calibration: Calibration = None,
    frontend: Annotated[
        Frontend, typer.Option(metavar="NAME", help=f"Where correspondences come from: {', '.join(FRONTENDS)}.")
    ] = Frontend["learned"],
    backend: Annotated[
        Backend,
        typer.Option(help="What runs network and filter; torch needs 'train'."),
    ] = Backend["onnx"],
    provider: Annotated[
        Provider, typer.Option(help="Where ONNX Runtime computes the networks, if installed; the filter: on the CPU.")
    ] = Provider["cpu"],
    weights: Weights = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML of tracker settings, `name: value` (names: sigmaslam.TrackerConfig).")
    ] = None,
    estimate: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Errors of the calibration to estimate beside the disparity offset, as far as images tell them from "
            "motion, for example yaw,pitch,focal.",
        ),
    ] = None,
    map: Annotated[
        Path | None,
        typer.Option(help="Earlier run, or its map.npz, of the same camera and front-end: poses are in its world."),
    ] = None,
    tracks: Annotated[
        bool, typer.Option("--tracks", help="Also write tracks.npz, what keyframes saw, for `sigmaslam map refine`.")
    ] = False,
    save_calibration: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Also write a calibration without the disparity offset that the run found, with its sigma: the next "
            "run starts from it by --calibration FILE.",
        ),
    ] = None,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="LEFT,RIGHT",
            help="Live cameras in place of INPUT: numbers, paths or URLs; side-by-side:0 gives both eyes.",
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="With --camera: stop after so long. Ctrl-C stops as well.")
    ] = None,
    topic_left: TopicLeft = None,
    topic_right: TopicRight = None,
    track_object: Annotated[
        str | None,
        typer.Option(
            metavar="MASK|BOX",
            help="Follow one rigid body, the camera at rest: x,y,width,height in the first left image, or an image "
            "that is not zero on the body; poses are T_camera_object.",
        ),
    ] = None,
    location: Annotated[
        Path | None,
        typer.Option(
            help="CSV of a location sensor on what moves, to fuse, with columns timestamp, x, y, z, "
            "sigma_position and, with rotations, qx, qy, qz, qw, sigma_rotation; any rate, any world."
        ),
    ] = None,
    realtime: Annotated[
        bool,
        typer.Option(
            "--realtime",
            help="Play a recording at its time stamps, as a camera would: always the newest frame is tracked, those "
            "that come meanwhile are dropped. Cameras always do.",
        ),
    ] = False,
    mask: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE|FOLDER",
            help="Image, or a folder with one named as each left image: where it is black (0) nothing is used.",
        ),
    ] = None,
    imu: Imu = None,
    odometry: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV of wheels: timestamp, speed, yaw_rate (m/s, rad/s), or vx, vy, vz, wx, wy, wz; T_cam_base in the "
            "YAML beside.",
        ),
    ] = None,
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Filter noise out of the images first: for the dark; slow.")
    ] = False,
    threads: Annotated[int, typer.Option(min=1, help="Threads of the network and of OpenCV.")] = 2,
    strict: Annotated[
        bool, typer.Option("--strict", help="Do not track where the check of the first frames warns of something.")
    ] = False,
    start: Annotated[int, typer.Option(min=0, help="Number of the first pair to track, from 0 on.")] = 0,
    frames: Annotated[int | None, typer.Option(min=1, help="Track at most so many pairs.")] = None,
    every: Annotated[int, typer.Option(min=1, help="Track one of so many pairs.")] = 1,
    scale: Annotated[
        float, typer.Option(min=0.05, max=1.0, help="Shrink images to this share of their width and height.")
    ] = 1.0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Remove the run that is in the folder, if nothing else is in it.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the run in the folder, of the same input, that was stopped.")
    ] = False,
    stream: Annotated[
        str | None,
        typer.Option(
            metavar="TARGET", help="Give out each pose when it is known, as a line of JSON: stdout, or udp://HOST:PORT."
        ),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(help="Also write an .mp4 of the left images with their tracks, and the path from above."),
    ] = None,
    viewer: Annotated[
        str | None,
        typer.Option(
            metavar="TARGET",
            help="Show the run in Rerun (extra 'viewer'): rerun for a window, rerun:FILE.rrd to write it, or the URL "
            "of a viewer, rerun+http://HOST:9876/proxy.",
        ),
    ] = None,
    serve: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:]PORT", help="Show the run on a web page, read-only; for this machine alone without a HOST."
        ),
    ] = None,
    dense: Annotated[
        Path | None,
        typer.Option(metavar="FILE.ply", help="Also make the cloud of `map reconstruct` while the run goes on."),
    ] = None,
    help_all: HelpAll = False,
) -> None:
    """Track a stereo sequence, recorded or live: trajectory, covariance, map and report.

    Ctrl-C, SIGTERM and SIGHUP end it with what was tracked until then (exit codes 130, 143, 129). After a kill -9
    `sigmaslam report` makes the results, and --resume goes on. Exit code 3: less than half of the frames were tracked.
    2: the input cannot be used, or a result not be written.
    """
    request = _read_request(locals())
    if request.tracker.backend == "torch":
        need_extra("train")
    check_provider(request.tracker.provider, request.tracker.backend)
    own_networks(request.tracker.frontend, weights, request.tracker.backend)
    sequence = request.input.open()
    if not (overwrite or resume):
        check_new_folder(out, "--out, give --overwrite or --resume")
    opened = InputOptions(sequence, findings=_check(sequence, strict, threads))
    with open_sinks(request.live, out, sequence.camera) as sinks:
        tell_summary(_track(replace(request, input=opened, live=LiveOptions(sinks=sinks))), out)


def _read_request(options: dict[str, Any]) -> TrackRequest:
    """The request of a command line, whose options have the names of the fields."""
    from sigmaslam.fusion.readings import read_locations

    options = {name: each.value if isinstance(each, StrEnum) else each for name, each in options.items()}
    options["config"] = _read_settings(options["config"], options["estimate"], options["track_object"] is not None)
    if options["location"] is not None:
        options["location"] = read_locations(options["location"])

    def build(part: type[_Part]) -> _Part:
        return part(**{each.name: options[each.name] for each in fields(part) if each.name in options})

    return TrackRequest(build(InputOptions), build(OutputOptions), build(TrackerOptions), build(LiveOptions))


def _read_settings(path: Path | None, estimate: str | None, track_object: bool) -> "TrackerConfig | None":
    """Settings of a file and of the command line; None where neither says anything."""
    from sigmaslam.bodies.object_tracker import OBJECT_CONFIG
    from sigmaslam.slam.config import TrackerConfig, check_estimated, read_config

    if path is None and estimate is None:
        return None
    settings = OBJECT_CONFIG if track_object else TrackerConfig()
    if path is not None:
        settings = read_config(path, settings)
    if estimate is not None:
        settings = replace(settings, estimate=check_estimated("--estimate", estimate.split(",")))
    return settings


def _track(request: TrackRequest) -> dict[str, Any]:
    import cv2

    from sigmaslam.runs.stop_signals import Stopped
    from sigmaslam.runs.track import track_sequence

    cv2.setNumThreads(request.tracker.threads)
    try:
        return track_sequence(request)
    except Stopped as stop:
        with suppress(OSError):  # the terminal may be gone
            typer.echo(f"Stopped; what was tracked until then is in {printable(request.outputs.out)}")
        raise typer.Exit(stop.exit_code) from stop


def _check(sequence: StereoSequence, strict: bool, threads: int) -> list[Finding]:
    """Findings about the first frames; those that are not good are warned of, and refused with `strict`.

    What is wrong with rows is corrected.
    """
    import cv2

    cv2.setNumThreads(threads)
    check = check_sequence(sequence, SAMPLES_BEFORE_TRACKING, threads)
    faults = wrong(check.findings)
    if strict and faults:
        raise InputError(f"{sequence.source}: " + "; ".join(each.message for each in faults))
    for each in faults:
        logger.warning("%s: %s", each.name, each.message)
    sequence.camera = check.camera
    return check.findings
