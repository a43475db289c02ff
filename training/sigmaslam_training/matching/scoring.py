"""Scorer and verifier in one run: pairs, both trainings, calibration, weights and card."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress

from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_68_OF_2, CHI_SQUARE_95
from sigmaslam.files import atomic_write_json, atomic_write_text, make_folder
from sigmaslam.progress import open_progress
from sigmaslam_evaluation.metrics import probability_calibration as calibration
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT
from sigmaslam_models.scorer_network import MatchScorer
from sigmaslam_models.verifier_network import MatchVerifier
from sigmaslam_training.devices import describe_processor
from sigmaslam_training.features.validation import held_out_seed
from sigmaslam_training.matching.match_sets import PairRecord, load_record, record_path, write_records
from sigmaslam_training.matching.place_rows import collect_place_rows
from sigmaslam_training.matching.scorer_training import make_sample, score_set, train_scorer
from sigmaslam_training.matching.verifier_training import VerifierRows, calibrate, collect_rows, train_verifier
from sigmaslam_training.run_card import describe_origin
from sigmaslam_training.snapshot import save_tensors

SCORER_NAME, VERIFIER_NAME, CARD_NAME = "scorer.safetensors", "verifier.safetensors", "matching.json"
PLACE_VERIFIER_NAME = "place_verifier.safetensors"
_CONFIG_NAME, _SECONDS_NAME = "config.json", "seconds.txt"
_SCORER_CHECKPOINT = "scorer_checkpoint.safetensors"
_HELD_OUT_SHARE = 0.1
_SHOW_EVERY = 20
_LIMITS = [
    "learned from renders alone; matches of our features, SIFT and ORB",
    "a moving object's matches are right matches: whether they move with the scene is asked by the estimator",
    "the covariance holds for right matches; errors of the calibration of a camera are not in it",
]


@dataclass(frozen=True, slots=True)
class ScoringConfig:
    """What one run is made of.

    Attributes:
        pairs: rendered pairs to learn from; a tenth as many others calibrate and measure.
        steps: of the scorer's optimiser, 8 sets each.
        verifier_steps: of that of either verifier, 4,096 matches each.
        seed: of everything.
    """

    pairs: int = 2400
    steps: int = 4000
    verifier_steps: int = 6000
    seed: int = 0


def train_scoring(out: Path, config: ScoringConfig, workers: int) -> dict[str, Any]:
    """Makes the weights of scorer and both verifiers, and matching.json, in `out`; returns the card.

    What an interrupted run of the same configuration left there is used.

    Args:
        out: run folder.
        workers: processes that make pairs.
    Raises:
        InputError: the folder holds a run of another configuration, or something else.
    """
    _claim(out, config)
    # Before the run: the tree may move on while it lasts.
    origin = describe_origin([out])
    clock = _Clock(out / _SECONDS_NAME)
    torch.set_num_threads(1)
    with open_progress() as progress:
        folders = [
            _make_records(progress, out / name, seed, count, workers)
            for name, seed, count in (
                ("pairs", config.seed, config.pairs),
                ("held_out", held_out_seed(config.seed), max(8, round(_HELD_OUT_SHARE * config.pairs))),
            )
        ]
        clock.seconds()
        sets = [match_set for record in map(load_record, folders[0]) for match_set in record.sets.values()]
        told = _open_bar(progress, "training the scorer", config.steps)
        scorer = train_scorer(sets, config.steps, config.seed, out / _SCORER_CHECKPOINT, told)
        clock.seconds()
        metrics = _scorer_metrics(scorer, folders[1])
        rows = _collect(progress, folders, lambda records, note: collect_rows(records, scorer, note))
        verifier = _train_verifier(progress, out / VERIFIER_NAME, config, rows, metrics, "")
        rows = _collect(progress, folders, lambda records, note: collect_place_rows(records, config.seed, note))
        place_verifier = _train_verifier(progress, out / PLACE_VERIFIER_NAME, config, rows, metrics, "place_")
    networks = {"scorer": scorer, "verifier": verifier, "place_verifier": place_verifier}
    card = _make_card(origin, config, networks, metrics, clock.seconds())
    for name, network in zip((SCORER_NAME, VERIFIER_NAME, PLACE_VERIFIER_NAME), networks.values(), strict=True):
        save_tensors(out / name, network.state_dict())
    atomic_write_json(out / CARD_NAME, card)
    return card


class _Clock:
    """Seconds that a run has taken, over all its parts."""

    def __init__(self, path: Path) -> None:
        self._path = path
        before = float(path.read_text()) if path.is_file() else 0.0
        self._began = time.monotonic() - before

    def seconds(self) -> float:
        """So far; remembered for the next part."""
        seconds = time.monotonic() - self._began
        atomic_write_text(self._path, f"{seconds:.1f}\n")
        return seconds


def _claim(out: Path, config: ScoringConfig) -> None:
    path = out / _CONFIG_NAME
    if path.is_file():
        try:
            before = json.loads(path.read_text())
        except ValueError as error:
            raise InputError(f"{path} cannot be read ({error}): give another --out") from error
        if before != asdict(config):
            raise InputError(f"{out} holds a run of {before}, not of {asdict(config)}: give another --out")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} is not empty: give a new folder with --out")
    make_folder(out)
    atomic_write_json(path, asdict(config))


def _make_records(progress: Progress, folder: Path, seed: int, count: int, workers: int) -> list[Path]:
    task = progress.add_task(f"rendering {folder.name.replace('_', ' ')}", total=count, note="")
    for done in write_records(folder, seed, count, workers):
        progress.update(task, completed=done)
    return [record_path(folder, index) for index in range(count)]


def _collect(
    progress: Progress,
    folders: list[list[Path]],
    collect: Callable[[Iterator[PairRecord], Callable[[int], None]], VerifierRows],
) -> list[VerifierRows]:
    def of(paths: list[Path]) -> VerifierRows:
        task = progress.add_task("refining matches", total=len(paths), note="")
        return collect(map(load_record, paths), lambda done: progress.update(task, completed=done))

    return [of(paths) for paths in folders]


def _train_verifier(
    progress: Progress,
    weights: Path,
    config: ScoringConfig,
    rows: list[VerifierRows],
    metrics: dict[str, float],
    prefix: str,
) -> MatchVerifier:
    """A verifier of the rows of pairs and of held-out ones; its figures are added to the metrics."""
    learnt, held_out = rows
    name = weights.stem.replace("_", " ")
    told = _open_bar(progress, f"training the {name}", config.verifier_steps)
    checkpoint = weights.with_name(f"{weights.stem}_checkpoint.safetensors")
    verifier = train_verifier(learnt, config.verifier_steps, config.seed, checkpoint, told)
    # Pairs in turn calibrate and measure.
    calibrate(verifier, held_out.select(held_out.pair % 2 == 0))
    figures = _verifier_metrics(verifier, held_out.select(held_out.pair % 2 == 1))
    metrics |= {f"{prefix}{key}": value for key, value in figures.items()}
    return verifier


def _scorer_metrics(scorer: MatchScorer, paths: list[Path]) -> dict[str, float]:
    """Means over the sets of one kind that have at least 8 right and 8 wrong matches."""
    by_kind: dict[str, list[tuple[float, ...]]] = {}
    for record in map(load_record, paths):
        for kind, of_kind in record.sets.items():
            _, _, side, _, error = make_sample(of_kind)
            right = error < RIGHT
            if min(right.sum(), (~right).sum()) < 8:
                continue
            logit = score_set(scorer, of_kind)
            accepted = logit > 0
            f1 = 2.0 * (right & accepted).sum() / (right.sum() + accepted.sum())
            baseline = 10.0 * side[:, 3] - side[:, 4]
            precisions = [calibration.average_precision(score, right) for score in (logit, baseline)]
            values = *precisions, calibration.auroc(logit, right), f1
            by_kind.setdefault(kind, []).append(values)
    names = ("average_precision", "mutual_ratio_average_precision", "auroc", "f1")
    return {
        f"{kind}_{name}": float(np.mean([each[k] for each in values]))
        for kind, values in by_kind.items()
        for k, name in enumerate(names)
    }


def _verifier_metrics(verifier: MatchVerifier, rows: VerifierRows) -> dict[str, float]:
    with torch.no_grad():
        logit, log_sigma = (values.numpy() for values in verifier(torch.from_numpy(rows.inputs)))
    right = rows.right
    sigma, error = np.exp(log_sigma[right]), rows.error[right]
    square = ((error / sigma) ** 2).sum(axis=1)
    length, size = np.linalg.norm(error, axis=1), np.linalg.norm(sigma, axis=1)
    return {
        "verified_auroc": calibration.auroc(logit, right),
        "expected_calibration_error": calibration.calibration_error(1.0 / (1.0 + np.exp(-logit)), right),
        "spearman_sigma_error": calibration.spearman(size, length),
        "best_half_rms": calibration.best_half(size, length),
        "inside_95_ellipse": float((square < CHI_SQUARE_95[2]).mean()),
        "inside_68_ellipse": float((square < CHI_SQUARE_68_OF_2).mean()),
    }


def _make_card(
    origin: dict[str, str],
    config: ScoringConfig,
    networks: dict[str, torch.nn.Module],
    metrics: dict[str, float],
    seconds: float,
) -> dict[str, Any]:
    return {
        "config": asdict(config),
        "seed": config.seed,
        **origin,
        "duration_s": round(seconds, 1),
        "hardware": describe_processor(),
        "parameters": {name: sum(p.numel() for p in network.parameters()) for name, network in networks.items()},
        "data": "renders alone, no photograph: planes, scenes, stereo pairs, video; our features, SIFT and ORB",
        "limits": _LIMITS,
        "metrics_on_held_out_renders": {name: round(value, 4) for name, value in metrics.items()},
    }


def _open_bar(progress: Progress, title: str, steps: int) -> Callable[[int, str], None]:
    """A bar for a training; returns what is to be told of every step and its loss."""
    task = progress.add_task(title, total=steps, note="")

    def show(step: int, note: str) -> None:
        progress.update(task, completed=step)
        if step % _SHOW_EVERY == 0:
            progress.update(task, note=note)

    return show
