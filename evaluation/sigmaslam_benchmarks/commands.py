"""`sigmaslam benchmark`: a command for each benchmark of one table, which writes its page."""

import time
from dataclasses import dataclass
from importlib import import_module
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from sigmaslam.cli.extras import RayAddress, need_extra
from sigmaslam.errors import InputError
from sigmaslam_benchmarks.source_description import describe_source

benchmark = typer.Typer(name="benchmark", no_args_is_help=True, help="Run a benchmark and write its page.")


def _option(name: str, flag: str, kind: Any, help: str, default: Any = None, **settings: Any) -> Parameter:
    """An option by the name of the parameter that takes it."""
    kind = Annotated[kind, typer.Option(flag, help=help, **settings)]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _count(name: str, default: int, help: str, least: int = 1) -> Parameter:
    return _option(name, f"--{name}", int, help, default, min=least)


def _repeated(name: str, flag: str, kind: Any, help: str, shown: str | bool = "all") -> Parameter:
    return _option(name, flag, list[kind], f"{help}; may be given more than once.", [], show_default=shown)


def _names(name: str, help: str, shown: str = "all") -> Parameter:
    """Names with commas; the parameter takes them as a list."""
    return _option(name, f"--{name}", Any, help, parser=lambda text: text.split(","), metavar="A,B", show_default=shown)


_OUT = _option(
    "out", "--out", Path, "Markdown page to write; notes below '<!-- notes -->' in it are kept.", Parameter.empty
)
_DATA, _DATA_IF_ANY = (
    _option("data", "--data", Path | None, f"Folder of the real data sets{without}.", envvar="SIGMASLAM_DATA")
    for without in (" (needed)", "; without it: renders alone")
)
_RUNS = _option("runs", "--runs", Path, "Folder for renders and results; what is there is used again.", Parameter.empty)
_RENDERS_HELP = "Folder for renders; what is there is used again. Without it: a temporary one."
_RENDERS = _option("renders", "--runs", Path | None, _RENDERS_HELP)
_RAY = Parameter("ray", Parameter.KEYWORD_ONLY, default=None, annotation=RayAddress)
_EAGER = _option("eager", "--eager", bool, "Leave out what takes minutes to compile.", False)
_FIRST_SEED = _option(
    "first_seed",
    "--first-seed",
    int,
    "Of the renders; with that of a page its command goes on.",
    Parameter.empty,
    min=0,
    # No tracker was made with the time of day.
    default_factory=lambda: 10_000 + int(time.time()) % 1_000_000,
    show_default="fresh",
)
# A page does not name how, and on which machines, it was made.
_UNNAMED = ("data", "renders", "ray", "workers")


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A benchmark; its module's function `write_<name>` writes the page and returns it.

    The function is given what it takes of these, and the options:

    - path, figure: Markdown page, whose part below a line `<!-- notes -->` is kept, and a PNG beside it.
    - command: what the page says it was made by.
    - data: folder of the real data sets; None where it may be missing: renders alone.
    - runs, renders: folder for renders and results; what is there is used again, results if they come from the same
      recipe and code. Without `renders`: a temporary one.
    - workers: processes.
    - note: is told of progress.

    Attributes:
        module: of `sigmaslam_benchmarks`.
        help: the first sentence is short enough for the list of commands in 80 columns.
        options: beside --out.
        extras: without which it does not begin; of `train` and `report`.
    """

    module: str
    help: str
    options: tuple[Parameter, ...] = ()
    extras: tuple[str, ...] = ()


_TRAIN = ("train",)
_FAULTS = (
    _DATA_IF_ANY,
    _names("cases", "Names of faults, with commas: none, ..."),
    _names("sequences", "room, street, drive, mh01 or kitti01, with commas."),
    _names("methods", "ours, klt-pnp, cuvslam or orbslam3, with commas.", "ours"),
    _RUNS,
    _count("seeds", 3, "Renders of each kind."),
    _FIRST_SEED,
    _count("frames", 60, "Of each recording, at most.", least=20),
    _count("workers", 1, "Processes."),
)
BENCHMARKS = {
    "sequences": Benchmark(
        "tracking.sequences",
        "The tracker and its peers on every sequence. Its EKF, PnP from OpenCV, cuVSLAM, ORB-SLAM3, bundle adjustment "
        "(an hour). The extra 'train' renders three of them, 'graph' adjusts, 'peers' brings cuVSLAM and ORB-SLAM3.",
        (
            _DATA_IF_ANY,
            _repeated(
                "methods", "--method", str, "ours, ekf, sift, orb, klt, sift-pnp, klt-pnp, cuvslam, orbslam3, bundle"
            ),
            _repeated(
                "sequences", "--sequence", str, "demo, street, street-calibrated, room, organ, or a folder of the data"
            ),
            _RENDERS,
        ),
    ),
    "filters": Benchmark(
        "filters.speed",
        "Speed of the filters beside other libraries. Those that are installed are timed (extra 'train').",
        (_count("rounds", 7, "In which every contender is timed."), _EAGER),
        _TRAIN,
    ),
    "claims": Benchmark(
        "filters.claims",
        "EKF against UKF by Monte Carlo. A dozen scenarios (two to seven minutes; extras 'train' and 'report').",
        extras=("train", "report"),
    ),
    "geometry": Benchmark(
        "tracking.two_view_geometry",
        "Two-view geometry beside OpenCV, PoseLib and COLMAP. Fundamental matrix, relative orientation (ten minutes), "
        "absolute orientation and triangulation.",
        (_DATA_IF_ANY,),
    ),
    "renders": Benchmark(
        "tracking.renders",
        "How fast renders are, and how like real images. Needs the extras 'train' and 'report'.",
        (_DATA,),
        ("train", "report"),
    ),
    "features": Benchmark(
        "tracking.features",
        "Time and scores of the features beside others. SIFT, ORB and other people's (extra 'train').",
        (
            _DATA,
            _repeated("weights", "--weights", Path, "Export, .onnx or .safetensors of ours", "the shipped graph"),
            _repeated("peers", "--peer", Path, ".onnx of another extractor to compare with", False),
            _names("sets", "Sets to score, with commas."),
            _count("rounds", 15, "In which every extractor is timed."),
        ),
        _TRAIN,
    ),
    "matches": Benchmark(
        "tracking.matches",
        "Whether probability and covariance of matches hold. Beside AdaLAM and MAGSAC (extra 'train').",
        (_DATA,),
        _TRAIN,
    ),
    "noise": Benchmark(
        "tracking.consistency",
        "A covariance for each match beside one for all. On the runs of 'consistency' (extra 'train').",
        (_RUNS, _count("seeds", 30, "Sequences a scale."), _RAY),
        _TRAIN,
    ),
    "consistency": Benchmark(
        "tracking.consistency",
        "Whether poses and map are as sure as they say. On 90 rendered sequences (an hour; extra 'train').",
        (_RUNS, _count("seeds", 30, "Sequences a scale."), _RAY),
        _TRAIN,
    ),
    "shake": Benchmark(
        "tracking.shake",
        "A camera that is shaken, with a slow shutter. Whether frames called tracked are right (extra 'train').",
        (_RUNS, _count("seeds", 20, "Sequences."), _RAY),
        _TRAIN,
    ),
    "reconstruction": Benchmark(
        "tracking.reconstruction",
        "Dense clouds beside exact depth. Their error, coverage, completeness and ghosts (extra 'train').",
        (
            _RUNS,
            _count("seeds", 20, "Sequences a world."),
            _RAY,
            _option("real", "--real", bool, "Disparities beside LiDAR and Middlebury instead.", False),
            _option("organ", "--organ", bool, "Rigid organs alone, in millimetres.", False),
            _DATA_IF_ANY,
        ),
        _TRAIN,
    ),
    "denoising": Benchmark(
        "tracking.denoising",
        "Image filters beside OpenCV's, and the dark. PSNR, time, and the tracker (ten minutes; extra 'train').",
        (_RUNS, _DATA),
        _TRAIN,
    ),
    "endurance": Benchmark(
        "tracking.endurance",
        "Memory, time and error over 10,000 frames. A lap over and over (half an hour with renders; extra 'train').",
        (_RENDERS, _count("frames", 10_000, "To track.")),
        _TRAIN,
    ),
    "runtime": Benchmark(
        "tracking.runtime",
        "Time, memory and start-up beside cuVSLAM and others. OpenCV's odometry and ORB-SLAM3, too (extra 'peers').",
        (
            _DATA_IF_ANY,
            _repeated("methods", "--method", str, "ours, sift, orb, klt, klt-pnp, sift-pnp, cuvslam, orbslam3"),
            _repeated("sequences", "--sequence", str, "room, demo, or a folder of the data"),
            _count("rounds", 3, "In which every method is timed."),
            _count("frames", 60, "Of each sequence."),
            _RENDERS,
        ),
    ),
    "live": Benchmark(
        "live.live_benchmark",
        "Faults of live cameras: what is silently wrong. What drivers do to stamps, images and rig (extra 'train').",
        _FAULTS,
        _TRAIN,
    ),
    "calibration": Benchmark(
        "live.live_benchmark",
        "Faults of calibrations: what is found and named. Three sizes of each, on renders and a drive (extra 'train').",
        _FAULTS,
        _TRAIN,
    ),
    "inertial": Benchmark(
        "inertial.inertial_benchmark",
        "Dark stretches with and without an inertial sensor, or its gyro alone (extra 'train').",
        (
            _DATA_IF_ANY,
            _names("worlds", "room, street or mh01, with commas."),
            _RUNS,
            _count("seeds", 3, "Renders of each kind."),
            _FIRST_SEED,
            _count("workers", 1, "Processes."),
        ),
        _TRAIN,
    ),
}
"""By name, in the order of the help."""


def reads_data(name: str) -> bool:
    """Whether there is a benchmark of that name that reads the real data sets."""
    return name in BENCHMARKS and any(option.name == "data" for option in BENCHMARKS[name].options)


def _run(name: str, out: Path, given: dict[str, Any]) -> None:
    chosen = BENCHMARKS[name]
    for extra in chosen.extras:
        need_extra(extra)
    if _DATA in chosen.options and given["data"] is None:
        raise InputError("the folder of the real data sets is not known: give --data, or set SIGMASLAM_DATA")
    write = getattr(import_module(f"sigmaslam_benchmarks.{chosen.module}"), f"write_{name}")
    words = [word for each in chosen.options if each.name not in _UNNAMED for word in _words(each, given[each.name])]
    command = " ".join(["sigmaslam benchmark", name, f"--out {out}", *words])
    describe_source()  # the page names it, too; later the sources may have changed
    offered = {"path": out, "figure": out.with_suffix(".png"), "command": command, "note": Console(stderr=True).print}
    taken = signature(write).parameters
    if "workers" in taken:
        from sigmaslam_synthetic.render_sequence import default_workers

        offered["workers"] = default_workers()
    # What is not given is as the function has it.
    offered |= {each: value for each, value in given.items() if value or taken[each].default is Parameter.empty}
    typer.echo(write(**{each: offered[each] for each in taken if each in offered}))


def _words(option: Parameter, value: Any) -> list[str]:
    """An option as it is typed; a folder by its name."""
    (settings,) = option.annotation.__metadata__
    flag = settings.default  # of an annotation, the first argument
    if not value:
        return []
    if value is True:
        return [flag]
    if option is _RUNS:
        value = value.name
    elif settings.parser is not None:
        value = ",".join(value)
    return [f"{flag} {each}" for each in (value if isinstance(value, list) else [value])]


def _add(name: str, help: str, options: tuple[Parameter, ...]) -> None:
    """Makes a benchmark a command."""

    def command(out: Path, **given: Any) -> None:
        _run(name, out, given)

    command.__name__, command.__doc__ = name, help
    command.__annotations__ = {each.name: each.annotation for each in options}
    command.__signature__ = Signature(options)  # type: ignore[attr-defined]
    benchmark.command(short_help=help.partition(". ")[0] + ".")(command)


for _name, _each in BENCHMARKS.items():
    _add(_name, _each.help, (_OUT, *_each.options))
