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
_STAGES = ("features", "match", "filter", "map")


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
    by_sequence: dict[str, list[SequenceResult]] = {}
    for result in results:
        if isinstance(result, SequenceResult):
            by_sequence.setdefault(result.sequence, []).append(result)
    missing = [result for result in results if isinstance(result, Omission)]
    sequences = [
        {
            "name": name,
            "rows": map(_row, found),
            "missing": [
                (_LABELS[each.method], each.reason) for each in missing if each.method and each.sequence == name
            ],
            "stages": [
                _stage_row(each) for each in found if each.trial.frames and "filter" in each.trial.frames.milliseconds
            ],
            "steps": [
                (_LABELS[each.method], f"{each.step_nees.mean():.2g}", f"{np.median(each.step_nees):.2g}")
                for each in found
                if each.step_nees is not None
            ],
            "relative": [_relative(each) for each in found if each.method == "ours" and each.trial.evaluation.relative],
        }
        for name, found in by_sequence.items()
    ]
    left_out = [each for each in missing if not each.method]
    return fill_page(
        "sequences", command, threads=cv2.getNumThreads(), complete=complete, left_out=left_out, sequences=sequences
    )


def _relative(result: SequenceResult) -> tuple[str, Iterator[list[str]]]:
    """What the truth's sigmas are, and rows of the consistency of relative poses by span."""
    sigmas = result.truth_sigmas
    rows = (
        [
            each.span,
            str(each.count),
            f"{each.mean_nees:.2f}",
            f"{each.median_nees:.2f}",
            f"{100 * each.inside:.0f}",
            f"{each.translation_rmse:.2g}",
            f"{each.translation_sigma:.2g}",
            number(100 * each.truth_share, ".0f"),
        ]
        for each in result.trial.evaluation.relative or ()
    )
    return "exact" if sigmas is None else f"{sigmas[0]:g} m and {sigmas[1]:g} degrees in each pose", rows


def ate_cell(result: SequenceResult) -> str:
    """Metres; more digits inside a body."""
    rmse = result.trial.evaluation.ate.rmse
    return f"{rmse:.4f}" if rmse >= 1e-3 else f"{rmse:.6f}"


def total_cell(result: SequenceResult) -> str:
    """Milliseconds a frame, and their spread where there is one."""
    if result.trial.frames is None:
        seconds, share = _seconds_adjusting(result)
        return f"{share:.0f} (whole: {seconds:.1f} s)"
    totals = _totals(result.trial.frames)
    low, high = np.percentile(totals, [10, 90])
    return f"{totals.mean():.0f} ({low:.0f} - {high:.0f})"


def _row(result: SequenceResult) -> list[str]:
    evaluation, frames, refined = result.trial.evaluation, result.trial.frames, result.refined
    translations, rotations = evaluation.rpe.translations, evaluation.rpe.rotations_deg
    ends_tracked, nis = np.ones(len(translations), bool), np.nan
    if frames is not None:
        tracked = np.isin(frames.status, TRACKED)
        count = f"{tracked.sum()} of {len(frames) - 1}"
        # Frame k ends step k - 1; frames that were skipped, or before the start, have no pose and no step.
        ends = tracked[np.isfinite(frames.columns["inliers"])][1:]
        ends_tracked = ends if len(ends) == len(translations) else ends_tracked
        if tracked.any():
            updated = frames.columns["dof"] > 0  # a relocalised frame is not
            nis = float(np.median(frames.columns["nis"][updated] / frames.columns["dof"][updated]))
        offset, sigma = (float(frames.columns[name][-1]) for name in ("disparity_offset", "disparity_offset_sigma"))
        pace = float(_totals(frames).mean())
    else:
        assert refined is not None
        count = f"{refined['keyframes']} keyframes"
        offset, sigma = refined["disparity_offset"], refined["disparity_offset_sigma"]
        _, pace = _seconds_adjusting(result)
    shortest = result.truth_sigmas[0] if result.truth_sigmas else 0.0
    forward = evaluation.rpe.forward[ends_tracked & (evaluation.rpe.lengths > shortest)]
    return [
        _LABELS[result.method],
        count,
        ate_cell(result),
        number(evaluation.kitti.mean_translation_percent, ".2f"),
        number(evaluation.kitti.mean_rotation_deg_per_100m, ".2f"),
        number(1e3 * float(np.median(translations[ends_tracked])) if ends_tracked.any() else np.nan, ".2f"),
        number(1e3 * float(forward.std()) if len(forward) > 1 else np.nan, ".2f"),
        number(float(np.median(rotations[ends_tracked])) if ends_tracked.any() else np.nan, ".3f"),
        number(nis, ".2f"),
        number(result.nees, ".2f"),
        f"{offset:+.2f} ± {sigma:.2f}" if np.isfinite(offset) else "-",
        total_cell(result),
        f"{1e3 / pace:.1f}",
    ]


def _stage_row(result: SequenceResult) -> list[str]:
    frames, tracked = result.trial.table, result.trial.tracked
    inliers = float(np.median(frames.columns["inliers"][tracked])) if tracked.any() else np.nan
    stages = (f"{np.nanmedian(frames.milliseconds[stage]):.1f}" for stage in _STAGES)
    return [_LABELS[result.method], number(inliers, ".0f"), *stages]


def _totals(frames: FrameTable) -> np.ndarray:
    """Milliseconds of each frame without the reading of files, which the baselines leave out too."""
    stages = np.array([values for stage, values in frames.milliseconds.items() if stage != "read"])
    return np.asarray(np.nansum(stages, axis=0)[np.isfinite(stages).any(axis=0)])


def _seconds_adjusting(result: SequenceResult) -> tuple[float, float]:
    """Of the whole optimisation, and milliseconds a frame."""
    assert result.refined is not None
    seconds = float(result.refined["seconds_adjust"])
    return seconds, 1e3 * seconds / result.refined["frames"]
