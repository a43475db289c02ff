"""`sigmaslam benchmark`: a command for each benchmark, which writes its page."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.cli.extras import RayAddress, need_report_extra, need_train_extra
from sigmaslam.errors import InputError
from sigmaslam.source_commit import describe_source

benchmark = typer.Typer(name="benchmark", no_args_is_help=True, help="Run a benchmark and write its page.")

Out = Annotated[
    Path, typer.Option("--out", help="Markdown page to write; notes below '<!-- notes -->' in it are kept.")
]
Data = Annotated[
    Path | None, typer.Option("--data", envvar="SIGMASLAM_DATA", help="Folder of the real data sets (needed).")
]
DataIfAny = Annotated[
    Path | None,
    typer.Option("--data", envvar="SIGMASLAM_DATA", help="Folder of the real data sets; without it: renders alone."),
]
Runs = Annotated[Path, typer.Option("--runs", help="Folder for renders and results; what is there is used again.")]
RunsIfAny = Annotated[
    Path | None,
    typer.Option("--runs", help="Folder for renders; what is there is used again. Without it: a temporary one."),
]


def _note(text: str) -> None:
    """Tells of progress."""
    Console(stderr=True).print(text)


@benchmark.command(short_help="The tracker and its peers on every sequence.")
def sequences(
    out: Out,
    data: DataIfAny = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="ours, ekf, sift, orb, klt, sift-pnp, klt-pnp, cuvslam, bundle; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(
            help="demo, street, room, organ, or a folder of the data; may be given more than once.", show_default="all"
        ),
    ] = None,
    runs: RunsIfAny = None,
) -> None:
    """The tracker, its EKF, PnP from OpenCV, cuVSLAM and bundle adjustment on every sequence (half an hour).

    The extra 'train' renders three of them, 'graph' adjusts, 'peers' brings cuVSLAM.
    """
    from sigmaslam_benchmarks.tracking.sequences import METHODS, write_results

    command = _command("sequences", out, *_repeated("method", method), *_repeated("sequence", sequence))
    typer.echo(write_results(out, data, command, method or METHODS, sequence, runs, _note))


@benchmark.command(short_help="Speed of the filters beside other libraries.")
def filters(
    out: Out,
    rounds: Annotated[int, typer.Option(min=1, help="In which every contender is timed.")] = 7,
    eager: Annotated[bool, typer.Option("--eager", help="Leave out what takes minutes to compile.")] = False,
) -> None:
    """Speed of the filters beside those of other libraries that are installed (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.filters.speed import write_in_one_thread

    flags = ("--eager",) if eager else ()
    typer.echo(write_in_one_thread(out, rounds, not eager, _command("filters", out, *flags)))


@benchmark.command(short_help="EKF against UKF by Monte Carlo.")
def claims(out: Out) -> None:
    """EKF against UKF by Monte Carlo (two to seven minutes; extras 'train' and 'report')."""
    need_train_extra()
    need_report_extra()
    from sigmaslam_benchmarks.filters.claims import write_claims

    with Console(stderr=True).status("simulating a dozen scenarios (two to seven minutes)"):
        page = write_claims(out, out.with_suffix(".png"), _command("claims", out))
    typer.echo(page)


@benchmark.command(short_help="Two-view geometry beside OpenCV.")
def geometry(out: Out) -> None:
    """Fundamental matrix, relative and absolute orientation and triangulation beside OpenCV."""
    from sigmaslam_benchmarks.tracking.two_view_geometry import write_geometry

    typer.echo(write_geometry(out, _command("geometry", out), _note))


@benchmark.command(short_help="How fast renders are, and how like real images.")
def renders(out: Out, data: Data = None) -> None:
    """How fast renders are made, and how like real images they are (extras 'train' and 'report')."""
    need_train_extra()
    need_report_extra()
    from sigmaslam_benchmarks.tracking.renders import write_renders

    typer.echo(write_renders(out, out.with_suffix(".png"), _need_data(data), _command("renders", out), _note))


@benchmark.command(short_help="Time and scores of the features beside others.")
def features(
    out: Out,
    data: Data = None,
    rounds: Annotated[int, typer.Option(min=1, help="In which every extractor is timed.")] = 15,
    weights: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of an export, or .onnx or .safetensors of ours; may be given more than once.",
            show_default="the shipped graph",
        ),
    ] = None,
    peer: Annotated[
        list[Path] | None,
        typer.Option(help=".onnx of another extractor to compare with; may be given more than once."),
    ] = None,
    sets: Annotated[str | None, typer.Option(help="Comma-separated sets to score.", show_default="all")] = None,
) -> None:
    """Time and scores of the features beside SIFT, ORB and other people's (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.matching.sets import ALL
    from sigmaslam_benchmarks.tracking.features import write_features

    flags = [*_repeated("weights", weights), *_repeated("peer", peer), *((f"--sets {sets}",) if sets else ())]
    command = _command("features", out, *flags, f"--rounds {rounds}")
    chosen = sets.split(",") if sets else list(ALL)
    typer.echo(write_features(out, _need_data(data), weights or [], peer or [], command, chosen, rounds, _note))


@benchmark.command(short_help="Whether probability and covariance of matches hold.")
def matches(out: Out, data: Data = None) -> None:
    """Whether probability and covariance of matches hold, beside AdaLAM and MAGSAC (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.matches import write_matches

    typer.echo(write_matches(out, _need_data(data), _command("matches", out), _note))


@benchmark.command(short_help="A covariance for each match beside one for all.")
def noise(out: Out, runs: Runs, data: Data = None) -> None:
    """The tracker with the covariances of its matches beside one constant (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.match_noise import write_noise
    from sigmaslam_synthetic.render_sequence import default_workers

    command = _command("noise", out, f"--runs {runs.name}")
    typer.echo(write_noise(out, _need_data(data), runs, default_workers(), command, _note))


@benchmark.command(short_help="Whether poses and map are as sure as they say.")
def consistency(
    out: Out,
    runs: Runs,
    seeds: Annotated[int, typer.Option(min=1, help="Sequences a scale.")] = 30,
    ray: RayAddress = None,
) -> None:
    """Whether poses and map are as sure as they say, on 90 rendered sequences (an hour; extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.consistency import write_consistency
    from sigmaslam_synthetic.render_sequence import default_workers

    command = _command("consistency", out, f"--runs {runs.name}", f"--seeds {seeds}")
    typer.echo(write_consistency(out, runs, seeds, default_workers(), command, ray, _note))


@benchmark.command(short_help="A camera that is shaken, with a slow shutter.")
def shake(
    out: Out,
    runs: Runs,
    seeds: Annotated[int, typer.Option(min=1, help="Sequences.")] = 20,
    ray: RayAddress = None,
) -> None:
    """Whether frames of a shaken camera with a slow shutter are right when they are called tracked (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.shake import write_shake
    from sigmaslam_synthetic.render_sequence import default_workers

    command = _command("shake", out, f"--runs {runs.name}", f"--seeds {seeds}")
    typer.echo(write_shake(out, runs, seeds, default_workers(), command, ray, _note))


@benchmark.command(short_help="Dense clouds beside exact depth.")
def reconstruction(
    out: Out,
    runs: Runs,
    seeds: Annotated[int, typer.Option(min=1, help="Sequences a world.")] = 20,
    ray: RayAddress = None,
) -> None:
    """Error, coverage, completeness and ghosts of dense clouds beside exact depth (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.reconstruction import write_reconstruction
    from sigmaslam_synthetic.render_sequence import default_workers

    command = _command("reconstruction", out, f"--runs {runs.name}", f"--seeds {seeds}")
    typer.echo(write_reconstruction(out, runs, seeds, default_workers(), command, ray, _note))


@benchmark.command(short_help="Image filters beside OpenCV's, and the dark.")
def denoising(out: Out, runs: Runs, data: Data = None) -> None:
    """PSNR and time of the image filters beside OpenCV's, and the tracker in the dark (ten minutes; extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.denoising import write_denoising

    command = _command("denoising", out, f"--runs {runs.name}")
    typer.echo(write_denoising(out, _need_data(data), runs, command, _note))


@benchmark.command(short_help="Memory, time and error over 10,000 frames.")
def endurance(
    out: Out,
    runs: RunsIfAny = None,
    frames: Annotated[int, typer.Option(min=1, help="To track.")] = 10_000,
) -> None:
    """Memory, time and error of a lap over and over (ten minutes to render, then a quarter of an hour; 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.tracking.endurance import write_endurance

    typer.echo(write_endurance(out, frames, _command("endurance", out, f"--frames {frames}"), runs, _note))


@benchmark.command(short_help="Time, memory and start-up beside cuVSLAM and others.")
def runtime(
    out: Out,
    data: DataIfAny = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="ours, sift, orb, klt, klt-pnp, sift-pnp, cuvslam, orbslam3; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(help="room, demo, or a folder of the data; may be given more than once.", show_default="all"),
    ] = None,
    rounds: Annotated[int, typer.Option(min=1, help="In which every method is timed.")] = 3,
    frames: Annotated[int, typer.Option(min=1, help="Of each sequence.")] = 60,
    runs: RunsIfAny = None,
) -> None:
    """CPU and wall time, memory and start-up beside OpenCV's odometry, cuVSLAM and ORB-SLAM3 (extra 'peers')."""
    from sigmaslam_benchmarks.tracking.runtime import SEQUENCES, write_runtime
    from sigmaslam_benchmarks.tracking.time_method import METHODS

    flags = [*_repeated("method", method), *_repeated("sequence", sequence)]
    command = _command("runtime", out, *flags, f"--rounds {rounds}", f"--frames {frames}")
    methods, chosen = method or METHODS, sequence or SEQUENCES
    typer.echo(write_runtime(out, data, command, methods, chosen, rounds, frames, runs, _note))


@benchmark.command(short_help="Faults of live cameras: what is silently wrong.")
def live(
    out: Out,
    runs: Runs,
    data: DataIfAny = None,
    case: Annotated[
        str | None,
        typer.Option("--cases", help="Names of faults, with commas: none, jitter_20, ...", show_default="all"),
    ] = None,
    sequence: Annotated[
        str | None,
        typer.Option("--sequences", help="room, street, drive or mh01, with commas.", show_default="all"),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option("--methods", help="ours, klt-pnp, cuvslam or orbslam3, with commas.", show_default="ours"),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Renders of each kind.")] = 3,
    first_seed: Annotated[
        int | None,
        typer.Option(min=0, help="Of the renders; with that of a page its command goes on.", show_default="fresh"),
    ] = None,
    frames: Annotated[int, typer.Option(min=20, help="Of each recording, at most.")] = 60,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """What drivers do to stamps, images and rig, and how many poses are silently wrong then (extra 'train')."""
    need_train_extra()
    from sigmaslam_benchmarks.live.live_benchmark import draw_first_seed, write_live

    first = draw_first_seed() if first_seed is None else first_seed
    chosen = {"cases": case, "sequences": sequence, "methods": method}
    cases, sequences, methods = (names.split(",") if names else None for names in chosen.values())
    flags = [f"--{option} {names}" for option, names in chosen.items() if names]
    flags += [f"--runs {runs.name}", f"--seeds {seeds}", f"--first-seed {first}", f"--frames {frames}"]
    command = _command("live", out, *flags)
    _note(f"seeds {first} to {first + seeds - 1}")
    page = write_live(
        out, data, runs, command, first, seeds, frames, cases, sequences, methods or ["ours"], workers, _note
    )
    typer.echo(page)


def reads_data(name: str) -> bool:
    """Whether there is a benchmark of that name that reads the real data sets."""
    functions = [each.callback for each in benchmark.registered_commands if each.callback is not None]
    return any(each.__name__ == name and "data" in inspect.signature(each).parameters for each in functions)


def _command(name: str, out: Path, *flags: str) -> str:
    """What the page says it was made by."""
    describe_source()  # the page names it, too; later the sources may have changed
    return " ".join(["sigmaslam benchmark", name, f"--out {out}", *flags])


def _repeated(option: str, values: list[str] | list[Path] | None) -> list[str]:
    """An option that may be given more than once, as it is typed."""
    return [f"--{option} {value}" for value in values or []]


def _need_data(data: Path | None) -> Path:
    if data is None:
        raise InputError("the folder of the real data sets is not known: give --data, or set SIGMASLAM_DATA")
    return data
