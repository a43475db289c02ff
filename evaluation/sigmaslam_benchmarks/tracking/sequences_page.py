"""The page of the benchmark `sequences`."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from sigmaslam.run_record.frame_table import TRACKED, FrameTable
from sigmaslam_benchmarks.tracking.page import fill_page, number
from sigmaslam_benchmarks.trial import TrialResult

_LABELS = {
    "ours": "ours",
    "ekf": "our EKF",
    "sift": "ours with SIFT",
    "orb": "ours with ORB",
    "klt": "ours with KLT",
    "sift-pnp": "SIFT + PnP",
    "klt-pnp": "KLT + PnP",
    "cuvslam": "cuVSLAM",
    "orbslam3": "ORB-SLAM3",
    "bundle": "bundle adjustment",
}
_QUANTITIES = (
    "Frames tracked",
    "ATE, metres",
    "t_rel, %",
    "Step error, mm",
    "Forward noise, mm",
    "NEES",
    "Disparity offset, pixels",
    "Milliseconds a frame",
)
# Tables beside the page, by their names.
_ASIDE = {
    "Frames tracked": "tracked",
    "t_rel, %": "t_rel",
    "Step error, mm": "steps",
    "Forward noise, mm": "forward",
    "Disparity offset, pixels": "offsets",
    "Milliseconds a frame": "ms",
}


@dataclass(frozen=True, slots=True)
class SequenceResult:
    """One method on one sequence.

    Attributes:
        sequence: name.
        method: key.
        trial: run and evaluation; the bundle adjustment has no table of frames.
        nees: mean per degree of freedom; NaN where the truth is not exact.
        refined: what refine.json says; None but for the bundle adjustment.
        truth_sigmas: of the true poses, metres and degrees; None where they are exact.
        step_nees: of each step, with the covariance that cuVSLAM gives of its end, per degree of freedom; None of
            other methods, and where the truth is not exact.
    """

    sequence: str
    method: str
    trial: TrialResult
    nees: float
    refined: Mapping[str, Any] | None = None
    truth_sigmas: tuple[float, float] | None = None
    step_nees: np.ndarray | None = None


@dataclass(frozen=True, slots=True)
class Omission:
    """What could not be run, and why; without a method the whole sequence."""

    sequence: str
    method: str
    reason: str


def method_label(method: str) -> str:
    """A method as the page calls it."""
    return _LABELS[method]


def format_results(results: Sequence[SequenceResult | Omission], command: str, complete: bool = True) -> str:
    """The results as a Markdown page."""
    found = [result for result in results if isinstance(result, SequenceResult)]
    cells = {(result.method, result.sequence): _cells(result) for result in found}
    quantities = []
    for k, quantity in enumerate(_QUANTITIES):
        known = {key: row[k] for key, row in cells.items() if row[k] != "-"}
        sequences = list(dict.fromkeys(sequence for _, sequence in known))
        rows = [
            [_LABELS[method], *(known.get((method, sequence), "-") for sequence in sequences)]
            for method in dict.fromkeys(method for method, _ in known)
        ]
        if known:
            quantities.append((quantity, sequences, rows))
    steps = [
        f"{each.sequence} {each.step_nees.mean():.2g} ({np.median(each.step_nees):.2g})"
        for each in found
        if each.step_nees is not None
    ]
    return fill_page(
        "sequences",
        command,
        threads=cv2.getNumThreads(),
        complete=complete,
        labels=_LABELS,
        left_out=[result for result in results if isinstance(result, Omission)],
        quantities=quantities,
        aside=_ASIDE,
        steps=steps,
        relative=[row for result in found if result.method == "ours" for row in _relative_rows(result)],
    )


def _relative_rows(result: SequenceResult) -> Iterator[list[str]]:
    """Consistency of relative poses over each span, with the sigmas of the truth."""
    for each in result.trial.evaluation.relative or ():
        yield [
            result.sequence,
            each.span,
            str(each.count),
            f"{each.mean_nees:.2f}",
            f"{100 * each.inside:.0f}",
            number(100 * each.truth_share, ".0f"),
        ]


def ate_cell(result: SequenceResult) -> str:
    """Metres; more digits inside a body."""
    rmse = result.trial.evaluation.ate.rmse
    return f"{rmse:.4f}" if rmse >= 1e-3 else f"{rmse:.6f}"


def total_cell(result: SequenceResult) -> str:
    """Milliseconds a frame."""
    if result.trial.frames is None:
        assert result.refined is not None
        return f"{1e3 * float(result.refined['seconds_adjust']) / result.refined['frames']:.0f}"
    return f"{_totals(result.trial.frames).mean():.0f}"


def _cells(result: SequenceResult) -> list[str]:
    """One for each quantity."""
    evaluation, frames, refined = result.trial.evaluation, result.trial.frames, result.refined
    translations = evaluation.rpe.translations
    ends_tracked = np.ones(len(translations), bool)
    if frames is not None:
        tracked = np.isin(frames.status, TRACKED)
        count = f"{tracked.sum()}/{len(frames) - 1}"
        # Frame k ends step k - 1; frames that were skipped, or before the start, have no pose and no step.
        ends = tracked[np.isfinite(frames.columns["inliers"])][1:]
        ends_tracked = ends if len(ends) == len(translations) else ends_tracked
        offset, sigma = (float(frames.columns[name][-1]) for name in ("disparity_offset", "disparity_offset_sigma"))
    else:
        assert refined is not None
        count = f"{refined['keyframes']} keyframes"
        offset, sigma = refined["disparity_offset"], refined["disparity_offset_sigma"]
    shortest = result.truth_sigmas[0] if result.truth_sigmas else 0.0
    forward = evaluation.rpe.forward[ends_tracked & (evaluation.rpe.lengths > shortest)]
    return [
        count,
        ate_cell(result),
        number(evaluation.kitti.mean_translation_percent, ".2f"),
        number(1e3 * float(np.median(translations[ends_tracked])) if ends_tracked.any() else np.nan, ".2f"),
        number(1e3 * float(forward.std()) if len(forward) > 1 else np.nan, ".2f"),
        number(result.nees, ".2f"),
        f"{offset:+.2f} ± {sigma:.2f}" if np.isfinite(offset) else "-",
        total_cell(result),
    ]


def _totals(frames: FrameTable) -> np.ndarray:
    """Milliseconds of each frame without the reading of files, which the baselines leave out too."""
    stages = np.array([values for stage, values in frames.milliseconds.items() if stage != "read"])
    return np.asarray(np.nansum(stages, axis=0)[np.isfinite(stages).any(axis=0)])
