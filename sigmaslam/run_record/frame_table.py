"""The table of frames that a run folder holds: frames.csv."""

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import TABLE_BYTES, read_text, shorten
from sigmaslam.errors import InputError

FRAMES_NAME = "frames.csv"
COLUMNS = ("timestamp", "matches", "inliers", "nis", "dof", "belief", "disparity_offset", "disparity_offset_sigma")
"""Columns of numbers that frames.csv must have, next to `status` and any number of `ms_...`."""
KEYFRAME_COLUMNS = ("keyframe", "loop", "raised")
"""Columns that runs of earlier versions lack: 1 where the frame became a keyframe, the time stamp of the one of long
ago with which it closed a loop, and rows by which right images are raised after a bump."""
STATUSES = ("starting", "tracking", "lost", "relocalised", "skipped", "doubtful", "ambiguous", "inertial", "odometry")
TRACKED = ("tracking", "relocalised", "doubtful", "ambiguous")
"""Of frames with a pose from their images."""
RECKONED = ("inertial", "odometry")
"""Of frames that are lost by images, and that a sensor of motion predicts."""
DOUBTS_SEPARATOR = "; "


@dataclass(frozen=True, slots=True)
class FrameTable:
    """The rows of frames.csv.

    Attributes:
        status: one of `STATUSES` for each of N frames.
        doubts: what speaks against the pose of each frame, none in runs of earlier versions.
        columns: by name of `COLUMNS` and `KEYFRAME_COLUMNS`, (N,) float64; NaN where the field is empty.
        milliseconds: by stage ("read", "features", ...), (N,) float64; NaN where the field is empty.
    """

    status: list[str]
    doubts: list[list[str]]
    columns: dict[str, np.ndarray]
    milliseconds: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.status)

    def count(self, statuses: Sequence[str]) -> int:
        """How many frames have one of these."""
        return int(np.isin(self.status, statuses).sum())

    @property
    def seconds(self) -> np.ndarray:
        """(N,) time since the first frame."""
        timestamps = self.columns["timestamp"]
        return np.asarray(timestamps - timestamps[:1])

    @property
    def total_milliseconds(self) -> np.ndarray:
        """(N,) time spent on each frame; NaN where no stage has a time."""
        stages = np.array(list(self.milliseconds.values())).reshape(-1, len(self))
        return np.where(np.isfinite(stages).any(axis=0), np.nansum(stages, axis=0), np.nan)


def predicted_poses(frames: FrameTable, timestamps: np.ndarray) -> np.ndarray:
    """(N,) bool, which poses the motion alone predicts: of frames that are lost or skipped, or start without success.

    Args:
        timestamps: (N,) of its poses, seconds.
    """
    status = np.array(frames.status)
    without_images = frames.columns["timestamp"][np.isin(status, ("lost", *RECKONED, "skipped", "starting"))]
    predicted = np.isin(np.round(timestamps, 6), np.round(without_images, 6))
    predicted[:1] = False
    return np.asarray(predicted)


def read_frames(path: Path) -> FrameTable:
    """Read frames.csv.

    Raises:
        InputError: the file is missing or empty, a column is missing, or a field is no number or no status.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path, TABLE_BYTES, "the frames"), newline=""))
        names = reader.fieldnames or []
        rows = list(reader)
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error}); give a folder written by `sigmaslam track`") from error
    missing = [name for name in (*COLUMNS, "status") if name not in names]
    if missing:
        raise InputError(f"{path}: has no column {', '.join(missing)}; run `sigmaslam track` again")
    if not rows:
        raise InputError(f"{path}: holds no frames; run `sigmaslam track` again")
    for number, row in enumerate(rows, start=2):
        if row["status"] not in STATUSES:
            raise InputError(
                f"{path}: line {number}: status {shorten(repr(row['status']))} is none of {', '.join(STATUSES)}"
            )
    stages = [name for name in names if re.fullmatch(r"ms_[a-z0-9_]+", name)]
    return FrameTable(
        status=[row["status"] for row in rows],
        doubts=[[each for each in (row.get("doubts") or "").split(DOUBTS_SEPARATOR) if each] for row in rows],
        columns={name: _column(path, rows, name) for name in (*COLUMNS, *KEYFRAME_COLUMNS)},
        milliseconds={name.removeprefix("ms_"): _column(path, rows, name) for name in stages},
    )


def read_whole_frames(path: Path) -> FrameTable:
    """The rows that a run has left, maybe none; a last one that was cut off is removed from the file."""
    content = path.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with path.open("rb+") as file:
            file.truncate(whole)
    if content.count(b"\n") > 1:
        return read_frames(path)
    return FrameTable([], [], dict.fromkeys((*COLUMNS, *KEYFRAME_COLUMNS), np.zeros(0)), {})


def _column(path: Path, rows: list[dict[str, str]], name: str) -> np.ndarray:
    values = np.full(len(rows), np.nan)
    for index, row in enumerate(rows):
        field = (row.get(name) or "").strip()
        if not field:
            if name == "timestamp":
                raise InputError(f"{path}: line {index + 2}: has no timestamp; every frame needs one")
            continue
        try:
            values[index] = float(field)
        except ValueError as error:
            raise InputError(
                f"{path}: line {index + 2}: {name} is {shorten(repr(field))}, not a number; leave it empty if unknown"
            ) from error
    return values
