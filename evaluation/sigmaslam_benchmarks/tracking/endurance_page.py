"""The page of the benchmark `endurance`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sigmaslam_benchmarks.tracking.page import fill_page

# Limits of growth of memory and time and of the loop error, percent.
_MEMORY, _TIME, _LOOP = 5.0, 10.0, 0.2


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
    apart = max(len(endurance.blocks) // 5, 1)
    return fill_page(
        "endurance",
        command,
        run=endurance,
        minutes=f"{endurance.seconds / 60:.0f}",
        length=f"{endurance.lap_length:.1f}",
        verdicts=list(_verdicts(endurance)),
        blocks=[_block_row(block) for block in endurance.blocks[apart - 1 :: apart]],
        laps=[
            [f"{number}", f"{1e3 * lap.end:.1f}", _percent(lap.end, endurance)]
            + [f"{1e3 * error:.1f}" for error in (lap.median, lap.most)]
            for number, lap in enumerate(endurance.laps, start=1)
            if number in (1, 2, len(endurance.laps))
        ],
    )


def _block_row(block: Block) -> list[str]:
    low, middle, high = block.spread
    wall = f"{middle:.1f} ({low:.1f} - {high:.1f})"
    keyframes = f"{100 * block.keyframes:.0f} %"
    return [f"{block.end}", f"{block.megabytes:.0f}", f"{block.cpu:.1f}", wall, keyframes, f"{block.lost}"]


def _verdicts(endurance: Endurance) -> Iterator[list[str]]:
    """Goals, what was found, and whether that reaches them."""
    blocks = endurance.blocks
    if len(blocks) > 2:
        # The keyframe memory fills up during the first blocks.
        first = blocks[1]
        growth = 100.0 * max(block.megabytes / first.megabytes - 1.0 for block in blocks[2:])
        yield [
            f"memory flat within {_MEMORY:.0f} % from frame {first.end} on",
            f"at most {growth:+.1f} % ({first.megabytes:.0f} MB then)",
            _word(growth <= _MEMORY),
        ]
        half = max(len(blocks) // 2, 2)
        early, late = (np.median([block.cpu for block in part]) for part in (blocks[1:half], blocks[half:]))
        change = 100.0 * float(late / early - 1.0)
        yield [
            f"time a frame flat (second half within {_TIME:.0f} % of the first)",
            f"{change:+.1f} % ({early:.1f} -> {late:.1f} ms of CPU, medians of blocks)",
            _word(change <= _TIME),
        ]
    beyond = endurance.open_errors[endurance.lap_frames :]
    if len(beyond):
        worst, apart = float(endurance.errors[endurance.lap_frames :][: len(beyond)][-1]), float(beyond[-1])
        yield [
            f"loop error after closure <= {_LOOP} % of the path",
            f"{1e3 * worst:.1f} mm, {_percent(worst, endurance)}; without loops {1e3 * apart:.1f} mm, "
            f"{_percent(apart, endurance)} ({len(beyond)} frames into the second lap)",
            _word(100 * worst / endurance.lap_length <= _LOOP),
        ]
    lost = sum(block.lost for block in blocks)
    yield ["no frame lost", f"{lost}", _word(lost == 0)]
    kept = endurance.tracks_bytes
    yield ["map bounded", f"{endurance.points} points", ""]
    yield [
        "`--tracks`",
        f"keeps all views: {kept / 1024:.1f} kB a frame more, {kept * 1e4 / 2**20:.0f} MB in 10,000 frames",
        "not bounded",
    ]


def _percent(error: float, endurance: Endurance) -> str:
    return f"{100.0 * error / endurance.lap_length:.3f} %"


def _word(reached: bool) -> str:
    return "reached" if reached else "**missed**"
