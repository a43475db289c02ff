"""Our tracker, its EKF, classical odometry and bundle adjustment on every stereo sequence, side by side in one run."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from sigmaslam.bundle_adjustment.refine_run import refine_run
from sigmaslam.bundle_adjustment.track_file import TRACKS_NAME
from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.evaluation.benchmarks.page import write_page
from sigmaslam.evaluation.benchmarks.pnp_baselines import PnpOdometry
from sigmaslam.evaluation.benchmarks.sequences_page import (
    LeftOut,
    Result,
    ate_cell,
    format_results,
    method_label,
    total_cell,
)
from sigmaslam.evaluation.run_evaluation import Evaluation, evaluate_run
from sigmaslam.files import make_folder
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import open_sequence
from sigmaslam.readers.trajectory_files import read_tum, write_tum
from sigmaslam.runs.report import COLUMNS, FrameTable, read_frames
from sigmaslam.runs.track import track_sequence
from sigmaslam.slam.tracker import TrackerConfig

REAL = (
    ("kitti_raw_0926_0039_a", "poses.txt"),
    ("kitti_odometry_01_f000_050", "poses.txt"),
    ("euroc_v1_01_keyframes_a", "groundtruth.csv"),
    ("euroc_v1_01_static", "groundtruth.csv"),
)
"""Folder and its truth."""
RENDERED = ("street", "room", "organ")
"""Presets, in the sizes and with the disparity offset of the benchmark consistency."""
SEQUENCES = ("demo", *RENDERED, *(name for name, _ in REAL))
"""In the order of the page; the demo needs no data, the next ones are rendered."""
FRAMES = 40
_SEED = 2000  # seeds below 1000 were looked at while the tracker was made; consistency counts from there

_TRACKED = {
    "ours": ("learned", TrackerConfig()),
    "ekf": ("learned", TrackerConfig(linearisation="extended", iterations=1)),
    "sift": ("sift", TrackerConfig()),
    "orb": ("orb", TrackerConfig()),
    "klt": ("klt", TrackerConfig()),
}
_PNP = {"sift-pnp": "sift", "klt-pnp": "klt"}
METHODS = (*_TRACKED, *_PNP, "bundle")
"""In the order of the page; the bundle adjustment takes the tracks of the first."""


@dataclass(frozen=True, slots=True)
class _Job:
    """A sequence; `exact` says that its truth is."""

    name: str
    source: Path
    truth: Path
    exact: bool


def write_results(
    path: Path,
    data: Path | None,
    command: str,
    methods: Sequence[str] = METHODS,
    sequences: Sequence[str] | None = None,
    renders: Path | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Runs everything, writes the page and returns it; what is below a line `<!-- notes -->` in the page is kept.

    When it is stopped, what was found until then is written.

    Args:
        path: Markdown page.
        data: folder with the real sequences, or None for the rendered ones alone.
        command: what the page says it was made by.
        methods, sequences: of `METHODS` and `SEQUENCES`, all unless given.
        renders: folder for the renders, which are used again; a temporary one unless given.
        note: is told of progress.
    Raises:
        InputError: a name is unknown, or `data` does not hold the sequences.
    """
    results: list[Result | LeftOut] = []
    try:
        for result in run_sequences(data, methods, sequences, renders, note):
            results.append(result)
    except BaseException:
        if results:
            write_page(path, format_results(results, command, complete=False))
        raise
    return write_page(path, format_results(results, command))


def run_sequences(
    data: Path | None,
    methods: Sequence[str] = METHODS,
    sequences: Sequence[str] | None = None,
    renders: Path | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> Iterator[Result | LeftOut]:
    """Runs and evaluates everything, one at a time; see `write_results`."""
    _check_names("method", methods, METHODS)
    _check_names("sequence", sequences or (), SEQUENCES)
    wanted = sequences or [name for name in SEQUENCES if data is not None or name not in dict(REAL)]
    real = [name for name in wanted if name in dict(REAL)]
    missing = [name for name in real if data is None or not (data / name).is_dir()]
    if missing:
        raise InputError(
            f"{data or 'no folder'} does not hold {', '.join(missing)}: give the folder of the data sets with --data"
        )
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        demo = stack.enter_context(as_file(files("sigmaslam.synthetic") / "demo"))
        jobs = [_Job("demo (rendered)", demo, demo / "poses.txt", True)] if "demo" in wanted else []
        for preset in RENDERED:
            if preset in wanted:
                try:
                    jobs.append(_render(preset, renders or scratch / "renders", note))
                except ImportError as error:
                    reason = f"{error.name} is not installed: pip install 'sigmaslam[train]'"
                    yield LeftOut(f"{preset} (rendered)", "", reason)
        if data is not None:
            jobs += [_Job(name, data / name, data / name / truth, False) for name, truth in REAL if name in wanted]
        for number, job in enumerate(jobs):
            runs = scratch / str(number)
            for method in METHODS:
                if method not in methods:
                    continue
                result = _run(job, method, runs)
                yield result
                label = f"{job.name}: {method_label(method)}"
                if isinstance(result, LeftOut):
                    note(f"{label} is left out: {result.reason}")
                else:
                    note(f"{label}, ATE {ate_cell(result)} m, {total_cell(result)} ms")


def follow_with_pnp(source: Path, matcher: str, out: Path) -> FrameTable:
    """Runs a baseline on a sequence; leaves trajectory.tum and covariance.npy in the new folder `out`."""
    sequence = open_sequence(source)
    odometry = PnpOdometry(sequence.camera, matcher)
    steps, timestamps, milliseconds = [], [], []
    for frame in sequence.frames():
        began = time.perf_counter()
        steps.append(odometry.step(frame.left, frame.right))
        milliseconds.append(1e3 * (time.perf_counter() - began))
        timestamps.append(frame.timestamp)
    make_folder(out)
    trajectory = Trajectory(np.array(timestamps), np.stack([step.T_world_camera for step in steps]))
    write_tum(out / "trajectory.tum", trajectory)
    np.save(out / "covariance.npy", np.stack([step.covariance for step in steps]))
    columns = {name: np.full(len(steps), np.nan) for name in COLUMNS}
    columns["timestamp"] = trajectory.timestamps
    columns["matches"] = np.array([step.matches for step in steps], dtype=float)
    columns["inliers"] = np.array([step.inliers for step in steps], dtype=float)
    return FrameTable([step.status for step in steps], columns, {"step": np.array(milliseconds)})


def _check_names(kind: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise InputError(f"{kind} {name!r} is unknown; choose of {', '.join(known)}")


def _render(preset: str, folder: Path, note: Callable[[str], None]) -> _Job:
    """Renders a sequence, or finds it there."""
    from sigmaslam.evaluation.benchmarks.consistency import OFFSET, SCALES
    from sigmaslam.synthetic.render_sequence import default_workers, write_sequence
    from sigmaslam.synthetic.simulation import Recipe

    (scale,) = (scale for scale in SCALES if scale.preset == preset)
    recipe = Recipe(preset, FRAMES, _SEED, disparity_offset=OFFSET, width=scale.width, height=scale.height)
    out = folder / f"{preset}{_SEED}"
    began = time.perf_counter()
    write_sequence(out, recipe, "sparse", default_workers())
    note(f"{preset} rendered in {time.perf_counter() - began:.0f} s")
    return _Job(f"{preset} (rendered, disparities {OFFSET} px too large)", out, out / "poses.txt", True)


def _run(job: _Job, method: str, runs: Path) -> Result | LeftOut:
    run = runs / method
    if method in _PNP:
        frames = follow_with_pnp(job.source, _PNP[method], run)
    elif method in _TRACKED:
        _track(job, method, run)
        frames = read_frames(run / "frames.csv")
    else:
        return _adjust(job, runs)
    evaluation = evaluate_run(run, job.truth, plot=False)
    nees = evaluation.nees.mean if job.exact and evaluation.nees else np.nan
    return Result(job.name, method, evaluation, nees, frames)


def _track(job: _Job, method: str, run: Path) -> None:
    frontend, config = _TRACKED[method]
    track_sequence(open_sequence(job.source), run, frontend, config=config, tracks=method == "ours")


def _adjust(job: _Job, runs: Path) -> Result | LeftOut:
    """Bundle adjustment of the tracks of ours."""
    run, out = runs / "ours", runs / "bundle"
    if not run.is_dir():
        _track(job, "ours", run)
    try:
        refined = refine_run(run, out)
    except SigmaSlamError as error:
        # No GTSAM, or nothing to adjust: a camera at rest has one keyframe.
        return LeftOut(job.name, "bundle", str(error))
    evaluation = evaluate_run(out, job.truth, plot=False)
    nees = _keyframe_nees(evaluation, run, out) if job.exact else np.nan
    return Result(job.name, "bundle", evaluation, nees, None, refined)


def _keyframe_nees(evaluation: Evaluation, run: Path, out: Path) -> float:
    """Of the keyframes alone: the others have the covariance of the keyframe before."""
    with np.load(run / TRACKS_NAME) as tracks:
        keyframes = np.unique(tracks["frame"])
    times = read_tum(out / "trajectory.tum").timestamps[keyframes]
    nees = evaluation.nees
    if nees is None:
        return float("nan")
    adjusted = np.isin(nees.timestamps, times)
    return float(nees.per_frame[adjusted].mean()) if adjusted.any() else float("nan")
