"""What the network gains from its size, its stride and its data: short runs, several seeds, judged on real images.

Choices are made on the sets of `matching.SELECTION` alone; the other sets are never touched here.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.evaluation.benchmarks.page import header, row, write_page
from sigmaslam.evaluation.matching.extractors import LearnedExtractor
from sigmaslam.evaluation.matching.score_sets import Scores, score
from sigmaslam.evaluation.matching.sets import SELECTION
from sigmaslam.files import atomic_write_text, make_folder

if TYPE_CHECKING:
    from sigmaslam.training.features.recipes import TrainingConfig

# What a choice is made by: the mean of these over the sets of SELECTION.
_CHOSEN_BY = ("mma_1", "mma_3")
_MADE_WITH = "made_with.json"
_BATCH, _SIZE = 8, 192  # pairs a step and side of the images, less than in a full training
_SHOWN = {
    "set12": ("mma_1", "mma_3", "repeatability_1", "auc_3"),
    "middlebury": ("mma_1", "mma_3", "repeatability_1"),
}


@dataclass(frozen=True, slots=True)
class Variant:
    """One thing that is done otherwise than by default.

    Attributes:
        question: what is compared with it.
        name: of the variant.
        training: fields of `TrainingConfig` that differ.
    """

    question: str
    name: str
    training: dict[str, Any] = field(default_factory=dict)


VARIANTS = (
    Variant("", "default"),
    Variant("descriptor", "32 numbers", {"descriptor_size": 32}),
    Variant("descriptor", "128 numbers", {"descriptor_size": 128}),
    Variant("stride", "8", {"stride": 8}),
    Variant("stride", "16", {"stride": 16}),
    Variant("data", "blend (3 leaves, 1 scene)", {"data": "blend"}),
    Variant("data", "turned (2 turned leaves, 1 leaves, 1 scene)", {"data": "turned"}),
)


def write_ablations(
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
        runs: folder of the training runs, one a configuration and seed; finished ones are not repeated.
        data: folder of the real data sets.
        seeds: runs of each variant, seeds from 0 up.
        steps: optimiser steps of each.
        command: that makes the page again.
        note: told what is being done.
    """
    _check_runs(runs, steps)
    # One seed of every variant first: what is there when it is stopped can be compared.
    for seed in range(seeds):
        for variant in VARIANTS:
            _train_missing(runs, variant, seed, steps, note)
    results = [
        (variant, [_scores(_run(runs, variant, seed, steps), variant, data, note) for seed in range(seeds)])
        for variant in VARIANTS
    ]
    lines = [
        "# What each part of the features gains",
        "",
        f"`{command}`:",
        f"{steps} steps of {_BATCH} pairs at {_SIZE}x{_SIZE} a run, {seeds} seeds a variant; mean and standard",
        "deviation over the seeds, percent. At most 1,024 keypoints, long side 640, mutual nearest neighbours.",
        "Variants differ from the default in one thing, and are chosen by the",
        f"mean of {' and '.join(_CHOSEN_BY)} over {' and '.join(SELECTION)}.",
        "",
        *_table(results),
        "",
    ]
    return write_page(out, "\n".join(lines))


def selection_score(scores: Scores) -> float:
    """What is chosen by, in [0, 1]."""
    return float(np.mean([scores[name][key] for name in SELECTION for key in _CHOSEN_BY]))


def configuration(variant: Variant, seed: int, steps: int) -> TrainingConfig:
    """The short run of a variant."""
    from sigmaslam.training.features.recipes import TrainingConfig

    return TrainingConfig(steps=steps, batch_size=_BATCH, size=_SIZE, seed=seed, validate_every=0, **variant.training)


def _check_runs(runs: Path, steps: int) -> None:
    """Refuses runs that were made with another network or another training."""
    from sigmaslam.models.feature_network import FeatureNetwork

    network = {name: list(value.shape) for name, value in FeatureNetwork().state_dict().items()}
    made_with = {"network": network, "training": asdict(configuration(VARIANTS[0], 0, steps))}
    path = runs / _MADE_WITH
    if not path.is_file() and (not runs.exists() or not any(runs.iterdir())):
        make_folder(runs)
        atomic_write_text(path, json.dumps(made_with) + "\n")
    if not path.is_file() or json.loads(path.read_text(encoding="utf-8")) != made_with:
        raise InputError(f"the runs in {runs} were made with another network or training: give another --runs")


def _train_missing(runs: Path, variant: Variant, seed: int, steps: int, note: Callable[[str], None]) -> None:
    from sigmaslam.training.features.checkpoint import CHECKPOINT_NAME
    from sigmaslam.training.features.loop import WEIGHTS_NAME, train

    folder = _run(runs, variant, seed, steps)
    if not (folder / WEIGHTS_NAME).is_file():
        note(f"training {folder.name}")
        config = configuration(variant, seed, steps)
        train(folder, config, workers=0, resume=(folder / CHECKPOINT_NAME).is_file())


def _run(runs: Path, variant: Variant, seed: int, steps: int) -> Path:
    parts = [f"{name}_{value}" for name, value in variant.training.items()]
    return runs / "-".join([*(parts or ["default"]), str(steps), str(seed)])


def _scores(run: Path, variant: Variant, data: Path, note: Callable[[str], None]) -> Scores:
    """Scores of a variant, kept beside the weights of its run."""
    kept = run / "scores.json"
    if not kept.is_file():
        note(f"scoring {run.name}")
        scores = score(_extractor(run, variant), SELECTION, data)
        atomic_write_text(kept, json.dumps(scores, indent=1) + "\n")
    content: Scores = json.loads(kept.read_text(encoding="utf-8"))
    return content


def _extractor(run: Path, variant: Variant) -> LearnedExtractor:
    from sigmaslam.models.extractor import FeatureExtractor
    from sigmaslam.models.feature_network import DESCRIPTOR_SIZE, STRIDE
    from sigmaslam.models.onnx_export import load_network
    from sigmaslam.models.torch_runtime import TorchModule
    from sigmaslam.training.features.loop import WEIGHTS_NAME

    size, stride = (
        int(variant.training.get(key, default))
        for key, default in (("descriptor_size", DESCRIPTOR_SIZE), ("stride", STRIDE))
    )
    network = load_network(run / WEIGHTS_NAME, size, stride)
    return LearnedExtractor(TorchModule(FeatureExtractor(network)))


def _table(results: Sequence[tuple[Variant, list[Scores]]]) -> Iterator[str]:
    columns = [(name, key) for name in SELECTION for key in _SHOWN[name]]
    names = (f"{name} {key}" for name, key in columns)
    yield from header("question", "variant", "**choice**", *names, numbers_from=2)
    for variant, runs in results:
        cells = [_spread([selection_score(scores) for scores in runs])]
        cells += [_spread([scores[name][key] for scores in runs]) for name, key in columns]
        yield row(variant.question, variant.name, *cells)


def _spread(values: Sequence[float]) -> str:
    shares = 100 * np.array(values)
    return f"{shares.mean():.1f} ± {shares.std(ddof=1):.1f}" if len(shares) > 1 else f"{shares[0]:.1f}"
