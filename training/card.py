"""The card of a run: what the weights were made of, by what, and how good they are."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

from sigmaslam.training.checkpoint import TrainingState
from sigmaslam.training.devices import Workplace, describe_hardware
from sigmaslam.training.stream import MIXES

CARD_NAME = "features.json"
_LIMITS = [
    "grey images",
    "rotation and scale as far as the views of the training pairs go",
    "learned from renders alone",
]


def make_card(state: TrainingState, place: Workplace, commit: str, hidden: list[Path]) -> dict[str, Any]:
    """The card of a finished run.

    Args:
        state: at its end.
        place: where it ran.
        commit: of the source tree when it began.
        hidden: paths of the command of which the name alone is told: where they lay is nobody's business.
    """
    command = " ".join(["sigmaslam", *sys.argv[1:]])
    for path in hidden:
        command = command.replace(str(path), path.name)
    return {
        "recipe": state.recipe,
        "started_from": state.started_from,
        "config": asdict(state.config),
        "seed": state.config.seed,
        "commit": commit,
        "command": command,
        "duration_s": round(state.seconds, 1),
        "hardware": describe_hardware(place),
        "parameters": sum(p.numel() for p in state.network.parameters()),
        "data": f"renders alone, no photograph: {', '.join(MIXES[state.config.data])} in turn",
        "limits": _LIMITS,
        "metrics_on_held_out_renders": {k: round(v, 4) for k, v in state.metrics.items()},
    }


def current_commit() -> str:
    """The commit of the source tree, or 'unknown' when installed from a wheel."""
    try:
        result = subprocess.run(
            ["git", "rev-parse", "HEAD"],
            cwd=Path(__file__).resolve().parent,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()
