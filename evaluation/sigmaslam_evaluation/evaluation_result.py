"""What an evaluation of a run found, and as JSON."""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam_evaluation.metrics.relative_consistency import SpanConsistency
from sigmaslam_evaluation.metrics.trajectory_errors import AbsoluteError, KittiErrors, PoseNees, RelativeError, coverage
from sigmaslam_evaluation.relative_summary import span_to_dict


@dataclass(frozen=True, slots=True)
class FinalErrors:
    """Errors of the same frames after the fact, of `trajectory_final.tum`; attributes as of `Evaluation`."""

    ate: AbsoluteError
    ate_origin: AbsoluteError
    rpe: RelativeError
    nees: PoseNees | None


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Everything that was found about one trajectory.

    Attributes:
        estimate_path, truth_path: the files that were compared.
        association: how frames were paired: "time" (with the unit where the truth's times are not in seconds), "index"
            (a file without times, as many poses in both) or "time at 10 Hz" (a KITTI file without times).
        matched: number of estimated poses with a true one.
        frames: number of frames with a truth, with a pose or without (see `evaluate_run`).
        predicted: number of the matched poses that the motion alone predicts, while the camera was lost.
        path_length, estimate_path_length: of the matched poses, metres.
        ate, ate_origin: absolute error after the best rigid alignment, and with only the first poses equal.
        rpe: error of the motion from frame to frame.
        kitti: segment errors.
        nees: of poses relative to the first; None where there is no covariance.
        relative: consistency of poses relative to earlier ones, by span; None where the run does not say.
        figure_path: the plots; None where none were asked for, or matplotlib is not installed.
        final: of the trajectory after the fact; None where there is none.
        truth_hint: the convention in which the truth would fit, in words and as options; None where it fits as it was
            read, or in no way.
        truth_notes: what is said of it: the kind that is guessed, poses that are left out, stamps that differ.
        nees_verdict: of `judge_nees`; None also where the truth is misread, another run, or lacks rotations.
    """

    estimate_path: Path
    truth_path: Path
    association: str
    matched: int
    frames: int
    path_length: float
    estimate_path_length: float
    ate: AbsoluteError
    ate_origin: AbsoluteError
    rpe: RelativeError
    kitti: KittiErrors
    nees: PoseNees | None
    relative: tuple[SpanConsistency, ...] | None
    figure_path: Path | None
    final: FinalErrors | None = None
    predicted: int = 0
    truth_hint: str | None = None
    truth_notes: tuple[str, ...] = ()
    nees_verdict: dict[str, str] | None = None

    @property
    def coverage(self) -> float:
        """Share of the frames that have a pose and a truth, 0 to 1."""
        return self.matched / self.frames

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, texts and lists for JSON; None stands for what could not be computed."""
        result = {
            "estimate": str(self.estimate_path),
            "truth": str(self.truth_path.resolve()),
            "association": self.association,
            "truth_hint": self.truth_hint,
            "truth_notes": list(self.truth_notes),
            "nees_verdict": self.nees_verdict,
            "matched": self.matched,
            "frames": self.frames,
            "coverage": self.coverage,
            "predicted": self.predicted,
            "path_length": self.path_length,
            "estimate_path_length": self.estimate_path_length,
            **_errors_to_dict(self),
            "kitti": asdict(self.kitti),
            "relative": None if self.relative is None else [span_to_dict(span) for span in self.relative],
            "figure": str(self.figure_path) if self.figure_path else None,
            "final": None if self.final is None else _errors_to_dict(self.final),
        }
        return {key: _plain(value) for key, value in result.items()}


def _errors_to_dict(errors: Evaluation | FinalErrors) -> dict[str, Any]:
    """ATE, RPE without its steps, and NEES with the number of its frames in their place."""
    rpe, nees = asdict(errors.rpe), asdict(errors.nees) if errors.nees else None
    for each in ("translations", "rotations_deg", "forward", "lengths"):
        del rpe[each]
    if nees:
        per_frame = nees.pop("per_frame")
        nees |= {"count": len(per_frame), "inside": coverage(per_frame, 6)}
        del nees["timestamps"]
    return {"ate": asdict(errors.ate), "ate_origin": asdict(errors.ate_origin), "rpe": rpe, "nees": nees}


def _plain(value: Any) -> Any:
    """Arrays as lists, and None for NaN, which JSON does not know."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value.tolist()]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
