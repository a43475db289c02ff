"""`sigmaslam benchmark`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from sigmaslam.cli.extras import need_report_extra, need_train_extra
from sigmaslam.errors import InputError

# Each runs one benchmark and returns its page. It is given where the page goes, the command that the page names, and,
# as keywords of their names, the options that it serves.
_BENCHMARKS: dict[str, Callable[..., str]] = {}
# They leave out what needs the extra `train`.
_WITHOUT_TRAIN = ("sequences", "runtime", "geometry")
# Their pages need a picture, which the extra `report` draws.
_DRAWN = ("claims", "renders")


def _registered(function: Callable[..., str]) -> Callable[..., str]:
    """Offers a function `_name` as the benchmark `name`."""
    _BENCHMARKS[function.__name__.removeprefix("_")] = function
    return function


def _note(text: str) -> None:
    """Tells of progress."""
    Console(stderr=True).print(text)


@_registered
def _sequences(
    out: Path,
    command: str,
    *,
    data: Path | None,
    method: list[str] | None,
    sequence: list[str] | None,
    runs: Path | None,
) -> str:
    from sigmaslam.evaluation.benchmarks.sequences import METHODS, write_results

    command += _repeated("method", method) + _repeated("sequence", sequence)
    return write_results(out, data, command, method or METHODS, sequence, runs, _note)


@_registered
def _filters(out: Path, command: str, *, rounds: int | None, eager: bool) -> str:
    from sigmaslam.evaluation.filters.speed import write_in_one_thread

    return write_in_one_thread(out, rounds or 7, not eager, command + (" --eager" if eager else ""))


@_registered
def _claims(out: Path, command: str) -> str:
    from sigmaslam.evaluation.filters.claims import write_claims

    with Console(stderr=True).status("simulating a dozen scenarios (two to seven minutes)"):
        return write_claims(out, out.with_suffix(".png"), command)


@_registered
def _geometry(out: Path, command: str) -> str:
    from sigmaslam.evaluation.benchmarks.two_view_geometry import write_geometry

    return write_geometry(out, command, _note)


@_registered
def _renders(out: Path, command: str, *, data: Path | None) -> str:
    from sigmaslam.evaluation.benchmarks.renders import write_renders

    return write_renders(out, out.with_suffix(".png"), _need_data(data), command, _note)


@_registered
def _features(
    out: Path,
    command: str,
    *,
    data: Path | None,
    rounds: int | None,
    weights: list[Path] | None,
    peer: list[Path] | None,
    sets: str | None,
) -> str:
    from sigmaslam.evaluation.benchmarks.features import ROUNDS, write_features
    from sigmaslam.evaluation.matching.sets import ALL

    command += _repeated("weights", weights) + _repeated("peer", peer)
    command += (f" --sets {sets}" if sets else "") + (f" --rounds {rounds}" if rounds else "")
    chosen = sets.split(",") if sets else list(ALL)
    return write_features(out, _need_data(data), weights or [], peer or [], command, chosen, rounds or ROUNDS, _note)


@_registered
def _matches(out: Path, command: str, *, data: Path | None) -> str:
    from sigmaslam.evaluation.benchmarks.matches import write_matches

    return write_matches(out, _need_data(data), command, _note)


@_registered
def _noise(out: Path, command: str, *, data: Path | None, runs: Path | None) -> str:
    from sigmaslam.evaluation.benchmarks.match_noise import write_noise
    from sigmaslam.synthetic.render_sequence import default_workers

    folder = _need_runs(runs, "noise", "renders")
    command += f" --runs {folder.name}"
    return write_noise(out, _need_data(data), folder, default_workers(), command, _note)


@_registered
def _consistency(out: Path, command: str, *, runs: Path | None, seeds: int | None) -> str:
    from sigmaslam.evaluation.benchmarks.consistency import write_consistency
    from sigmaslam.synthetic.render_sequence import default_workers

    folder, seeds = _need_runs(runs, "consistency", "renders and results"), seeds or 30
    command += f" --runs {folder.name} --seeds {seeds}"
    return write_consistency(out, folder, seeds, default_workers(), command, _note)


@_registered
def _shake(out: Path, command: str, *, runs: Path | None, seeds: int | None) -> str:
    from sigmaslam.evaluation.benchmarks.shake import write_shake
    from sigmaslam.synthetic.render_sequence import default_workers

    folder, seeds = _need_runs(runs, "shake", "renders and results"), seeds or 20
    return write_shake(out, folder, seeds, default_workers(), f"{command} --runs {folder.name} --seeds {seeds}", _note)


@_registered
def _reconstruction(out: Path, command: str, *, runs: Path | None, seeds: int | None) -> str:
    from sigmaslam.evaluation.benchmarks.reconstruction import write_reconstruction
    from sigmaslam.synthetic.render_sequence import default_workers

    folder, seeds = _need_runs(runs, "reconstruction", "renders and results"), seeds or 20
    command += f" --runs {folder.name} --seeds {seeds}"
    return write_reconstruction(out, folder, seeds, default_workers(), command, _note)


@_registered
def _denoising(out: Path, command: str, *, data: Path | None, runs: Path | None) -> str:
    from sigmaslam.evaluation.benchmarks.denoising import write_denoising

    folder = _need_runs(runs, "denoising", "renders")
    return write_denoising(out, _need_data(data), folder, f"{command} --runs {folder.name}", _note)


@_registered
def _endurance(out: Path, command: str, *, runs: Path | None, frames: int | None) -> str:
    from sigmaslam.evaluation.benchmarks.endurance import write_endurance

    frames = frames or 10_000
    return write_endurance(out, frames, f"{command} --frames {frames}", runs, _note)


@_registered
def _runtime(
    out: Path,
    command: str,
    *,
    data: Path | None,
    method: list[str] | None,
    sequence: list[str] | None,
    rounds: int | None,
    runs: Path | None,
    frames: int | None,
) -> str:
    from sigmaslam.evaluation.benchmarks.runtime import FRAMES, ROUNDS, SEQUENCES, write_runtime
    from sigmaslam.evaluation.benchmarks.time_method import METHODS

    command += _repeated("method", method) + _repeated("sequence", sequence)
    command += (f" --rounds {rounds}" if rounds else "") + (f" --frames {frames}" if frames else "")
    return write_runtime(
        out,
        data,
        command,
        method or METHODS,
        sequence or SEQUENCES,
        rounds or ROUNDS,
        frames or FRAMES,
        runs,
        _note,
    )


# mypy reads the members of an enum from literals alone.
Benchmark = StrEnum("Benchmark", list(_BENCHMARKS))  # type: ignore[misc]
"""Benchmarks by name."""


def benchmark(
    context: typer.Context,
    name: Annotated[Benchmark, typer.Argument(metavar="NAME", help="Which benchmark, of those above.")],
    out: Annotated[Path, typer.Option(help="Markdown page to write; notes below '<!-- notes -->' in it are kept.")],
    data: Annotated[
        Path | None,
        typer.Option(
            envvar="SIGMASLAM_DATA", help="Folder of the real data sets; sequences without it: renders alone."
        ),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="sequences: ours, ekf, sift, orb, klt, sift-pnp, klt-pnp, bundle; runtime: ours, sift, orb, klt, "
            "klt-pnp, sift-pnp, cuvslam, orbslam3; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(
            help="sequences: demo, street, room, organ, or a folder of the data; runtime: room, demo, or a folder of "
            "the data; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    rounds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="filters, features, runtime: rounds in which every contender is timed.",
            show_default="7, features 15, runtime 3",
        ),
    ] = None,
    eager: Annotated[bool, typer.Option("--eager", help="filters: leave out what takes minutes to compile.")] = False,
    runs: Annotated[
        Path | None,
        typer.Option(
            help="noise, consistency, shake, reconstruction, denoising, sequences, endurance, runtime: folder of the "
            "renders; what is there is used again. sequences, endurance, runtime: a temporary one without it."
        ),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="consistency, reconstruction: sequences a scale or world; shake: sequences.",
            show_default="30, others 20",
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(
            min=1, help="endurance: frames to track; runtime: of each sequence.", show_default="10000, runtime 60"
        ),
    ] = None,
    weights: Annotated[
        list[Path] | None,
        typer.Option(
            help="features: .onnx or .safetensors of ours; may be given more than once.",
            show_default="the shipped graph",
        ),
    ] = None,
    peer: Annotated[
        list[Path] | None,
        typer.Option(help="features: .onnx of another extractor to compare with; may be given more than once."),
    ] = None,
    sets: Annotated[
        str | None, typer.Option(help="features: comma-separated sets to score.", show_default="all")
    ] = None,
) -> None:
    """Run a benchmark and write its page.

    sequences: the tracker, its EKF, PnP from OpenCV and bundle adjustment on every sequence (half an hour); the extra
    'train' renders three of them, 'graph' adjusts. filters: speed of the filters beside those of other libraries that
    are installed. claims: EKF against UKF by Monte Carlo. renders: how fast, and how like real images. features: time
    and scores of the features beside SIFT, ORB and other people's. matches: whether their probability and
    covariance hold, beside AdaLAM and MAGSAC. noise: the tracker with these covariances beside one constant.
    consistency: whether poses and map are as sure as they say, on 90 rendered sequences (an hour). shake: whether
    frames of a shaken camera with a slow shutter are right when they are called tracked. endurance: memory,
    time and error over 10,000 frames of a lap over and over (ten minutes to render, then a quarter of an hour).
    reconstruction: dense depths and their intervals on 60 rendered sequences (an hour).
    denoising: PSNR and time of the image filters beside OpenCV's, and the tracker in the dark (ten minutes).
    runtime: CPU and wall time, memory and start-up beside OpenCV's odometry, cuVSLAM and ORB-SLAM3 (extra 'peers').
    All but sequences and runtime need the extra 'train', claims and renders also 'report'.
    """
    values = {option: value for option, value in locals().items() if option not in ("context", "name", "out")}
    run = _BENCHMARKS[name.value]
    served = [option for option in values if option in inspect.signature(run).parameters]
    for option in values:
        # Refuse typed options alone: defaults and SIGMASLAM_DATA exist for every benchmark.
        source = context.get_parameter_source(option)
        if option not in served and source is not None and source.name == "COMMANDLINE":
            raise InputError(f"--{option} is not an option of the benchmark {name.value}: leave it out")
    if name.value not in _WITHOUT_TRAIN:
        need_train_extra()
    if name.value in _DRAWN:
        need_report_extra()
    typer.echo(run(out, f"sigmaslam benchmark {name.value} --out {out}", **{each: values[each] for each in served}))


def _repeated(option: str, values: list[str] | list[Path] | None) -> str:
    """An option that may be given more than once, as it is typed."""
    return "".join(f" --{option} {value}" for value in values or [])


def _need_data(data: Path | None) -> Path:
    if data is None:
        raise InputError("the folder of the real data sets is not known: give --data, or set SIGMASLAM_DATA")
    return data


def _need_runs(runs: Path | None, benchmark: str, content: str) -> Path:
    if runs is None:
        raise InputError(f"the benchmark {benchmark} needs --runs, a folder for its {content}")
    return runs
