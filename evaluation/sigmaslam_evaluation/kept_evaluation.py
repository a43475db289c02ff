"""The evaluation of a run in its folder and its report."""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.report.report import write_report
from sigmaslam.run_record.evaluated_frames import EvaluatedFrames, write_evaluation
from sigmaslam.run_record.frame_table import FRAMES_NAME
from sigmaslam_evaluation.metrics.trajectory_errors import PoseNees, align, pose_errors, synchronise

_LOGGER = logging.getLogger(__name__)


def evaluated_frames(estimate: Trajectory, truth: Trajectory, nees: PoseNees | None) -> EvaluatedFrames:
    """Errors frame by frame.

    Args:
        estimate: all poses of the run, in the clock of the truth.
        truth: any number of poses.
        nees: of the estimate; None without a covariance.
    """
    errors = pose_errors(estimate, truth)
    per_frame = np.full(len(errors.index), np.nan)
    if nees is not None:
        per_frame[np.searchsorted(errors.timestamps, nees.timestamps)] = nees.per_frame
    matched_estimate, matched_truth = synchronise(estimate, truth)
    return EvaluatedFrames(
        row=errors.index,
        position_error=np.linalg.norm(errors.errors[:, :3], axis=1),
        rotation_error=np.linalg.norm(errors.errors[:, 3:], axis=1),
        nees=per_frame,
        truth=align(matched_truth, matched_estimate, "se3").positions,
    )


def keep_evaluation(
    run: Path, evaluation: dict[str, Any], estimate: Trajectory, truth: Trajectory, nees: PoseNees | None
) -> None:
    """Writes `evaluation.json` and `evaluation.npz` into the folder of a run, and its report anew.

    A folder that cannot be written to costs a warning.
    """
    try:
        write_evaluation(run, evaluation, evaluated_frames(estimate, truth, nees))
        if (run / FRAMES_NAME).is_file():
            write_report(run)
    except (OSError, InputError) as error:
        _LOGGER.warning("the evaluation is not in the report: %s", getattr(error, "strerror", None) or error)
