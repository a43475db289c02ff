"""relative_poses.npz of a run: poses of frames relative to earlier ones, with the covariance between the two."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam.run_record.appended_file import AppendedFile, read_records
from sigmaslam.slam.relative_poses import SPANS, RelativePoses
from sigmaslam.table import Table

RELATIVE_POSES_NAME = "relative_poses.npz"
PARTIAL_RELATIVE_POSES = "relative_poses.partial"
# Numbers of a row on disk: frame, span, time stamp of the earlier frame, pose, covariance.
_WIDTH = 3 + 16 + 36


@dataclass(frozen=True, slots=True)
class FramePairs(Table):
    """Poses of frames relative to earlier ones.

    Attributes:
        span: (M,) name of the distance or the time between the two, as of `SPANS`.
        earlier, later: (M,) their rows in trajectory.tum.
        pose: (M, 4, 4) T_earlier_later of the left camera, as it was known at the later frame.
        covariance: (M, 6, 6) of it in the later camera's frame, translation (metres) before rotation (radians).
    """

    span: np.ndarray
    earlier: np.ndarray
    later: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray


class RelativePoseWriter:
    """Appends relative poses to a file in the folder of a run, so that they outlive it and memory does not grow."""

    def __init__(self, folder: Path, goes_on: bool = False) -> None:
        self._file = AppendedFile(folder / PARTIAL_RELATIVE_POSES, goes_on)

    def add(self, frame: int, relative: RelativePoses) -> None:
        """Takes those of a frame, by its row in trajectory.tum."""
        count = len(relative)
        columns = (
            np.full(count, frame),
            relative.span,
            relative.timestamp,
            relative.pose.reshape(count, 16),
            relative.covariance.reshape(count, 36),
        )
        self._file.append(np.column_stack(columns).astype(np.float64).tobytes())

    def close(self) -> None:
        """The last relative poses have come."""
        self._file.close()


def collect_frame_pairs(folder: Path, timestamps: np.ndarray) -> FramePairs:
    """The relative poses that a run has left in its folder so far.

    Args:
        folder: of the run.
        timestamps: (N,) of the frames with a pose, seconds, as they were tracked.
    """
    rows = read_records(folder / PARTIAL_RELATIVE_POSES, _WIDTH)
    rows = rows[rows[:, 0] < len(timestamps)]
    return FramePairs(
        np.array(SPANS)[rows[:, 1].astype(np.int64)],
        # The nearest: time stamps that were read from trajectory.tum are rounded.
        np.searchsorted(0.5 * (timestamps[1:] + timestamps[:-1]), rows[:, 2]),
        rows[:, 0].astype(np.int64),
        rows[:, 3:19].reshape(-1, 4, 4),
        rows[:, 19:].reshape(-1, 6, 6),
    )


def write_partial_frame_pairs(folder: Path, pairs: FramePairs, timestamps: np.ndarray) -> None:
    """Writes relative poses as a run leaves them, so that it can go on.

    Args:
        folder: of the run.
        pairs: what `collect_frame_pairs` returns.
        timestamps: (N,) of the frames with a pose, seconds.
    """
    count = len(pairs)
    columns = (
        pairs.later,
        np.array([SPANS.index(span) for span in pairs.span], np.int64),
        timestamps[pairs.earlier],
        pairs.pose.reshape(count, 16),
        pairs.covariance.reshape(count, 36),
    )
    with atomic_path(folder / PARTIAL_RELATIVE_POSES) as temporary:
        temporary.write_bytes(np.column_stack(columns).astype(np.float64).tobytes())


def write_frame_pairs(path: Path, pairs: FramePairs) -> None:
    """Writes the columns as arrays by name."""
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, **{name: getattr(pairs, name) for name in FramePairs.__slots__})


def read_frame_pairs(path: Path, count: int) -> FramePairs:
    """The content of a relative_poses.npz.

    Args:
        path: of the file.
        count: poses of trajectory.tum beside it.
    Raises:
        InputError: it is no such file, or of another run.
    """
    mend = "run `sigmaslam track` again"
    shapes: dict[str, tuple[str | int, ...]] = {
        "span": ("M",),
        "earlier": ("M",),
        "later": ("M",),
        "pose": ("M", 4, 4),
        "covariance": ("M", 6, 6),
    }
    pairs = FramePairs(**load_columns(path, mend, shapes, {"span": "U", "earlier": "iu", "later": "iu"}))
    rows = len(pairs.span)
    frames = np.concatenate([pairs.earlier, pairs.later])
    if rows and not (frames.min() >= 0 and frames.max() < count):
        raise InputError(
            f"{path}: has frame {frames.max()}, but trajectory.tum beside it has {count} poses: "
            "both must come from the same run"
        )
    return pairs
