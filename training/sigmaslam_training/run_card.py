"""The card of a run: what the weights were made of, by what, and how good they are."""

import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sigmaslam_synthetic.worlds.own import SUFFIX
from sigmaslam_training.devices import Workplace, describe_hardware
from sigmaslam_training.features.checkpoint import TrainingState
from sigmaslam_training.features.recipes import TrainingConfig
from sigmaslam_training.source_commit import current_commit
from sigmaslam_training.sources import SOURCES, label, turns_of

CARD_NAME = "features.json"
_LIMITS = [
    "grey images from 96 pixels a side; turned and scaled against each other as far as the training pairs are",
    "textures of renders: very dark, very noisy and textureless images give few keypoints",
    "sigma is learned from renders and not calibrated on real images; it is too large after refinement",
]


def describe_origin(hidden: list[Path]) -> dict[str, str]:
    """Commit and command of this process.

    Args:
        hidden: paths of the command of which the name alone is told: where they lay is nobody's business.
    """
    names = {str(path): path.resolve().name for path in hidden}

    def shortened(argument: str) -> str:
        option, equals, value = argument.rpartition("=")  # --out=PATH, or PATH alone
        return option + equals + names.get(value, value)

    return {"commit": current_commit(), "command": " ".join(["sigmaslam", *map(shortened, sys.argv[1:])])}


def make_card(state: TrainingState, place: Workplace) -> dict[str, Any]:
    """The card of a finished run.

    Args:
        state: at its end.
        place: where it ended.
    """
    return {
        "recipe": state.recipe,
        "started_from": state.started_from,
        "config": {**asdict(state.config), "shares": _by_label(state.config.shares)},
        "seed": state.config.seed,
        **state.origin,
        "duration_s": round(state.seconds, 1),
        "hardware": describe_hardware(place),
        "parameters": sum(p.numel() for p in state.network.parameters()),
        "data": _describe_data(state.config),
        "limits": _LIMITS,
        "metrics_on_held_out_renders": {k: round(v, 4) for k, v in state.metrics.items()},
    }


def _describe_data(config: TrainingConfig) -> str:
    turns = turns_of(config.mix)
    own = any(source not in SOURCES and not source.endswith(SUFFIX) for source in turns)
    kind = "renders and the user's photographs" if own else "renders alone, no photograph"
    if isinstance(config.mix, str):
        return f"{kind}: {', '.join(turns)} in turn"
    shares = ", ".join(f"{share:g} {name}" for name, share in _by_label(config.shares).items())
    return f"{kind}: {shares}"


def _by_label(shares: Mapping[str, float]) -> dict[str, float]:
    return {label(source): share for source, share in shares.items()}
