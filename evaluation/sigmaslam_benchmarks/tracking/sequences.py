"""Our tracker, its EKF, classical odometry and bundle adjustment on every stereo sequence, side by side in one run."""

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np

from sigmaslam.bundle_adjustment.refine_run import refine_run
from sigmaslam.bundle_adjustment.track_file import TRACKS_NAME
from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.readers.trajectory_files import read_covariances, read_trajectory
from sigmaslam.runs.request import TrackerOptions
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.tracking.page import check_names, write_results_page
from sigmaslam_benchmarks.tracking.sequences_page import (
    Omission,
    SequenceResult,
    ate_cell,
    format_results,
    method_label,
    total_cell,
)
from sigmaslam_benchmarks.tracking.step_nees import step_nees
from sigmaslam_benchmarks.tracking.stereo_peers import MissingPeerError, track_with_peer
from sigmaslam_benchmarks.trial import Method, Trial, TrialResult, read_trial, render, track_ours

REAL = (
    ("kitti_raw_0926_0039_a", "poses.txt", (0.21, 0.05)),
    ("kitti_odometry_01_f000_050", "poses.txt", (0.1, 0.05)),
    ("euroc_mh01_f000_099", "groundtruth.tum", (0.002, 0.2)),
    ("euroc_v1_01_keyframes_a", "groundtruth.csv", (0.003, 0.1)),
    ("euroc_v1_01_static", "groundtruth.csv", (0.003, 0.1)),
)
"""Folder, its truth, and the sigmas of this, as those who measured it give them: metres and degrees."""
REAL_NAMES = tuple(name for name, _, _ in REAL)
CALIBRATED = "street-calibrated"
"""The images of the street, with the calibration of the cameras that took them."""
RENDERED = ("street", CALIBRATED, "room", "organ")
"""Presets, in the sizes and with the disparity offset of the benchmark consistency."""
SEQUENCES = ("demo", *RENDERED, *REAL_NAMES)
"""In the order of the page; the demo needs no data, the next ones are rendered."""
FRAMES = 40
_SEED = 2000  # seeds below 1000 were looked at while the tracker was made; consistency counts from there

_track_ours = partial(track_ours, tracks=True)
_TRIED: dict[str, Method] = {
    "ours": _track_ours,
    "ekf": partial(track_ours, tracker=TrackerOptions(config=TrackerConfig(linearisation="extended", iterations=1))),
    "sift": partial(track_ours, tracker=TrackerOptions("sift")),
    "orb": partial(track_ours, tracker=TrackerOptions("orb")),
    "klt": partial(track_ours, tracker=TrackerOptions("klt")),
    **{name: partial(track_with_peer, name=name) for name in ("sift-pnp", "klt-pnp", "cuvslam", "orbslam3")},
}
METHODS = (*_TRIED, "bundle")
"""In the order of the page; the bundle adjustment takes the tracks of the first."""


@dataclass(frozen=True, slots=True)
class _BenchmarkSequence:
    """A sequence.

    Attributes:
        name: as the page calls it.
        source: what `open_sequence` opens.
        truth: trajectory file.
        truth_sigmas: of the true poses, metres and degrees; None where they are exact.
        disparity_error: that its calibration makes and that is mended, pixels.
    """

    name: str
    source: Path
    truth: Path
    truth_sigmas: tuple[float, float] | None = None
    disparity_error: float = 0.0

    @property
    def exact(self) -> bool:
        return self.truth_sigmas is None

    def open(self) -> StereoSequence:
        """The sequence; where the truth is exact, its calibration is."""
        sequence = open_rendered(self.source) if self.exact else open_sequence(self.source)
        if self.disparity_error:
            # A disparity is u_left - u_right: where it is too large, the right camera's centre is further left.
            right = sequence.camera.right
            sequence.camera = replace(sequence.camera, right=replace(right, cx=right.cx - self.disparity_error))
        return sequence


def write_sequences(
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
        methods, sequences: of `METHODS` and `SEQUENCES`, all unless given.
    Raises:
        InputError: a name is unknown, or `data` does not hold the sequences.
    """
    results = run_sequences(data, methods, sequences, renders, note)
    return write_results_page(path, results, lambda found, complete: format_results(found, command, complete))


def run_sequences(
    data: Path | None,
    methods: Sequence[str] = METHODS,
    sequences: Sequence[str] | None = None,
    renders: Path | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> Iterator[SequenceResult | Omission]:
    """Runs and evaluates everything, one at a time; see `write_sequences`."""
    check_names("method", methods, METHODS)
    check_names("sequence", sequences or (), SEQUENCES)
    wanted = sequences or [name for name in SEQUENCES if data is not None or name not in REAL_NAMES]
    real = [name for name in wanted if name in REAL_NAMES]
    missing = [name for name in real if data is None or not (data / name).is_dir()]
    if missing:
        raise InputError(
            f"{data or 'no folder'} does not hold {', '.join(missing)}: give the folder of the data sets with --data"
        )
    with ExitStack() as stack:
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        demo = stack.enter_context(as_file(files("sigmaslam_synthetic") / "demo"))
        jobs = [_BenchmarkSequence("demo", demo, demo / "poses.txt")] if "demo" in wanted else []
        for name in RENDERED:
            if name in wanted:
                try:
                    jobs.append(_render(name, renders or scratch / "renders", note))
                except ImportError as error:
                    reason = f"{error.name} is not installed: pip install 'sigmaslam[train]'"
                    yield Omission(name, "", reason)
        if data is not None:
            jobs += [
                _BenchmarkSequence(name, data / name, data / name / truth, sigmas)
                for name, truth, sigmas in REAL
                if name in wanted
            ]
        for number, job in enumerate(jobs):
            runs = scratch / str(number)
            for method in METHODS:
                if method not in methods:
                    continue
                result = _run(job, method, runs)
                yield result
                label = f"{job.name}: {method_label(method)}"
                if isinstance(result, Omission):
                    note(f"{label} is left out: {result.reason}")
                else:
                    note(f"{label}, ATE {ate_cell(result)} m, {total_cell(result)} ms")


def _render(name: str, folder: Path, note: Callable[[str], None]) -> _BenchmarkSequence:
    """Renders a sequence; frames that are there are kept."""
    from sigmaslam_benchmarks.tracking.consistency import OFFSET, SCALES
    from sigmaslam_synthetic.render_sequence import default_workers
    from sigmaslam_synthetic.simulation import Recipe

    preset = "street" if name == CALIBRATED else name
    (scale,) = (scale for scale in SCALES if scale.preset == preset)
    recipe = Recipe(preset, FRAMES, _SEED, disparity_offset=OFFSET, width=scale.width, height=scale.height)
    began = time.perf_counter()
    out = render(folder, recipe, default_workers())
    note(f"{preset} rendered in {time.perf_counter() - began:.0f} s")
    return _BenchmarkSequence(name, out, out / "poses.txt", disparity_error=OFFSET if name == CALIBRATED else 0.0)


def _run(job: _BenchmarkSequence, method: str, runs: Path) -> SequenceResult | Omission:
    if method == "bundle":
        return _adjust(job, runs)
    try:
        trial = Trial(job.open(), job.truth, _TRIED[method], job.truth_sigmas).run(runs / method)
    except (MissingPeerError, BrokenProcessPool) as error:
        return Omission(job.name, method, str(error))
    nees = trial.evaluation.nees.mean if job.exact and trial.evaluation.nees else np.nan
    of_step = None
    if method == "cuvslam" and job.exact:
        covariances = read_covariances(runs / method / "covariance.npy", len(trial.trajectory))
        of_step = step_nees(trial.trajectory, read_trajectory(job.truth), covariances)
    return SequenceResult(job.name, method, trial, nees, truth_sigmas=job.truth_sigmas, step_nees=of_step)


def _adjust(job: _BenchmarkSequence, runs: Path) -> SequenceResult | Omission:
    """Bundle adjustment of the tracks of ours."""
    run, out = runs / "ours", runs / "bundle"
    if not run.is_dir():
        _track_ours(job.open(), run)
    try:
        refined = refine_run(run, out)
    except SigmaSlamError as error:
        # No GTSAM, or nothing to adjust: a camera at rest has one keyframe.
        return Omission(job.name, "bundle", str(error))
    trial = read_trial(out, job.truth)
    return SequenceResult(job.name, "bundle", trial, _keyframe_nees(trial, run) if job.exact else np.nan, refined)


def _keyframe_nees(adjusted_trial: TrialResult, run: Path) -> float:
    """Of the keyframes alone: the others have the covariance of the keyframe before."""
    with np.load(run / TRACKS_NAME) as tracks:
        keyframes = np.unique(tracks["frame"])
    times = adjusted_trial.trajectory.timestamps[keyframes]
    nees = adjusted_trial.evaluation.nees
    if nees is None:
        return float("nan")
    adjusted = np.isin(nees.timestamps, times)
    return float(nees.per_frame[adjusted].mean()) if adjusted.any() else float("nan")
