"""The page of the benchmark `shake`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from sigmaslam_benchmarks.tracking.image_motion import ImageMotion
from sigmaslam_benchmarks.tracking.page import header, missing_sequences, opening, row
from sigmaslam_evaluation.metrics.map_consistency import mean_with_error

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
        worst_step, worst_second, worst_start: largest of these errors of frames called `tracking`, sigmas.
        step_metres, step_degrees: largest error of the motion from the frame before, of frames called `tracking`.
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
    worst_step: float
    worst_second: float
    worst_start: float
    step_metres: float
    step_degrees: float

    @property
    def percent(self) -> float:
        """ATE, % of the path."""
        return 100.0 * self.ate / self.path_length if self.path_length > 0 else float("nan")

    @property
    def motion_wrong(self) -> int:
        """Frames whose motion is wrong, over a frame or over a second."""
        return len({*self.wrong_step, *self.wrong_second})


Results: TypeAlias = Mapping[str, Mapping[ShakenSequence, ShakeResult]]
"""By method and sequence."""

_SUMMARY = ("sequences", "method", "tracking", "lost", "ATE, % of path: median", "quartiles", "worst", "wrong over a "
            "frame", "over 1 s", "since the start", "NEES", "inside 95 %")  # fmt: skip
_MOTION = ("sequence", "movers", "largest flow px", "largest change within 0.5 s px", "largest blur, left / right px")
_SEQUENCE = ("sequence", "movers", "method", "tracking", "lost", "ATE mm", "% of path", "wrong: frame / 1 s / start",
             "worst, sigmas", "largest step error", "NEES", "inside 95 %")  # fmt: skip


def format_page(
    results: Results, frames: int, seeds: tuple[int, int], command: str, missing: Sequence[str] = ()
) -> str:
    """The page; the first method is the one that goals are for.

    Args:
        results: of the sequences that there are.
        frames: of a sequence.
        seeds: the first one, and how many were asked for.
        command: that makes the page.
        missing: names of sequences that failed.
    """
    ours = next(iter(results.values()))
    sizes = sorted({f"{sequence.size[0]}x{sequence.size[1]}" for sequence in ours})
    moving = sum(sequence.movers > 0 for sequence in ours)
    first, count = seeds
    lines = [
        *opening("Shaken by hand, blurred by the shutter", command, f". {len(ours)} rendered sequences"),
        f"(seeds {first} to {first + count - 1}, used for nothing else), {frames} frames each at 20 Hz,",
        f"{' and '.join(sizes)}, exact truth; {moving} of them with bodies that move on their own. Motion `shaken`,",
        "sensor `slow` ([synthetic.md](../synthetic.md)): the turning reverses within half a second, again and again,",
        "and half of it is blur.",
        *missing_sequences(missing),
        "",
        "## Goals, for ours",
        "",
        *_goals(list(ours.values())),
        "",
        "## Summary",
        "",
        *header(*_SUMMARY, numbers_from=2),
    ]
    groups: dict[str, Callable[[ShakenSequence], bool]] = {
        "all": lambda sequence: True,
        "at rest but for the camera": lambda sequence: sequence.movers == 0,
        "with movers": lambda sequence: sequence.movers > 0,
    }
    for label, member in groups.items():
        for method, trials in results.items():
            chosen = [result for sequence, result in trials.items() if member(sequence)]
            if chosen:
                lines.append(row(label, method, *_summary(chosen)))
    lines += ["", "## How hard it is", "", "From the exact landmarks of what rests, median over the image.", ""]
    lines += header(*_MOTION, numbers_from=1)
    for sequence in ours:
        motion = sequence.motion
        blur = f"{motion.blur_left:.1f} / {motion.blur_right:.1f}"
        lines.append(row(sequence.name, f"{sequence.movers:g}", f"{motion.flow:.1f}", f"{motion.reversal:.1f}", blur))
    lines += ["", "## Sequences", "", *header(*_SEQUENCE, numbers_from=3)]
    for sequence in ours:
        for method, trials in results.items():
            lines.append(row(sequence.name, f"{sequence.movers:g}", method, *_cells(trials[sequence])))
    lines += ["", *_wrong_frames(results), *_NOTES]
    return "\n".join([*lines, ""])


_NOTES = [
    "## How it is measured",
    "",
    "- *tracking*, *lost*: frames after the first that the method calls `tracking`, and all others.",
    "- *ATE*: root mean square position error after the best rigid alignment, over all frames, lost ones too.",
    "- *wrong*: frames called `tracking` whose error passes 5 sigmas of what is claimed, that is, whose squared",
    "  Mahalanobis length with 6 degrees of freedom is as improbable as 5 sigmas of one Gaussian (1 in 1.7 million;",
    "  a length of 6.4). *Over a frame* and *over 1 s*: of the motion from the frame before and from the one a second",
    "  before, against the sum of the covariances of both poses (carried into one frame). A run folder does not hold",
    "  the covariance between them; with what they share the motion is known better than the sum says, so a frame that",
    "  is wrong here is wrong, and one that is not may still be. *Since the start*: of the pose relative to the first",
    "  one, against its own covariance; after one wrong step all later frames may be wrong here.",
    "- *worst*: the largest of the three errors, in the same order. *Largest step error*: of the motion from the frame",
    "  before, of frames called `tracking`.",
    "- *NEES*: of T_estimate^-1 T_truth relative to the first frame per degree of freedom, over all frames after the",
    "  first; 1 is right, more is overconfident.",
    "- *KLT + PnP*: OpenCV's corners and pyramidal Lucas-Kanade, PnP by RANSAC; landmarks count as known, the noise as",
    "  1 px. It shows what the motion does to a common tracker, not what can be claimed by one.",
]


def _goals(ours: Sequence[ShakeResult]) -> Iterator[str]:
    yield from header("", "goal", "found", numbers_from=1)
    wrong = {"over a frame": "wrong_step", "over 1 s": "wrong_second", "since the start": "wrong_start"}
    missed = []
    for label, name in wrong.items():
        count = sum(len(getattr(result, name)) for result in ours)
        of = sum(result.tracking for result in ours)
        if count:
            missed.append(f"frames wrong {label} ({count})")
        yield row(f"frames called `tracking`, wrong {label}", "0", f"{count} of {of}" + ", **missed**" * (count > 0))
    median = float(np.median([result.percent for result in ours]))
    holds = median <= MOST_ATE
    if not holds:
        missed.append(f"median ATE ({median:.2f} %)")
    yield row("ATE, % of path, median", f"{MOST_ATE:g}", f"{median:.2f}" + ("" if holds else ", **missed**"))
    yield ""
    yield "Missed: " + "; ".join(missed) + "." if missed else "All goals are met."


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
        _spread([result.nees for result in trials], ".2f"),
        _spread([100 * result.inside for result in trials], ".0f"),
    ]


def _cells(result: ShakeResult) -> list[str]:
    counts = (result.wrong_step, result.wrong_second, result.wrong_start)
    worst = (result.worst_step, result.worst_second, result.worst_start)
    return [
        str(result.tracking),
        str(result.lost),
        f"{1e3 * result.ate:.3g}",
        f"{result.percent:.2f}",
        " / ".join(str(len(frames)) for frames in counts),
        " / ".join(f"{value:.1f}" for value in worst),
        f"{1e3 * result.step_metres:.1f} mm, {result.step_degrees:.2f}°",
        f"{result.nees:.2f}",
        f"{100 * result.inside:.0f}",
    ]


def _wrong_frames(results: Results) -> Iterator[str]:
    """Which frames' motion is wrong, of the first method."""
    method, trials = next(iter(results.items()))
    found = {sequence.name: result for sequence, result in trials.items() if result.motion_wrong}
    if not found:
        return
    yield f"Frames of {method} that are wrong over a frame, and over 1 s:"
    yield ""
    for name, result in found.items():
        yield f"- {name}: {_numbers(result.wrong_step)}; {_numbers(result.wrong_second)}"
    yield ""


def _numbers(frames: Sequence[int]) -> str:
    return ", ".join(map(str, frames)) or "none"


def _spread(values: Sequence[float], form: str) -> str:
    value, error = mean_with_error(values)
    return "-" if np.isnan(value) else format(value, form) + ("" if np.isnan(error) else f" ± {format(error, form)}")
