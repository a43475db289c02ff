"""The command line: parses, calls, prints. Exit code 2 on bad input."""

from __future__ import annotations

import json
import logging
import sys
import tempfile
from enum import StrEnum
from importlib.metadata import version
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sigmaslam.errors import InputError, SigmaSlamError

if TYPE_CHECKING:
    from sigmaslam.readers import StereoSequence

app = typer.Typer(name="sigmaslam", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


class Frontend(StrEnum):
    """Where correspondences come from."""

    learned = "learned"
    sift = "sift"
    orb = "orb"
    klt = "klt"


class Detector(StrEnum):
    """What finds and describes keypoints in a single image."""

    learned = "learned"
    sift = "sift"
    orb = "orb"


class Backend(StrEnum):
    """What runs the network and the filter."""

    onnx = "onnx"
    torch = "torch"


class InputFormat(StrEnum):
    """Kinds of input."""

    auto = "auto"
    kitti = "kitti"
    euroc = "euroc"
    folder = "folder"
    video = "video"
    bag = "bag"


class RenderPreset(StrEnum):
    """Rendered worlds."""

    room = "room"
    street = "street"
    drone = "drone"
    colon = "colon"
    organ = "organ"
    tool = "tool"


class Motion(StrEnum):
    """Ways of moving through a rendered world."""

    normal = "normal"
    stops = "stops"
    rotation = "rotation"
    loop = "loop"
    rest = "rest"


class SensorGrade(StrEnum):
    """How good the rendered camera is."""

    ideal = "ideal"
    normal = "normal"
    harsh = "harsh"


class Truth(StrEnum):
    """How much truth is written beside rendered images."""

    dense = "dense"
    sparse = "sparse"


class Data(StrEnum):
    """What training pairs are made of."""

    leaves = "leaves"
    noise = "noise"
    patterns = "patterns"
    scenes = "scenes"
    mix = "mix"
    blend = "blend"
    turned = "turned"
    endoscope = "endoscope"


class TrainingRecipe(StrEnum):
    """Training runs by name."""

    full = "full"
    quick = "quick"
    endoscope = "endoscope"


class Benchmark(StrEnum):
    """Benchmarks by name."""

    sequences = "sequences"
    filters = "filters"
    claims = "claims"
    renders = "renders"
    features = "features"
    ablations = "ablations"
    matches = "matches"
    noise = "noise"
    consistency = "consistency"
    endurance = "endurance"


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"sigmaslam {version('sigmaslam')}")
        raise typer.Exit


@app.callback()
def _root(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Stereo visual SLAM: poses with an honest covariance and a sparse map, on a plain CPU."""


@app.command()
def demo(
    out: Annotated[
        Path | None, typer.Option(help="Run folder, new or empty.", show_default="a new temporary folder")
    ] = None,
    frontend: Annotated[Frontend, typer.Option(help="Where correspondences come from.")] = Frontend.learned,
) -> None:
    """Track the rendered sequence that ships with the package and print the errors against its exact truth."""
    from sigmaslam.evaluation.evaluate import evaluate_run, format_evaluation
    from sigmaslam.readers import open_sequence

    folder = out or Path(tempfile.mkdtemp(prefix="sigmaslam-demo-"))
    with as_file(files("sigmaslam.synthetic") / "demo") as sequence:
        _track(open_sequence(sequence, "kitti"), folder, frontend, Backend.onnx)
        typer.echo(format_evaluation(evaluate_run(folder, sequence / "poses.txt")))
    typer.echo(f"Report: {folder / 'report.html'}\nPicture: {folder / 'evaluation.png'}")


@app.command()
def track(
    out: Annotated[Path, typer.Option(help="Run folder, new or empty.")],
    source: Annotated[
        Path | None,
        typer.Argument(metavar="INPUT", help="KITTI, EuRoC or plain folder, video or ROS bag.", show_default=False),
    ] = None,
    format: Annotated[InputFormat, typer.Option(help="Kind of input.")] = InputFormat.auto,
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration YAML (or KITTI calib.txt) instead of the input's own.")
    ] = None,
    frontend: Annotated[Frontend, typer.Option(help="Where correspondences come from.")] = Frontend.learned,
    backend: Annotated[Backend, typer.Option(help="What runs network and filter; torch needs 'train'.")] = Backend.onnx,
    map: Annotated[
        Path | None,
        typer.Option(help="map.npz of an earlier run with the same camera and front-end: poses are in its world."),
    ] = None,
    tracks: Annotated[
        bool, typer.Option("--tracks", help="Also write tracks.npz, what keyframes saw, for `sigmaslam refine`.")
    ] = False,
    camera: Annotated[
        str | None,
        typer.Option(
            metavar="LEFT,RIGHT",
            help="Live cameras in place of INPUT: numbers, paths or URLs; side-by-side:0 is one that gives both eyes.",
        ),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="With --camera: stop after so long. Ctrl-C stops as well.")
    ] = None,
    topic_left: Annotated[
        str | None, typer.Option(help="Image topic in a bag.", show_default="the one with 'left', cam0 or infra1")
    ] = None,
    topic_right: Annotated[
        str | None, typer.Option(help="Image topic in a bag.", show_default="the one with 'right', cam1 or infra2")
    ] = None,
    track_object: Annotated[
        str | None,
        typer.Option(
            metavar="MASK|BOX",
            help="The camera is at rest and follows one rigid body: x,y,width,height in pixels of the first left "
            "image, or an image of its size that is not zero on the body. Poses are then T_camera_object.",
        ),
    ] = None,
    location: Annotated[
        Path | None,
        typer.Option(
            help="CSV of a location sensor on what moves, to fuse: timestamp,x,y,z[,qx,qy,qz,qw],sigma_position"
            "[,sigma_rotation]; any rate, any world (docs/object.md)."
        ),
    ] = None,
) -> None:
    """Track a stereo sequence, recorded or live: trajectory, covariance, map and report."""
    if backend is Backend.torch:
        _need_train_extra()
    if track_object is not None and (map is not None or tracks):
        raise InputError("--map and --tracks are of a moving camera's world: leave them out with --track-object")
    sequence = _open_input(source, format, calibration, camera, seconds, (topic_left, topic_right))
    try:
        summary = _track(sequence, out, frontend, backend, map, tracks, track_object, location)
    except KeyboardInterrupt:
        if (out / "run.json").exists():
            typer.echo(f"Stopped; what was tracked until then is in {out}")
        raise
    typer.echo(
        f"{summary['tracking']} of {summary['frames']} frames tracked, {summary['lost']} lost, "
        f"{summary['skipped']} skipped; {summary['median_inliers']:.0f} inliers in the median frame, "
        f"{summary['map_points']} map points.\n{summary['calibration_verdict']}\n"
        f"{_location_verdict(summary)}Report: {out / 'report.html'}"
    )


@app.command()
def match(
    image0: Annotated[Path, typer.Argument(metavar="IMAGE0", help="Image file, grey or colour, 8 or 16 bits.")],
    image1: Annotated[Path, typer.Argument(metavar="IMAGE1", help="Another view of the scene, of any size.")],
    out: Annotated[Path, typer.Option(help="File to write, ends in .npz.")],
    frontend: Annotated[Detector, typer.Option(help="What finds and describes keypoints.")] = Detector.learned,
    max_keypoints: Annotated[int, typer.Option(help="Most keypoints an image, at least 4.")] = 1024,
    min_probability: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Matches less probable than this are left out; 0 keeps all mutual.")
    ] = 0.5,
    picture: Annotated[
        Path | None, typer.Option(help="PNG to draw: both images, lines from purple (unlikely) to yellow (certain).")
    ] = None,
) -> None:
    """Match two images: which points show the same, how probably and how exactly; prints one line.

    Writes an .npz, best match first: keypoints0, keypoints1 (M, 2) pixels (u, v); probability (M,) that a match is
    right to 3 px; covariance (M, 2, 2) of keypoints1 given keypoints0; index0, index1 (M,). numpy.load reads it.
    """
    from sigmaslam.match import match_files

    typer.echo(match_files(image0, image1, out, frontend.value, max_keypoints, min_probability, picture))


@app.command()
def evaluate(
    run: Annotated[Path, typer.Argument(metavar="RUN_OR_TRAJECTORY", help="Run folder, or a TUM or KITTI file.")],
    truth: Annotated[Path, typer.Option(help="Ground truth: TUM, KITTI (with times.txt beside it) or EuRoC csv.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare a trajectory with the truth: ATE, RPE, KITTI t_rel and r_rel, NEES; draws evaluation.png.

    Of a run with --track-object the truth is T_camera_object of any frame that is fixed to the body.
    """
    from sigmaslam.evaluation.evaluate import evaluate_run, format_evaluation

    evaluation = evaluate_run(run, truth)
    typer.echo(json.dumps(evaluation.to_dict(), indent=2) if as_json else format_evaluation(evaluation))


@app.command()
def refine(
    run: Annotated[Path, typer.Argument(help="Run folder that 'track --tracks' wrote.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty.")],
) -> None:
    """Adjust all keyframes, landmarks and the disparity offset of a run at once (needs the extra 'graph').

    The offline reference for the filter. Writes trajectory, covariance, map and refine.json; prints the latter.
    """
    from sigmaslam.refine import refine_run

    with Console(stderr=True).status("reading") as status:
        summary = refine_run(run, out, tell=status.update)
    typer.echo(json.dumps(summary, indent=2))


@app.command()
def render(
    preset: Annotated[RenderPreset, typer.Argument(help="What world, and its stereo camera.")],
    out: Annotated[Path, typer.Option(help="Folder, new or empty, or left from the same command to go on with.")],
    frames: Annotated[int, typer.Option(min=1, help="Number of stereo pairs.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of world, path, cameras and noise.")] = 0,
    motion: Annotated[Motion, typer.Option(help="How the camera moves; in 'tool' the tool.")] = Motion.normal,
    movers: Annotated[
        float, typer.Option(min=0.0, max=0.5, help="Share of the image that moves on its own, 0 to 0.5.")
    ] = 0.0,
    sensor: Annotated[SensorGrade, typer.Option(help="Blur, noise, exposure and compression.")] = SensorGrade.normal,
    disparity_offset: Annotated[
        float, typer.Option(help="Pixels by which disparities exceed what the written calibration says.")
    ] = 0.0,
    rotation_error: Annotated[
        float, typer.Option(help="Degrees by which the right camera is turned against its calibration.")
    ] = 0.0,
    profile: Annotated[
        Path | None, typer.Option(help="street: KITTI poses file whose motion the drive follows.")
    ] = None,
    width: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    height: Annotated[int | None, typer.Option(min=16, help="Pixels.", show_default="the preset's")] = None,
    truth: Annotated[
        Truth, typer.Option(help="dense: depth, flow, masks of every pixel; sparse: landmark tracks alone.")
    ] = Truth.dense,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes.", show_default="one a core")] = None,
    ray: Annotated[bool, typer.Option("--ray", help="Spread the frames over a Ray cluster (extra 'scale').")] = False,
    device: Annotated[str, typer.Option(help="Where frames are drawn: cpu, cuda, cuda:1.")] = "cpu",
) -> None:
    """Render a stereo sequence with exact truth (needs the extra 'train').

    Writes a KITTI folder (drone and colon: EuRoC, unrectified), poses, truth/NNNNNN.npz, landmarks.npz, scene.json.
    """
    _need_train_extra()
    from sigmaslam.synthetic.sequence import default_workers, write_sequence
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
    )
    with Progress(
        BarColumn(bar_width=16),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=Console(stderr=True),
    ) as progress:
        task = progress.add_task("making the world", total=frames)

        def done(count: int) -> None:
            progress.update(task, completed=count, description="frames")

        before = write_sequence(out, recipe, truth.value, workers or default_workers(), device, ray, done)
    kept = f" ({before} were there)" if before else ""
    typer.echo(f"{frames} stereo pairs{kept} in {out}\nTry: sigmaslam track {out} --out run")


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="Folder for checkpoint, log, TensorBoard, samples, weights and card.")],
    recipe: Annotated[
        TrainingRecipe,
        typer.Option(help="full: an hour on 2 cores; quick: 7 minutes; endoscope: goes on from the shipped weights."),
    ] = TrainingRecipe.full,
    start: Annotated[
        Path | None,
        typer.Option("--from", help="Weights (.safetensors) to go on from.", show_default="the recipe's"),
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Optimiser steps.", show_default="the recipe's")] = None,
    data: Annotated[Data | None, typer.Option(help="What pairs are made of.", show_default="the recipe's")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of data, weights and sampling.")] = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes that make training pairs.")] = 1,
    device: Annotated[str, typer.Option(help="auto (a GPU if there is one), cpu, cuda, cuda:1.")] = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
) -> None:
    """Train the correspondence network on renders alone (needs the extra 'train').

    Ctrl-C saves the last step; the same command with --resume goes on. On several GPUs: torchrun --nproc-per-node N
    -m sigmaslam train ...
    """
    _need_train_extra()
    from sigmaslam.training.devices import leads
    from sigmaslam.training.loop import train as run_training
    from sigmaslam.training.recipes import choose_config, starting_weights

    config = choose_config(recipe.value, steps, None if data is None else data.value, seed)
    # What a resumed run began with is written in its checkpoint.
    weights = start if resume else starting_weights(recipe.value, start)
    card = run_training(out, config, workers, resume, recipe.value, weights, device)
    if leads():
        typer.echo(json.dumps(card, indent=2))


@app.command("train-scorer")
def train_scorer(
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
    _need_train_extra()
    from sigmaslam.training.scoring import ScoringConfig, train_scoring

    card = train_scoring(out, ScoringConfig(pairs, steps, verifier_steps, seed), workers)
    typer.echo(json.dumps(card, indent=2))


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Folder of a finished training run.")],
    out: Annotated[Path, typer.Option(help="Folder for the graphs, the weights and their card.")],
    scores: Annotated[
        Path | None, typer.Option(help="The .json of 'benchmark features' for these weights: into the card.")
    ] = None,
) -> None:
    """Export what a run made to ONNX and check the graphs against torch (needs the extra 'train').

    A run of 'train' gives the features' graph and those of the filter, a run of 'train-scorer' scorer and verifier.
    """
    _need_train_extra()
    from sigmaslam.evaluation.matching import read_scores
    from sigmaslam.models.export import export_all, export_scoring
    from sigmaslam.training.card import CARD_NAME
    from sigmaslam.training.loop import WEIGHTS_NAME
    from sigmaslam.training.scoring import SCORER_NAME

    if (run / SCORER_NAME).is_file():
        if scores is not None:
            raise InputError(f"--scores is of features, {run} is a run of train-scorer: leave it out")
        with Console(stderr=True).status("exporting two graphs"):
            differences = export_scoring(run, out)
        _tell_differences(differences)
        return

    on_real_sets = None if scores is None else read_scores(scores)
    with Console(stderr=True).status("exporting four graphs (about a minute)"):
        differences = export_all(run / WEIGHTS_NAME, run / CARD_NAME, out, on_real_sets)
    _tell_differences(differences)


@app.command()
def benchmark(
    name: Annotated[Benchmark, typer.Argument(help="Which benchmark.")],
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
            help="sequences: ours, ekf, sift, orb, klt, sift-pnp, klt-pnp, bundle; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    sequence: Annotated[
        list[str] | None,
        typer.Option(
            help="sequences: demo, street, room, organ, or a folder of the data; may be given more than once.",
            show_default="all",
        ),
    ] = None,
    rounds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="filters, features: rounds in which every contender is timed.",
            show_default="7, features 15",
        ),
    ] = None,
    eager: Annotated[bool, typer.Option("--eager", help="filters: leave out what takes minutes to compile.")] = False,
    runs: Annotated[
        Path | None,
        typer.Option(
            help="ablations, noise, consistency, sequences, endurance: folder of the training runs or renders; what is "
            "there is used again. sequences, endurance: a temporary one without it."
        ),
    ] = None,
    steps: Annotated[int, typer.Option(min=1, help="ablations: optimiser steps a run.")] = 250,
    seeds: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="ablations: runs of each variant; consistency: sequences a scale.",
            show_default="3, consistency 30",
        ),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="endurance: frames to track.")] = 10_000,
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
    consistency: whether poses and map are as sure as they say, on 90 rendered sequences (an hour). endurance: memory,
    time and error over 10,000 frames of a lap over and over (ten minutes to render, then a quarter of an hour).
    ablations: what each part of the features gains, by short training runs (an hour). All but the first need the extra
    'train'.
    """
    command = f"sigmaslam benchmark {name.value} --out {out}"
    if name is Benchmark.sequences:
        from sigmaslam.evaluation.benchmarks.sequences import METHODS, write_results

        command += "".join(
            [f" --method {each}" for each in method or []] + [f" --sequence {x}" for x in sequence or []]
        )
        note = Console(stderr=True).print
        typer.echo(write_results(out, data, command, method or METHODS, sequence, runs, note))
        return
    _need_train_extra()
    if name is Benchmark.filters:
        from sigmaslam.evaluation.benchmarks.filters import write_in_one_thread

        typer.echo(write_in_one_thread(out, rounds or 7, not eager, command + (" --eager" if eager else "")))
    elif name is Benchmark.renders:
        from sigmaslam.evaluation.benchmarks.renders import write_renders

        typer.echo(write_renders(out, out.with_suffix(".png"), _need_data(data), command, Console(stderr=True).print))
    elif name is Benchmark.features:
        from sigmaslam.evaluation.benchmarks.features import ROUNDS, write_features
        from sigmaslam.evaluation.matching.sets import ALL

        options = [f" --weights {path}" for path in weights or []] + [f" --peer {path}" for path in peer or []]
        options += [f" --sets {sets}"] if sets else []
        command += "".join(options) + (f" --rounds {rounds}" if rounds else "")
        note = Console(stderr=True).print
        chosen = sets.split(",") if sets else list(ALL)
        typer.echo(
            write_features(out, _need_data(data), weights or [], peer or [], command, chosen, rounds or ROUNDS, note)
        )
    elif name is Benchmark.matches:
        from sigmaslam.evaluation.benchmarks.matches import write_matches

        typer.echo(write_matches(out, _need_data(data), command, Console(stderr=True).print))
    elif name is Benchmark.noise:
        from sigmaslam.evaluation.benchmarks.noise import write_noise
        from sigmaslam.synthetic.sequence import default_workers

        if runs is None:
            raise InputError("the benchmark noise needs --runs, a folder for its renders")
        command += f" --runs {runs.name}"
        note = Console(stderr=True).print
        typer.echo(write_noise(out, _need_data(data), runs, default_workers(), command, note))
    elif name is Benchmark.consistency:
        from sigmaslam.evaluation.benchmarks.consistency import write_consistency
        from sigmaslam.synthetic.sequence import default_workers

        if runs is None:
            raise InputError("the benchmark consistency needs --runs, a folder for its renders and results")
        seeds = seeds or 30
        command += f" --runs {runs.name} --seeds {seeds}"
        typer.echo(write_consistency(out, runs, seeds, default_workers(), command, Console(stderr=True).print))
    elif name is Benchmark.endurance:
        from sigmaslam.evaluation.benchmarks.endurance import write_endurance

        command += f" --frames {frames}"
        typer.echo(write_endurance(out, frames, command, runs, Console(stderr=True).print))
    elif name is Benchmark.ablations:
        from sigmaslam.evaluation.benchmarks.ablations import write_ablations

        if runs is None:
            raise InputError("the benchmark ablations needs --runs, a folder for its training runs")
        seeds = seeds or 3
        command += f" --runs {runs} --steps {steps} --seeds {seeds}"
        note = Console(stderr=True).print
        typer.echo(write_ablations(out, runs, _need_data(data), seeds, steps, command, note))
    else:
        from sigmaslam.evaluation.benchmarks.filter_claims import write_claims

        with Console(stderr=True).status("simulating a dozen scenarios (two to seven minutes)"):
            page = write_claims(out, out.with_suffix(".png"))
        typer.echo(page)


def main() -> None:
    """Entry point of the console script."""
    logging.basicConfig(
        level=logging.WARNING,
        format="%(message)s",
        handlers=[RichHandler(console=Console(stderr=True), show_time=False, show_path=False)],
    )
    try:
        app()
    except SigmaSlamError as error:
        Console(stderr=True).print(f"error: {error}", style="red", highlight=False, markup=False, soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)


def _open_input(
    source: Path | None,
    format: InputFormat,
    calibration: Path | None,
    camera: str | None,
    seconds: float | None,
    topics: tuple[str | None, str | None],
) -> StereoSequence:
    from sigmaslam.readers import open_cameras, open_sequence

    if (source is None) == (camera is None):
        raise InputError("give either INPUT, a recording, or --camera, live cameras" + (", not both" if source else ""))
    if source is not None:
        if seconds is not None:
            raise InputError("--seconds goes with --camera; a recording is tracked to its end")
        return open_sequence(source, format.value, calibration, topics)
    assert camera is not None
    if calibration is None:
        raise InputError("--camera needs --calibration: the stereo pair as YAML, in the form that the README shows")
    if format is not InputFormat.auto or topics != (None, None):
        raise InputError("--format, --topic-left and --topic-right go with INPUT, not with --camera")
    return open_cameras(camera, calibration, seconds)


def _track(
    sequence: StereoSequence,
    out: Path,
    frontend: Frontend,
    backend: Backend,
    map_path: Path | None = None,
    tracks: bool = False,
    track_object: str | None = None,
    location: Path | None = None,
) -> dict[str, Any]:
    from sigmaslam.location import read_locations
    from sigmaslam.run import track_sequence

    return track_sequence(
        sequence,
        out,
        frontend.value,
        backend.value,
        map_path=map_path,
        tracks=tracks,
        track_object=track_object,
        locations=None if location is None else read_locations(location),
    )


def _location_verdict(summary: dict[str, Any]) -> str:
    """A line about the location sensor; empty without one."""
    if "location" not in summary:
        return ""
    used, weakened, unused, ready = (summary["location"][name] for name in ("used", "weakened", "unused", "ready"))
    if ready is None:
        return (
            f"The location sensor was not fused: its {used} readings with a pose do not show how its world lies to "
            "ours. Is it the same clock? Positions need a path that is no straight line.\n"
        )
    return (
        f"Location sensor: {used} readings used ({weakened} disagreed and count less), {unused} not; poses are fused "
        f"from {ready:.3f} s on.\n"
    )


def _tell_differences(differences: dict[str, float]) -> None:
    for name, difference in differences.items():
        typer.echo(f"{name}.onnx differs from torch by {difference:.1e}")


def _need_data(data: Path | None) -> Path:
    if data is None:
        raise InputError("the folder of the real data sets is not known: give --data, or set SIGMASLAM_DATA")
    return data


def _need_train_extra() -> None:
    try:
        import kornia  # noqa: F401
        import torch  # noqa: F401
    except ImportError as error:
        raise InputError(f"{error.name} is not installed: pip install 'sigmaslam[train]'") from error


if __name__ == "__main__":
    main()
