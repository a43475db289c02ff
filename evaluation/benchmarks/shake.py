"""A shaken camera with a slow shutter: whether frames that are called tracked are right, beside KLT + PnP."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np

from sigmaslam.evaluation.benchmarks import pnp_baselines
from sigmaslam.evaluation.benchmarks.page import write_page
from sigmaslam.evaluation.benchmarks.pnp_baselines import track_with_pnp
from sigmaslam.evaluation.benchmarks.shake_page import GROSS, ShakenSequence, ShakeResult, format_page
from sigmaslam.evaluation.benchmarks.trial_pool import run_trials
from sigmaslam.evaluation.metrics.claimed_errors import MotionErrors, motion_errors
from sigmaslam.evaluation.metrics.image_motion import ImageMotion, read_image_motion
from sigmaslam.evaluation.metrics.map_consistency import coverage
from sigmaslam.evaluation.rendered_camera import open_rendered
from sigmaslam.evaluation.trial import Method, Trial, TrialCache, hash_code, render, rendered_truth
from sigmaslam.files import make_folder
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.runs.track import track_sequence
from sigmaslam.slam.tracker import TrackerConfig
from sigmaslam.synthetic.presets import PRESETS
from sigmaslam.synthetic.render_choices import CARRIED
from sigmaslam.synthetic.simulation import Recipe

METHODS: dict[str, Method] = {
    "ours": partial(track_sequence, threads=1),
    "KLT + PnP": partial(track_with_pnp, matcher="klt"),
}
"""The first is what goals are for."""
FRAMES = 60
MOVERS = 0.3
"""Share of the image that moves on its own in every second sequence."""
_FIRST_SEED = 1000  # seeds below were looked at while the tracker was made
_MOTION = "image motion"  # kept beside the methods' results


@dataclass(frozen=True, slots=True)
class _ShakeTrials:
    """One sequence, with all methods."""

    cache: TrialCache
    recipe: Recipe

    def read(self, method: str) -> ShakeResult | None:
        """The result that is kept, unless it is of something else."""
        figures = self.cache.read(self.recipe, method, TrackerConfig())
        return None if figures is None else ShakeResult(**figures)

    def sequence(self) -> ShakenSequence | None:
        """What the page says of the sequence itself, if that is kept."""
        figures = self.cache.read(self.recipe, _MOTION, TrackerConfig())
        if figures is None:
            return None
        preset = PRESETS[self.recipe.preset]
        size = (self.recipe.width or preset.width, self.recipe.height or preset.height)
        name = f"{self.recipe.preset}{self.recipe.seed}"
        return ShakenSequence(name, size, self.recipe.movers, ImageMotion(**figures))

    @property
    def complete(self) -> bool:
        """Nothing is missing."""
        return self.sequence() is not None and all(self.read(method) is not None for method in METHODS)


def write_shake(
    path: Path, runs: Path, seeds: int, workers: int, command: str, note: Callable[[str], None] = lambda text: None
) -> str:
    """Renders and tracks what is missing, writes the page and returns it; notes in it are kept.

    A result is used again when it comes from the same recipe and code.

    Args:
        path: Markdown page.
        runs: folder for renders and results.
        seeds: sequences, of the worlds in turn; every second one has movers.
        workers: processes; each takes a sequence at a time.
        command: what the page says it was made by.
        note: is told of progress.
    """
    make_folder(runs)
    cache = TrialCache(runs, hash_code(Path(__file__), Path(pnp_baselines.__file__)))
    jobs = [_ShakeTrials(cache, recipe(k, _FIRST_SEED)) for k in range(seeds)]
    run_trials(_make, [job for job in jobs if not job.complete], len(jobs), workers, note)
    found = [(sequence, job) for job in jobs if (sequence := job.sequence())]
    results = {
        method: {sequence: result for sequence, job in found if (result := job.read(method))} for method in METHODS
    }
    return write_page(path, format_page(results, FRAMES, _FIRST_SEED, command))


def recipe(number: int, first_seed: int) -> Recipe:
    """Of a sequence by its number from 0 on: two of each world, the second with movers."""
    preset, movers = CARRIED[number // 2 % len(CARRIED)], MOVERS * (number % 2)
    return Recipe(preset, FRAMES, first_seed + number, "shaken", movers, "slow")


def judge(source: Path, method: Method) -> ShakeResult:
    """Tracks a rendered folder and holds it against its truth."""
    truth = rendered_truth(source)
    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch) / "run"
        with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
            trial = Trial(open_rendered(source), truth, method).run(run)
        covariance = np.load(run / "covariance.npy")
    evaluation, estimate, true = trial.evaluation, trial.trajectory, read_trajectory(truth)
    assert evaluation.nees is not None
    rate = round(1.0 / float(np.median(np.diff(estimate.timestamps))))
    step, second, start = (motion_errors(estimate, true, covariance, frames) for frames in (1, rate, None))
    tracked = trial.tracked_poses
    tracked[0] = False
    return ShakeResult(
        tracking=int(tracked.sum()),
        lost=len(trial.table) - 1 - int(tracked.sum()),
        ate=evaluation.ate.rmse,
        path_length=evaluation.path_length,
        nees=evaluation.nees.mean,
        inside=coverage(evaluation.nees.per_frame, 6),
        wrong_step=_wrong(step, tracked),
        wrong_second=_wrong(second, tracked),
        wrong_start=_wrong(start, tracked),
        worst_step=_largest(step.sigmas[tracked]),
        worst_second=_largest(second.sigmas[tracked]),
        worst_start=_largest(start.sigmas[tracked]),
        step_metres=_largest(step.metres[tracked]),
        step_degrees=_largest(step.degrees[tracked]),
    )


def _make(job: _ShakeTrials) -> str:
    """Renders and tracks what is missing of one sequence; says how long both took."""
    began = time.perf_counter()
    source = render(job.cache.folder, job.recipe, 1)
    rendered = time.perf_counter()
    job.cache.write(job.recipe, _MOTION, TrackerConfig(), asdict(read_image_motion(source)))
    missing = [method for method in METHODS if job.read(method) is None]
    for method in missing:
        job.cache.write(job.recipe, method, TrackerConfig(), asdict(judge(source, METHODS[method])))
    tracked = time.perf_counter()
    return f"{source.name}, rendered in {rendered - began:.0f} s, {len(missing)} methods in {tracked - rendered:.0f} s"


def _wrong(errors: MotionErrors, tracked: np.ndarray) -> list[int]:
    return np.flatnonzero((errors.sigmas > GROSS) & tracked).tolist()


def _largest(values: np.ndarray) -> float:
    values = values[np.isfinite(values)]
    return float(values.max()) if len(values) else float("nan")
