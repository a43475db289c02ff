"""evaluation.json and evaluation.npz of a run: its errors, in all and frame by frame."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_json, save_arrays
from sigmaslam.table import Table

EVALUATION_NAME, EVALUATED_FRAMES_NAME = "evaluation.json", "evaluation.npz"


@dataclass(frozen=True, slots=True)
class EvaluatedFrames(Table):
    """Frames with a pose and a truth; errors are those of poses relative to the first of them.

    Attributes:
        row: (M,) in trajectory.tum.
        position_error: (M,) metres.
        rotation_error: (M,) radians.
        nees: (M,) normalised estimation error squared, per degree of freedom; NaN where there is none.
        truth: (M, 3) true positions in the world of the estimate, by the best alignment, metres.
    """

    row: np.ndarray
    position_error: np.ndarray
    rotation_error: np.ndarray
    nees: np.ndarray
    truth: np.ndarray


def write_evaluation(folder: Path, evaluation: dict[str, Any], frames: EvaluatedFrames) -> None:
    """Writes both files into the folder of the run."""
    save_arrays(folder / EVALUATED_FRAMES_NAME, **frames.arrays())
    atomic_write_json(folder / EVALUATION_NAME, evaluation)


def read_evaluated_frames(path: Path, count: int) -> EvaluatedFrames:
    """The content of an evaluation.npz.

    Args:
        count: poses of trajectory.tum beside it.
    Raises:
        InputError: it is no such file, or of another run.
    """
    mend = "run `sigmaslam evaluate` again"
    shapes: dict[str, tuple[str | int, ...]] = {**dict.fromkeys(EvaluatedFrames.__slots__, ("M",)), "truth": ("M", 3)}
    frames = EvaluatedFrames(**load_columns(path, mend, shapes, {"row": "iu"}))
    if len(frames) and not (frames.row.min() >= 0 and frames.row.max() < count):
        raise InputError(f"{path}: is not of the {count} poses of trajectory.tum; {mend}")
    return frames
