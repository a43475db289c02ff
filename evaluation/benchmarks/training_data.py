"""What the network should learn from: short runs on each mix of renders, several seeds, judged on real images.

The mix is chosen on the sets of `matching.SELECTION` alone; the other sets are scored once afterwards, for the record.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sigmaslam.evaluation.benchmarks.page import write_page
from sigmaslam.evaluation.matching.extractors import load_extractor
from sigmaslam.evaluation.matching.run import Scores, score
from sigmaslam.evaluation.matching.sets import FINAL, SELECTION
from sigmaslam.files import atomic_write_text

# What the choice is made by: the mean of these over the sets of SELECTION.
_CHOSEN_BY = ("mma_1", "mma_3")
_BATCH, _SIZE = 8, 192  # pairs a step and side of the images, less than in a full training
_SHOWN = {
    "set12": ("mma_1", "mma_3", "repeatability_1", "auc_3"),
    "middlebury": ("mma_1", "mma_3", "repeatability_1"),
    "boat": ("mma_1", "mma_3", "auc_3"),
    "churchill": ("mma_1", "mma_3", "auc_3"),
    "fountain": ("epipolar_1", "pose_auc_5"),
    "kitti": ("rows_1", "gap1_epipolar_1", "gap3_epipolar_1"),
    "euroc": ("rows_1", "next_epipolar_1"),
}


def write_training_data(
    out: Path,
    runs: Path,
    data: Path,
    seeds: int,
    steps: int,
    command: str,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Trains what is missing, scores it and writes the page.

    Args:
        out: Markdown page.
        runs: folder of the training runs, one a mix and seed; finished ones are not repeated.
        data: folder of the real data sets.
        seeds: runs of each mix, seeds from 0 up.
        steps: optimiser steps of each.
        command: that makes the page again.
        note: told what is being done.
    """
    from sigmaslam.training.stream import MIXES

    mixes = list(MIXES)
    train_missing(runs, mixes, seeds, steps, note)
    results = {
        mix: [_scores(_run(runs, mix, seed, steps), SELECTION, data, note) for seed in range(seeds)] for mix in mixes
    }
    chosen = max(mixes, key=lambda mix: np.mean([selection_score(scores) for scores in results[mix]]))
    final = {mix: [_scores(_run(runs, mix, seed, steps), FINAL, data, note) for seed in range(seeds)] for mix in mixes}
    lines = [
        "# What the network should learn from",
        "",
        f"`{command}`:",
        f"{steps} steps of {_BATCH} pairs at {_SIZE}x{_SIZE} a run, {seeds} seeds a mix;",
        "mean and standard deviation over the seeds, percent. At most 1,024 keypoints, long side 640, mutual nearest",
        "neighbours. All runs have the same network, steps and schedule; only the data differ.",
        "",
        f"Chosen by the mean of {' and '.join(_CHOSEN_BY)} over {' and '.join(SELECTION)}: **{chosen}**.",
        "",
        "## The choice",
        "",
        *_table(results, SELECTION, with_choice=True),
        "",
        "## For the record, scored once after the choice",
        "",
        *_table(final, FINAL, with_choice=False),
        "",
    ]
    return write_page(out, "\n".join(lines))


def train_missing(runs: Path, mixes: Sequence[str], seeds: int, steps: int, note: Callable[[str], None]) -> None:
    """Trains every mix with every seed that has no weights yet; stopped runs go on from their checkpoint."""
    from sigmaslam.training.loop import WEIGHTS_NAME, TrainingConfig, train

    # One seed of every mix first: what is there when it is stopped can be compared.
    for seed in range(seeds):
        for mix in mixes:
            folder = _run(runs, mix, seed, steps)
            if not (folder / WEIGHTS_NAME).is_file():
                note(f"training {folder.name}")
                config = TrainingConfig(steps, mix, _BATCH, _SIZE, seed=seed, validate_every=0)
                train(folder, config, workers=1, resume=(folder / "checkpoint.pt").is_file())


def selection_score(scores: Scores) -> float:
    """What a mix is chosen by, in [0, 1]."""
    return float(np.mean([scores[name][key] for name in SELECTION for key in _CHOSEN_BY]))


def _run(runs: Path, mix: str, seed: int, steps: int) -> Path:
    return runs / f"{mix}-{steps}-{seed}"


def _scores(run: Path, sets: Sequence[str], data: Path, note: Callable[[str], None]) -> Scores:
    """Scores of a run, kept beside its weights."""
    from sigmaslam.training.loop import WEIGHTS_NAME

    kept = run / f"scores-{'-'.join(sets)}.json"
    if not kept.is_file():
        note(f"scoring {run.name} on {', '.join(sets)}")
        scores = score(load_extractor(str(run / WEIGHTS_NAME)), sets, data)
        atomic_write_text(kept, json.dumps(scores, indent=1) + "\n")
    content: Scores = json.loads(kept.read_text(encoding="utf-8"))
    return content


def _table(results: dict[str, list[Scores]], sets: Sequence[str], with_choice: bool) -> list[str]:
    columns = [(name, key) for name in sets for key in _SHOWN[name]]
    heads = ["mix", *(["**choice**"] if with_choice else []), *(f"{name} {key}" for name, key in columns)]
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    for mix, runs in results.items():
        cells = [_spread([selection_score(scores) for scores in runs])] if with_choice else []
        cells += [_spread([scores[name][key] for scores in runs]) for name, key in columns]
        lines.append(f"| {mix} | " + " | ".join(cells) + " |")
    return lines


def _spread(values: Sequence[float]) -> str:
    shares = 100 * np.array(values)
    return f"{shares.mean():.1f} ± {shares.std(ddof=1):.1f}" if len(shares) > 1 else f"{shares[0]:.1f}"
