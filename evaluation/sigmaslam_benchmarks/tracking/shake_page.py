"""The page of the benchmark `shake`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sigmaslam_benchmarks.tracking.image_motion import ImageMotion
from sigmaslam_benchmarks.tracking.map_consistency import mean_with_error
from sigmaslam_benchmarks.tracking.page import fill_page, number_with_error

GROSS = 5.0
"""Sigmas beyond which a frame is wrong."""
MOST_ATE = 0.5
"""Goal for the median ATE, % of the path."""


@dataclass(frozen=True, slots=True)
class ShakenSequence:
    """A sequence of the page.

    Attributes:
        name: of its folder.
        size: width and height, pixels.
        movers: share of the image that was asked to move on its own.
        motion: in the image.
    """

    name: str
    size: tuple[int, int]
    movers: float
    motion: ImageMotion


@dataclass(frozen=True, slots=True)
class ShakeResult:
    """One method on one sequence; NaN where there is nothing to judge.

    Attributes:
        tracking, lost: frames after the first that are called `tracking`, and all others.
        ate: root mean square position error after the best rigid alignment, metres.
        path_length: metres.
        nees: of the absolute pose per degree of freedom, mean over frames.
        inside: share of frames inside the 95 % ellipsoid.
        wrong_step, wrong_second, wrong_start: numbers of the frames called `tracking` whose motion from the frame
            before, over a second, and since the first frame is beyond `GROSS` sigmas.
    """

    tracking: int
    lost: int
    ate: float
    path_length: float
    nees: float
    inside: float
    wrong_step: Sequence[int]
    wrong_second: Sequence[int]
    wrong_start: Sequence[int]

    @property
    def percent(self) -> float:
        """ATE, % of the path."""
        return 100.0 * self.ate / self.path_length if self.path_length > 0 else float("nan")


Results: TypeAlias = Mapping[str, Mapping[ShakenSequence, ShakeResult]]
"""By method and sequence."""


def format_page(
    results: Results, frames: int, seeds: tuple[int, int], command: str, missing: Sequence[str] = ()
) -> str:
    """The page; the first method is the one that goals are for.

    Args:
        results: of the sequences that there are.
        frames: of a sequence.
        seeds: the first one, and how many were asked for.
        missing: names of sequences that failed.
    """
    ours = next(iter(results.values()))
    first, count = seeds
    goals, missed = _goals(list(ours.values()))
    groups: dict[str, Callable[[ShakenSequence], bool]] = {
        "all": lambda sequence: True,
        "at rest but for the camera": lambda sequence: sequence.movers == 0,
        "with movers": lambda sequence: sequence.movers > 0,
    }
    chosen = (
        (label, method, [result for sequence, result in trials.items() if member(sequence)])
        for label, member in groups.items()
        for method, trials in results.items()
    )
    return fill_page(
        "shake",
        command,
        first=first,
        count=count,
        frames=frames,
        sizes=sorted({f"{sequence.size[0]}x{sequence.size[1]}" for sequence in ours}),
        moving=sum(sequence.movers > 0 for sequence in ours),
        missing=missing,
        goals=goals,
        missed=missed,
        summary=[[label, method, *_summary(trials)] for label, method, trials in chosen if trials],
        sequences=len(ours),
        hardness={
            name: _span([getattr(each.motion, name) for each in ours]) for name in ("flow", "reversal", "blur_left")
        },
    )


def _goals(ours: Sequence[ShakeResult]) -> tuple[list[list[str]], list[str]]:
    """Rows of the goals, and which are missed."""
    wrong = {"over a frame": "wrong_step", "over 1 s": "wrong_second", "since the start": "wrong_start"}
    rows, missed = [], []
    for label, name in wrong.items():
        count = sum(len(getattr(result, name)) for result in ours)
        of = sum(result.tracking for result in ours)
        if count:
            missed.append(f"frames wrong {label} ({count})")
        rows.append(
            [f"frames called `tracking`, wrong {label}", "0", f"{count} of {of}" + ", **missed**" * (count > 0)]
        )
    median = float(np.median([result.percent for result in ours]))
    holds = median <= MOST_ATE
    if not holds:
        missed.append(f"median ATE ({median:.2f} %)")
    rows.append(["ATE, % of path, median", f"{MOST_ATE:g}", f"{median:.2f}" + ("" if holds else ", **missed**")])
    return rows, missed


def _span(values: Sequence[float]) -> str:
    return f"{min(values):.1f} to {max(values):.1f}"


def _summary(trials: Sequence[ShakeResult]) -> list[str]:
    percent = np.array([result.percent for result in trials])
    low, middle, high = np.quantile(percent, [0.25, 0.5, 0.75])
    return [
        str(sum(result.tracking for result in trials)),
        str(sum(result.lost for result in trials)),
        f"{middle:.2f}",
        f"{low:.2f} - {high:.2f}",
        f"{percent.max():.2f}",
        *(str(sum(len(getattr(r, name)) for r in trials)) for name in ("wrong_step", "wrong_second", "wrong_start")),
        number_with_error(*mean_with_error([result.nees for result in trials]), ".2f"),
        number_with_error(*mean_with_error([100 * result.inside for result in trials]), ".0f"),
    ]
