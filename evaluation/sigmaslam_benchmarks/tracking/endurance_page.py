"""The page of the benchmark `endurance`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.tracking.page import opening, table

# Limits of growth of memory and time and of the loop error, percent.
_MEMORY, _TIME, _LOOP = 5.0, 10.0, 0.2
_WORDS = """\
One lap through a rendered room ({lap_frames} frames, {length:.1f} m), whose end is its beginning, tracked over and over
by what `sigmaslam track` does, with its outputs. Images are in memory from the start. CPU: milliseconds a frame of all
threads, which other programs disturb less than wall milliseconds. Errors are distances from the exact position in the
world of the first frame, nothing aligned. Without loops: keyframes that left the window long ago are not remembered.
"""


@dataclass(frozen=True, slots=True)
class Block:
    """Frames told of together.

    Attributes:
        end: frames done after it.
        megabytes: resident memory then.
        cpu: milliseconds a frame.
        spread: 10 %, 50 %, 90 % of the wall milliseconds.
        keyframes: share of frames that took more than 5 ms for the map.
        lost: frames without a pose from the images.
    """

    end: int
    megabytes: float
    cpu: float
    spread: tuple[float, float, float]
    keyframes: float
    lost: int


@dataclass(frozen=True, slots=True)
class Lap:
    """Position errors of a lap, metres: at its end, in the median frame, at most."""

    end: float
    median: float
    most: float


@dataclass(frozen=True, slots=True)
class Endurance:
    """A run.

    Attributes:
        asked, frames: to be tracked, and tracked.
        seconds: in all.
        lap_length, lap_frames: metres, frames of a lap.
        blocks, laps: whole ones.
        errors, open_errors: (N,) metres, of every frame, and of the frames of a run without loops.
        points: of the map.
        tracks_bytes: that `--tracks` keeps in memory, for each frame.
    """

    asked: int
    frames: int
    seconds: float
    lap_length: float
    lap_frames: int
    blocks: Sequence[Block]
    laps: Sequence[Lap]
    errors: np.ndarray
    open_errors: np.ndarray
    points: int
    tracks_bytes: float


def format_endurance(endurance: Endurance, command: str) -> str:
    """The run as a Markdown page."""
    words = _WORDS.format(lap_frames=endurance.lap_frames, length=endurance.lap_length)
    lines = [
        *opening("Endurance", command, f", in {endurance.seconds / 60:.0f} minutes."),
        "",
        words,
    ]
    if endurance.frames < endurance.asked:
        lines += [f"**Stopped after {endurance.frames} of {endurance.asked} frames.**", ""]
    lines += [*_verdicts(endurance), ""]
    if endurance.blocks:
        apart = max(len(endurance.blocks) // 5, 1)
        blocks = endurance.blocks[apart - 1 :: apart]
        columns = ("frames", "MB", "CPU ms", "wall ms, median (p10 - p90)", "keyframes", "lost")
        lines += ["## Memory and time", "", *table(columns, map(_block_row, blocks)), ""]
    if endurance.laps:
        rows = (
            [f"{number}", f"{1e3 * lap.end:.1f}", _percent(lap.end, endurance)]
            + [f"{1e3 * error:.1f}" for error in (lap.median, lap.most)]
            for number, lap in enumerate(endurance.laps, start=1)
            if number in (1, 2, len(endurance.laps))
        )
        lines += ["## Errors", "", *table(("lap", "at its end mm", "% of a lap", "median mm", "most mm"), rows), ""]
    return "\n".join(lines)


def _block_row(block: Block) -> list[str]:
    low, middle, high = block.spread
    wall = f"{middle:.1f} ({low:.1f} - {high:.1f})"
    keyframes = f"{100 * block.keyframes:.0f} %"
    return [f"{block.end}", f"{block.megabytes:.0f}", f"{block.cpu:.1f}", wall, keyframes, f"{block.lost}"]


def _verdicts(endurance: Endurance) -> list[str]:
    """Goals, and what was found."""
    lines = ["| goal | found | |", "| --- | --- | --- |"]
    blocks = endurance.blocks
    if len(blocks) > 2:
        # The keyframe memory fills up during the first blocks.
        first = blocks[1]
        growth = 100.0 * max(block.megabytes / first.megabytes - 1.0 for block in blocks[2:])
        lines.append(
            f"| memory flat within {_MEMORY:.0f} % from frame {first.end} on | at most {growth:+.1f} % "
            f"({first.megabytes:.0f} MB then) | {_word(growth <= _MEMORY)} |"
        )
        half = max(len(blocks) // 2, 2)
        early, late = (np.median([block.cpu for block in part]) for part in (blocks[1:half], blocks[half:]))
        change = 100.0 * float(late / early - 1.0)
        lines.append(
            f"| time a frame flat (second half within {_TIME:.0f} % of the first) | {change:+.1f} % "
            f"({early:.1f} -> {late:.1f} ms of CPU, medians of blocks) | {_word(change <= _TIME)} |"
        )
    beyond = endurance.open_errors[endurance.lap_frames :]
    if len(beyond):
        closed = endurance.errors[endurance.lap_frames : endurance.lap_frames + len(beyond)]
        worst = float(closed[-1])
        lines.append(
            f"| loop error after closure <= {_LOOP} % of the path | {1e3 * worst:.1f} mm, "
            f"{_percent(worst, endurance)}; "
            f"without loops {1e3 * beyond[-1]:.1f} mm, {_percent(float(beyond[-1]), endurance)} "
            f"({len(beyond)} frames into the second lap) | {_word(100 * worst / endurance.lap_length <= _LOOP)} |"
        )
    lost = sum(block.lost for block in blocks)
    lines.append(f"| no frame lost | {lost} | {_word(lost == 0)} |")
    lines.append(f"| map bounded | {endurance.points} points | |")
    lines.append(
        f"| `--tracks` | keeps all views: {endurance.tracks_bytes / 1024:.1f} kB a frame more, "
        f"{endurance.tracks_bytes * 1e4 / 2**20:.0f} MB in 10,000 frames | not bounded |"
    )
    return lines


def _percent(error: float, endurance: Endurance) -> str:
    return f"{100.0 * error / endurance.lap_length:.3f} %"


def _word(reached: bool) -> str:
    return "reached" if reached else "**missed**"
