"""What a run folder holds, read back."""

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import check_columns, load_arrays, read_json
from sigmaslam.errors import InputError
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_covariances, read_tum
from sigmaslam.run_record import evaluated_frames
from sigmaslam.run_record.dense_points import DENSE_NAME, RecordedPoints, read_dense_points
from sigmaslam.run_record.frame_pictures import PICTURES_NAME, FramePictures, read_pictures
from sigmaslam.run_record.frame_table import FRAMES_NAME, FrameTable, read_frames
from sigmaslam.run_record.inertial_file import InertialRecords, read_inertial_records
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME, FramePairs, read_frame_pairs
from sigmaslam.run_record.run_folder import FINAL_TRAJECTORY, MAP_NAME, RUN_NAME

REFINED_TRAJECTORY, REFINE_NAME = "trajectory_refined.tum", "refine.json"


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """The files of a run folder; what is not there is None, or empty.

    Attributes:
        folder: the run.
        frames: all F of them.
        trajectory: N poses, as they were said.
        covariances: (N, 6, 6) in their own frames, translation (metres) before rotation (radians); NaN without them.
        pose_row: (N,) row in `frames` of each pose.
        final, refined: trajectories after the fact and after `sigmaslam map refine`.
        dense: points of `sigmaslam map reconstruct`.
        pictures: of some frames.
        entries: of run.json.
        evaluation, refinement: content of evaluation.json and refine.json.
        evaluated: errors of frames.
        inertial: the state of an inertial sensor, where gravity was known.
        pairs: poses relative to earlier keyframes.
    """

    folder: Path
    frames: FrameTable
    trajectory: Trajectory
    covariances: np.ndarray
    pose_row: np.ndarray
    final: Trajectory | None
    refined: Trajectory | None
    map: RecordedPoints | None
    dense: RecordedPoints | None
    pictures: FramePictures | None
    entries: dict[str, Any]
    evaluation: dict[str, Any]
    refinement: dict[str, Any]
    evaluated: evaluated_frames.EvaluatedFrames | None
    inertial: InertialRecords | None
    pairs: FramePairs | None

    @property
    def summary(self) -> dict[str, Any]:
        """Of run.json."""
        summary = self.entries.get("summary")
        return summary if isinstance(summary, dict) else {}

    @property
    def pose_status(self) -> list[str]:
        """(N,) status of each pose's frame."""
        return [self.frames.status[row] for row in self.pose_row]

    @property
    def sigmas(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,), (N,) standard deviation of the position (metres) and of the rotation (radians), each as a whole."""
        return _whole_sigmas(self.covariances)

    @property
    def sigmas_over_a_second(self) -> tuple[np.ndarray, np.ndarray]:
        """(N,), (N,) the same of poses relative to a keyframe about a second before; NaN where there is none."""
        covariances = np.full_like(self.covariances, np.nan)
        if self.pairs is not None:
            chosen = self.pairs.span == "1 s"
            covariances[self.pairs.later[chosen]] = self.pairs.covariance[chosen]
        return _whole_sigmas(covariances)

    def of_frames(self, values: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Numbers of poses (all, or those of the given rows) as numbers of all frames (F,); NaN for the others."""
        spread = np.full(len(self.frames), np.nan)
        spread[self.pose_row if rows is None else self.pose_row[rows]] = values
        return spread


def read_run(folder: Path) -> RecordedRun:
    """Reads a run folder.

    Raises:
        InputError: frames.csv is missing, or a file is wrong.
    """
    frames = read_frames(folder / FRAMES_NAME)
    trajectory = _read_trajectory(folder / "trajectory.tum") or Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    # trajectory.tum and frames.csv may round differently.
    pose_row = np.searchsorted(frames.columns["timestamp"], trajectory.timestamps - 1e-6)
    if len(pose_row) and pose_row.max() >= len(frames):
        raise InputError(f"{folder / FRAMES_NAME}: ends before trajectory.tum: both must come from the same run")
    path, count, errors = folder / "covariance.npy", len(trajectory), folder / evaluated_frames.EVALUATED_FRAMES_NAME
    relative = folder / RELATIVE_POSES_NAME
    return RecordedRun(
        folder=folder,
        frames=frames,
        trajectory=trajectory,
        covariances=read_covariances(path, count) if path.is_file() else np.full((count, 6, 6), np.nan),
        pose_row=pose_row,
        final=_read_trajectory(folder / FINAL_TRAJECTORY),
        refined=_read_trajectory(folder / REFINED_TRAJECTORY),
        map=_read_map(folder / MAP_NAME),
        dense=read_dense_points(folder / DENSE_NAME) if (folder / DENSE_NAME).is_file() else None,
        pictures=read_pictures(folder / PICTURES_NAME) if (folder / PICTURES_NAME).is_file() else None,
        entries=read_table(folder / RUN_NAME, "track"),
        evaluation=read_table(folder / evaluated_frames.EVALUATION_NAME, "evaluate"),
        refinement=read_table(folder / REFINE_NAME, "refine"),
        evaluated=evaluated_frames.read_evaluated_frames(errors, count) if errors.is_file() else None,
        inertial=read_inertial_records(folder),
        pairs=read_frame_pairs(relative, count) if relative.is_file() else None,
    )


def read_final_trajectory(folder: Path) -> tuple[Trajectory, Trajectory]:
    """Frames of a run as they were said, and after the fact; the same twice where there is none after the fact.

    Raises:
        InputError: a file is wrong, or the two have other times.
    """
    said, path = read_tum(folder / "trajectory.tum"), folder / FINAL_TRAJECTORY
    final = read_tum(path) if path.is_file() else said
    if not np.array_equal(final.timestamps, said.timestamps):
        raise InputError(
            f"{path}: has {len(final)} poses at other times than the {len(said)} of trajectory.tum: both must come "
            "from the same run"
        )
    return said, final


def _whole_sigmas(covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roots of the traces of both diagonal blocks (N, 3, 3) of covariances (N, 6, 6)."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    return np.sqrt(variances[:, :3].sum(axis=1)), np.sqrt(variances[:, 3:].sum(axis=1))


def _read_trajectory(path: Path) -> Trajectory | None:
    return read_tum(path) if path.is_file() else None


def _read_map(path: Path) -> RecordedPoints | None:
    """None where there is no map. Maps of earlier versions have no grey values."""
    if not path.is_file():
        return None
    mend = "run `sigmaslam track` again"
    # The whole archive has the images of all keyframes, too.
    arrays = load_arrays(path, mend, ("points",))
    with zipfile.ZipFile(path) as archive:
        there = {name.removesuffix(".npy") for name in archive.namelist()}
    arrays |= load_arrays(path, mend, [name for name in ("covariances", "intensity") if name in there])
    unknown = np.full(len(arrays["points"]), np.nan)
    arrays = {"covariances": unknown[:, None, None] * np.eye(3), "intensity": unknown, **arrays}
    shapes: dict[str, tuple[str | int, ...]] = {"points": ("M", 3), "covariances": ("M", 3, 3), "intensity": ("M",)}
    check_columns(path, arrays, shapes, {}, mend)
    points, covariances = (arrays[name].astype(np.float64) for name in ("points", "covariances"))
    kept, known = np.isfinite(points).all(axis=1), np.isfinite(covariances).all(axis=(1, 2))
    largest = np.full(len(points), np.nan)
    if known.any():
        largest[known] = np.linalg.eigvalsh(covariances[known])[:, -1]
    colours = np.repeat(arrays["intensity"][kept, None], 3, axis=1)
    return RecordedPoints(points[kept], np.sqrt(np.maximum(largest, 0.0))[kept], colours)


def read_table(path: Path, command: str) -> dict[str, Any]:
    """What a command wrote beside a run; empty where it was not called, or wrote no table."""
    content = read_json(path, "the run", f"run `sigmaslam {command}` again") if path.is_file() else {}
    return content if isinstance(content, dict) else {}
