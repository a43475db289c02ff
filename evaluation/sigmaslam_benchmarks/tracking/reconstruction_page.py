"""The page of the benchmark `reconstruction`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from sigmaslam_benchmarks.tracking.depth_accuracy import DepthFigures
from sigmaslam_benchmarks.tracking.page import header, missing_sequences, opening, row

MOST_RATIO, LEAST_COMPLETENESS, INSIDE = 0.6, 0.6, (0.90, 0.98)
"""Goals: error over the single view's, share of the pixels at rest, share inside the 95 % interval."""
_COLUMNS = ("world", "sequences", "depth error", "single view", "ratio", "inside 95 %", "complete", "gross", "ghosts")


@dataclass(frozen=True, slots=True)
class ReconstructedSequence:
    """A sequence of the page.

    Attributes:
        world: name of the preset.
        seed: of the render.
        movers: share of the image that was asked to move on its own.
        figures: of its keyframes.
    """

    world: str
    seed: int
    movers: float
    figures: DepthFigures


def format_page(
    sequences: Sequence[ReconstructedSequence], seeds: int, command: str, missing: Sequence[str] = ()
) -> str:
    """The page; `missing` are the names of sequences that failed."""
    lines = [
        *opening("Dense reconstruction", command, f". {len(sequences)} rendered sequences"),
        f"with exact depth, {seeds} of each world, seeds from 1002 on (those below were looked at while it was made);",
        "odd seeds have bodies that move on their own. Disparities exceed what the calibration says by 0.3 px.",
        "",
        "A depth error is the median of the absolute errors of the points' depths, as shares of the depth; that of the",
        "single view is of semi-global matching at the same pixels, with the same disparity offset taken off. Inside:",
        "the share of the points inside the 95 % interval of their inverse depth; complete the share of the pixels at",
        "rest, seen by both eyes, that became points; gross the share of points off by more than a tenth of the depth;",
        "ghosts the share of the pixels on moving bodies that became points. Rows of worlds and goals are medians of",
        "sequences; errors of those that have points.",
        *missing_sequences(missing),
        "",
        "## Goals",
        "",
        *header("goal", "found", "reached"),
        *_goals(sequences),
        "",
        "## By world",
        "",
        *header(*_COLUMNS, numbers_from=1),
        *(_world(world, sequences) for world in dict.fromkeys(each.world for each in sequences)),
        "",
        "## By sequence",
        "",
        *header("world", "seed", "movers", *_COLUMNS[2:], numbers_from=1),
        *(row(each.world, str(each.seed), f"{each.movers:g}", *_cells(each.figures)) for each in sequences),
        "",
    ]
    return "\n".join(lines)


def _goals(sequences: Sequence[ReconstructedSequence]) -> list[str]:
    found = _medians(sequences)
    ratio, inside, complete = found.fused_error / found.single_error, found.inside, found.completeness
    low, high = INSIDE
    goals = (
        (f"error at most {MOST_RATIO:g} of the single view's", f"{ratio:.2f}", ratio <= MOST_RATIO),
        (f"{low:.0%} to {high:.0%} inside 95 %", f"{inside:.1%}", low <= inside <= high),
        (f"{LEAST_COMPLETENESS:.0%} complete", f"{complete:.0%}", complete >= LEAST_COMPLETENESS),
    )
    return [row(goal, found, "yes" if reached else "no") for goal, found, reached in goals]


def _world(world: str, sequences: Sequence[ReconstructedSequence]) -> str:
    of_world = [each for each in sequences if each.world == world]
    return row(world, str(len(of_world)), *_cells(_medians(of_world)))


def _medians(sequences: Sequence[ReconstructedSequence]) -> DepthFigures:
    """Of the sequences that have each figure; NaN where none has."""

    def median(name: str) -> float:
        values = np.array([getattr(each.figures, name) for each in sequences])
        known = values[np.isfinite(values)]
        return float(np.median(known)) if len(known) else math.nan

    names = [each.name for each in fields(DepthFigures) if each.name != "keyframes"]
    medians = {name: median(name) for name in names}
    return DepthFigures(**medians, keyframes=sum(each.figures.keyframes for each in sequences))


def _cells(figures: DepthFigures) -> list[str]:
    ratio = figures.fused_error / figures.single_error
    forms = (
        (figures.fused_error, ".2%"),
        (figures.single_error, ".2%"),
        (ratio, ".2f"),
        (figures.inside, ".1%"),
        (figures.completeness, ".0%"),
        (figures.gross, ".1%"),
        (figures.ghosts, ".0%"),
    )
    return [format(value, form) if math.isfinite(value) else "" for value, form in forms]
