"""Dense reconstruction on renders with exact depth: errors, their intervals, completeness, ghosts of moving bodies."""

import os
import tempfile
from collections.abc import Callable
from contextlib import redirect_stderr
from functools import partial
from pathlib import Path

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.reconstruction.disparity import semi_global_disparity
from sigmaslam.reconstruction.reconstruct import fuse_keyframes
from sigmaslam.reconstruction.recorded_keyframes import open_input, read_recorded_keyframes
from sigmaslam.runs.request import TrackerOptions
from sigmaslam_benchmarks.code_hash import hash_once
from sigmaslam_benchmarks.rendered_camera import open_rendered, read_simulation
from sigmaslam_benchmarks.tracking.depth_accuracy import DepthFigures, JudgedPixels, judge_pixels, summarise
from sigmaslam_benchmarks.tracking.real_disparity import write_real
from sigmaslam_benchmarks.tracking.reconstruction_page import ReconstructedSequence, format_organs, format_page
from sigmaslam_benchmarks.tracking.trial_pool import SequenceTrials, TrialKind, write_trials
from sigmaslam_benchmarks.trial import track_ours
from sigmaslam_synthetic.simulation import Recipe, Studio

SIZES = {"street": (576, 176), "room": (360, 270), "organ": (360, 288)}
"""Worlds, and the size of their images: those of the benchmark `consistency`, whose renders may be copied."""
FRAMES, OFFSET, MOVERS = 30, 0.3, 0.2
"""Of each sequence; disparities exceed what the calibration says by so many pixels; in every second one bodies move."""
FIRST_SEED = 1002  # seeds below were looked at while the reconstruction was made
ORGAN_SEED = 46_002
"""The first of the rigid organs, whose seeds are even."""
MAX_KEYFRAMES = 6
"""Of each sequence so many are judged, spread evenly: their exact depths take most of the time."""
_METHOD = "reconstruction"


def write_reconstruction(
    path: Path,
    runs: Path,
    seeds: int,
    workers: int,
    command: str,
    ray: str | None = None,
    note: Callable[[str], None] = lambda text: None,
    real: bool = False,
    organ: bool = False,
    data: Path | None = None,
) -> str:
    """Renders, tracks and reconstructs what is missing, writes the page and returns it; notes in it are kept.

    Args:
        ray: of `write_trials`, and what it raises.
        seeds: sequences a world.
        real: judge disparities on real truth instead, which takes a minute.
        organ: rigid organs alone, in millimetres.
    """
    if real:
        if data is None:
            raise InputError("--real needs the real data sets: give --data, or set SIGMASLAM_DATA")
        return write_real(path, data, command)

    def form(done: list[SequenceTrials], missing: list[str]) -> str:
        found = [
            ReconstructedSequence(
                trials.recipe.preset,
                trials.recipe.seed,
                trials.recipe.movers,
                DepthFigures(**trials.read(_METHOD) or {}),
            )
            for trials in done
        ]
        return (format_organs if organ else format_page)(found, seeds, command, missing)

    kind = TrialKind([_METHOD], _judge, partial(hash_once, Path(__file__)))
    recipes = [recipe(world, FIRST_SEED + k) for k in range(seeds) for world in SIZES]
    if organ:
        recipes = [recipe("organ", ORGAN_SEED + 2 * k) for k in range(seeds)]
    return write_trials(path, runs, kind, recipes, form, workers, ray, note)


def recipe(world: str, seed: int) -> Recipe:
    """Of a sequence; those of odd seeds have movers."""
    width, height = SIZES[world]
    movers = MOVERS * (seed % 2)
    return Recipe(world, FRAMES, seed, movers=movers, disparity_offset=OFFSET, width=width, height=height)


def judge_reconstruction(source: Path) -> DepthFigures:
    """Tracks a rendered folder, fuses the depths of its keyframes and holds them against the exact ones."""
    simulation = read_simulation(source)
    studio = Studio(simulation, device="cpu")
    moving = np.array([body.path is not None for body in simulation.scene.bodies] + [False])
    with tempfile.TemporaryDirectory() as scratch:
        run = Path(scratch) / "run"
        with Path(os.devnull).open("w") as nowhere, redirect_stderr(nowhere):
            sequence = open_rendered(source)
            track_ours(sequence, run, TrackerOptions(threads=1))
        keyframes = read_recorded_keyframes(run)
        rectifier = StereoRectifier(keyframes.camera)
        pairs: list[np.ndarray] = []

        def match(left: np.ndarray, right: np.ndarray) -> np.ndarray:
            pairs.append(semi_global_disparity(left, right))
            return pairs[-1]

        assert sequence.timestamps is not None
        times = np.asarray(sequence.timestamps)
        numbers = np.flatnonzero(keyframes.is_keyframe)
        spread = np.linspace(0, len(numbers) - 1, min(len(numbers), MAX_KEYFRAMES)).round().astype(np.int64)
        judged = []
        for depth in fuse_keyframes(keyframes, open_input(keyframes), rectifier, match):
            if depth.number not in numbers[spread]:
                continue
            index = int(np.abs(times - keyframes.timestamps[depth.number]).argmin())
            truth = studio.frames(np.array([index]))[0]
            single = pairs[depth.number] - np.float32(keyframes.disparity_offset[depth.number])
            # A body of -1 is the sky, and the last one of the table.
            moves = moving[truth.body]
            judged.append(judge_pixels(depth, single, truth.depth, truth.stereo_visible, moves, rectifier.rectified))
    if not judged:
        raise InputError(f"{source}: no keyframe could be judged: render it again")
    return summarise(JudgedPixels.concatenate(judged), len(judged))


def _judge(source: Path, _: Recipe, __: str) -> DepthFigures:
    return judge_reconstruction(source)
