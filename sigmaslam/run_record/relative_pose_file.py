"""relative_poses.npz of a run: poses of frames relative to earlier ones, with the covariance between the two."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sigmaslam.bounded_files import load_columns
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_bytes
from sigmaslam.run_record.appended_file import pack_rows, read_rows
from sigmaslam.slam.relative_poses import SPANS, RelativePoses
from sigmaslam.table import Table, nearest_rows

RELATIVE_POSES_NAME = "relative_poses.npz"
PARTIAL_RELATIVE_POSES = "relative_poses.partial"
"""Where they are while a run goes on, so that they outlive it and memory does not grow."""


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


def pack_relative_poses(frame: int, relative: RelativePoses) -> bytes:
    """Those of a frame, by its row in trajectory.tum, as `PARTIAL_RELATIVE_POSES` has them."""
    return pack_rows(np.full(len(relative), frame), *relative.columns())


def collect_frame_pairs(folder: Path, timestamps: np.ndarray) -> FramePairs:
    """The relative poses in the folder of a run so far, whose poses were tracked with time stamps (N,), seconds."""
    columns = read_rows(folder / PARTIAL_RELATIVE_POSES, (), (), (), (4, 4), (6, 6))
    known = columns[0] < len(timestamps)
    later, span, earlier_time, pose, covariance = (column[known] for column in columns)
    # The nearest: time stamps that were read from trajectory.tum are rounded.
    earlier = nearest_rows(earlier_time, timestamps)
    return FramePairs(np.array(SPANS)[span.astype(np.int64)], earlier, later.astype(np.int64), pose, covariance)


def write_partial_frame_pairs(folder: Path, pairs: FramePairs, timestamps: np.ndarray) -> None:
    """Writes relative poses as a run leaves them, so that it can go on; its poses have time stamps (N,), seconds."""
    span = np.array([SPANS.index(span) for span in pairs.span], np.int64)
    content = pack_rows(pairs.later, span, timestamps[pairs.earlier], pairs.pose, pairs.covariance)
    atomic_write_bytes(folder / PARTIAL_RELATIVE_POSES, content)


def read_frame_pairs(path: Path, count: int) -> FramePairs:
    """The content of a relative_poses.npz.

    Args:
        count: poses of trajectory.tum beside it.
    Raises:
        InputError: it is no such file, or of another run.
    """
    mend = "run `sigmaslam track` again"
    shapes: dict[str, tuple[str | int, ...]] = {
        **dict.fromkeys(("span", "earlier", "later"), ("M",)),
        **{"pose": ("M", 4, 4), "covariance": ("M", 6, 6)},
    }
    pairs = FramePairs(**load_columns(path, mend, shapes, {"span": "U", "earlier": "iu", "later": "iu"}))
    frames = np.concatenate([pairs.earlier, pairs.later])
    if len(pairs) and not (frames.min() >= 0 and frames.max() < count):
        raise InputError(
            f"{path}: has frame {frames.max()}, but trajectory.tum beside it has {count} poses: "
            "both must come from the same run"
        )
    return pairs
