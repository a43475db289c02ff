"""The page of the benchmark `reconstruction`."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sigmaslam_benchmarks.tracking.depth_accuracy import DepthFigures
from sigmaslam_benchmarks.tracking.page import fill_page

MOST_RATIO, LEAST_COMPLETENESS, INSIDE = 0.6, 0.6, (0.90, 0.98)
"""Goals: error over the single view's, share of the pixels at rest, share inside the 95 % interval."""


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
    return fill_page(
        "reconstruction",
        command,
        seeds=seeds,
        missing=missing,
        goals=_goals(sequences),
        worlds=[_world(world, sequences) for world in dict.fromkeys(each.world for each in sequences)],
        sequences=len(sequences),
    )


def format_organs(
    sequences: Sequence[ReconstructedSequence], seeds: int, command: str, missing: Sequence[str] = ()
) -> str:
    """The page of rigid organs; arguments as those of `format_page`."""
    rows = [_in_millimetres(str(each.seed), each.figures) for each in sequences]
    rows.append(_in_millimetres("median", _medians(sequences)))
    return fill_page("reconstruction_organ", command, seeds=seeds, missing=missing, rows=rows)


def _goals(sequences: Sequence[ReconstructedSequence]) -> list[list[str]]:
    found = _medians(sequences)
    ratio, inside, complete = found.fused_error / found.single_error, found.inside, found.completeness
    low, high = INSIDE
    goals = (
        (f"error at most {MOST_RATIO:g} of the single view's", f"{ratio:.2f}", ratio <= MOST_RATIO),
        (f"{low:.0%} to {high:.0%} inside 95 %", f"{inside:.1%}", low <= inside <= high),
        (f"{LEAST_COMPLETENESS:.0%} complete", f"{complete:.0%}", complete >= LEAST_COMPLETENESS),
    )
    return [[goal, found, "yes" if reached else "no"] for goal, found, reached in goals]


def _world(world: str, sequences: Sequence[ReconstructedSequence]) -> list[str]:
    of_world = [each for each in sequences if each.world == world]
    return [world, str(len(of_world)), *_cells(_medians(of_world))]


def _in_millimetres(name: str, of: DepthFigures) -> list[str]:
    errors = [f"{each:.2f}" for each in (of.error_mm, of.error95_mm, of.sigma_mm)]
    return [name, *errors, *(f"{each:.1%}" for each in (*of.within, *of.within_alone)), f"{of.completeness:.0%}"]


def _medians(sequences: Sequence[ReconstructedSequence]) -> DepthFigures:
    """Of the sequences that have each figure; NaN where none has."""

    def median(name: str) -> Any:
        values = np.array([getattr(each.figures, name) for each in sequences], float)
        known = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
        return np.median(known, axis=0) if len(known) else np.full(values.shape[1:], math.nan)

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
