"""Trials of a quick method, as functions of a module, which workers can import."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from sigmaslam_benchmarks.rendered_camera import open_rendered
from sigmaslam_benchmarks.tracking.stereo_peers import track_with_peer
from sigmaslam_benchmarks.trial import Trial
from sigmaslam_evaluation.truth_conventions import find_truth
from sigmaslam_synthetic.simulation import Recipe

METHODS = ["KLT + PnP"]


@dataclass(frozen=True, slots=True)
class ErrorFigures:
    """Errors of a trial, metres and degrees."""

    ate: float
    translations: list[float]
    rotations: list[float]


def judge_klt(source: Path, recipe: Recipe, method: str) -> ErrorFigures:
    """KLT + PnP on a rendered sequence; one seed is refused."""
    if recipe.seed == 13:
        raise ValueError("13 is unlucky")
    trial = Trial(
        open_rendered(source), find_truth(source), lambda sequence, out: track_with_peer(sequence, out, "klt-pnp")
    )
    evaluation = trial.run().evaluation
    steps = evaluation.rpe
    return ErrorFigures(evaluation.ate.rmse, steps.translations.tolist(), steps.rotations_deg.tolist())


def hash_nothing() -> str:
    """The code does not change while a test runs."""
    return "code"


def hash_process() -> str:
    """As if each process had code of its own."""
    return str(os.getpid())
