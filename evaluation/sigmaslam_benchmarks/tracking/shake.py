"""A shaken camera with a slow shutter: whether frames that are called tracked are right, beside KLT + PnP."""

import os
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path

import numpy as np

from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.runs.request import TrackerOptions
from sigmaslam_benchmarks.code_hash import hash_once
from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.tracking.claimed_errors import motion_errors
from sigmaslam_benchmarks.tracking.image_motion import ImageMotion, read_image_motion
from sigmaslam_benchmarks.tracking.shake_page import GROSS, ShakenSequence, ShakeResult, format_page
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.tracking.trial_pool import SequenceTrials, TrialKind, write_trials
from sigmaslam_benchmarks.trial import Method, Trial, track_ours
from sigmaslam_evaluation.metrics.trajectory_errors import coverage
from sigmaslam_evaluation.truth_conventions import find_truth
from sigmaslam_synthetic.presets import PRESETS
from sigmaslam_synthetic.render_choices import CARRIED
from sigmaslam_synthetic.simulation import Recipe

METHODS: dict[str, Method] = {
    "ours": partial(track_ours, tracker=TrackerOptions(threads=1)),
    "KLT + PnP": partial(track_with_peer, name="klt-pnp"),
}
"""The first is what goals are for."""
FRAMES = 60
MOVERS = 0.3
"""Share of the image that moves on its own in every second sequence."""
_FIRST_SEED = 43000  # seeds below were looked at while the tracker was made
_MOTION = "image motion"  # kept beside the methods' results


def write_shake(
    path: Path,
    runs: Path,
    seeds: int,
    workers: int,
    command: str,
    ray: str | None = None,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Renders and tracks what is missing, writes the page and returns it; notes in it are kept.

    Args:
        ray: of `write_trials`, and what it raises.
        seeds: sequences, of the worlds in turn; every second one has movers.
    """

    def form(done: list[SequenceTrials], missing: list[str]) -> str:
        sequences = {_describe(trials): trials for trials in done}
        results = {
            method: {sequence: ShakeResult(**trials.read(method) or {}) for sequence, trials in sequences.items()}
            for method in METHODS
        }
        return format_page(results, FRAMES, (_FIRST_SEED, seeds), command, missing)

    kind = TrialKind([_MOTION, *METHODS], _judge, partial(hash_once, Path(__file__)))
    recipes = [recipe(k, _FIRST_SEED) for k in range(seeds)]
    return write_trials(path, runs, kind, recipes, form, workers, ray, note)


def _describe(trials: SequenceTrials) -> ShakenSequence:
    """What the page says of a sequence itself."""
    recipe, preset = trials.recipe, PRESETS[trials.recipe.preset]
    size = (recipe.width or preset.width, recipe.height or preset.height)
    return ShakenSequence(recipe.name, size, recipe.movers, ImageMotion(**trials.read(_MOTION) or {}))


def recipe(number: int, first_seed: int) -> Recipe:
    """Of a sequence by its number from 0 on: two of each world, the second with movers."""
    preset, movers = CARRIED[number // 2 % len(CARRIED)], MOVERS * (number % 2)
    return Recipe(preset, FRAMES, first_seed + number, "shaken", movers, "slow")


def judge(source: Path, method: Method) -> ShakeResult:
    """Tracks a rendered folder and holds it against its truth."""
    truth = find_truth(source)
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
    )


def _judge(source: Path, recipe: Recipe, method: str) -> ImageMotion | ShakeResult:
    return read_image_motion(source) if method == _MOTION else judge(source, METHODS[method])


def _wrong(sigmas: np.ndarray, tracked: np.ndarray) -> list[int]:
    return np.flatnonzero((sigmas > GROSS) & tracked).tolist()
