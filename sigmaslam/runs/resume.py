"""A run that was stopped, and goes on in its folder: where it begins, and what is on disk of it.

The new tracker begins at the last keyframe, with the pose and covariance that were said of it, and tracks the frames
after it again. Those of which something is on disk are not said again.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import read_json
from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.readers import StereoFrame, StereoSequence
from sigmaslam.readers.trajectory_files import read_covariances, read_tum
from sigmaslam.run_record import relative_pose_file
from sigmaslam.run_record.appended_file import check_not_in_use
from sigmaslam.run_record.frame_table import FRAMES_NAME, read_whole_frames
from sigmaslam.run_record.inertial_file import cut_inertial_records
from sigmaslam.run_record.pose_file import PARTIAL_POSES, PoseRecords, read_pose_records, write_pose_records
from sigmaslam.run_record.removal import remove_results
from sigmaslam.run_record.run_folder import RUN_NAME
from sigmaslam.slam.start_pose import StartPose
from sigmaslam.table import nearest_rows

# What must be as it was; paths and settings of the command line.
_SAME = (
    *("input", "format", "frontend", "backend", "provider", "weights", "mask", "configuration", "calibration"),
    *("imu", "odometry"),
)
# Frames lie further apart, seconds; frames.csv and trajectory.tum round time stamps.
_SAME_TIME = 1e-6


@dataclass(frozen=True, slots=True)
class StoppedRun:
    """A run that goes on.

    Attributes:
        resumed_at: numbers of the frames from which it has gone on, the new one last.
        timestamps: (N,) of the frames that stay, in frames.csv, seconds; the last one has a pose.
        keyframe_at: time stamp of the last keyframe, seconds.
        start: what was said of that one.
        records: poses that stay.
        pairs: relative poses that stay.
    """

    folder: Path
    resumed_at: list[int]
    timestamps: np.ndarray
    keyframe_at: float
    start: StartPose
    records: PoseRecords
    pairs: relative_pose_file.FramePairs

    def check_sequence(self, sequence: StereoSequence) -> None:
        """The frames on disk are the first ones of the sequence, as far as that is known before it is read.

        Raises:
            InputError: they are not.
        """
        if sequence.timestamps is None:
            return
        first = np.asarray(sequence.timestamps[: len(self.timestamps)])
        if len(first) < len(self.timestamps):
            raise self._other_input(f"it has {len(first)} frames, and {FRAMES_NAME} {len(self.timestamps)}")
        differing = np.flatnonzero(np.abs(first - self.timestamps) > _SAME_TIME)
        if len(differing):
            k = differing[0]
            raise self._other_input(
                f"its frame {k} is at {first[k]:.6f} s, in {FRAMES_NAME} {self.timestamps[k]:.6f} s"
            )

    def frames(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """The frames of a sequence from the last keyframe on; those before are read over.

        Raises:
            InputError: it is another sequence.
        """
        began = False
        for frame in frames:
            if not self.is_new(frame.timestamp) and not _is_among(np.array([frame.timestamp]), self.timestamps)[0]:
                raise self._other_input(f"it has a frame at {frame.timestamp:.6f} s, and {FRAMES_NAME} has none")
            if not began and frame.timestamp > self.keyframe_at - _SAME_TIME:
                began = True
                if frame.timestamp > self.keyframe_at + _SAME_TIME:
                    raise self._other_input(f"the last keyframe, at {self.keyframe_at:.6f} s, cannot be read")
            if began:
                yield frame
        if not began:
            raise self._other_input(f"it ends before the last keyframe, at {self.keyframe_at:.6f} s")

    def is_new(self, timestamp: float) -> bool:
        """Nothing is on disk of a frame at that time."""
        return timestamp > self.timestamps[-1] + _SAME_TIME

    def make_ready(self) -> None:
        """Leaves the growing files alone in the folder, cut off where the run goes on."""
        write_pose_records(self.folder, self.records)
        relative_pose_file.write_partial_frame_pairs(self.folder, self.pairs, self.records.timestamp)
        lines = (self.folder / FRAMES_NAME).read_text(encoding="utf-8").splitlines(keepends=True)
        atomic_write_text(self.folder / FRAMES_NAME, "".join(lines[: len(self.timestamps) + 1]))
        cut_inertial_records(self.folder, float(self.timestamps[-1]))
        remove_results(self.folder)

    def _other_input(self, reason: str) -> InputError:
        return InputError(
            f"{self.folder}: is a run of other frames ({reason}): give the same INPUT, --start, --every and --scale"
        )


def read_stopped_run(folder: Path, run: dict[str, Any]) -> StoppedRun:
    """What a run has left, killed or stopped with its results; only a row that was cut off is removed by reading it.

    Args:
        run: entries of run.json that it would have if it began now.
    Raises:
        InputError: there is no run, it still goes on or is complete, it had other input or settings, or no frame of it
            has a pose.
    """
    path, partial = folder / RUN_NAME, folder / PARTIAL_POSES
    if not (path.is_file() and (folder / FRAMES_NAME).is_file()):
        raise InputError(f"{folder}: holds no run that could go on: track without --resume")
    if partial.is_file():
        check_not_in_use(partial)
    entries = read_json(path, "the run", "track anew with --overwrite")
    _check_entries(folder, entries, json.loads(json.dumps(run)))
    records, pairs = _read_poses(folder)
    frames = read_whole_frames(folder / FRAMES_NAME)
    times, keyframe = frames.columns["timestamp"], frames.columns["keyframe"] == 1
    # Of the last frame that is whole in all files; a kill, or a power cut, leaves one ahead of the other.
    posed = np.flatnonzero(_is_among(times, records.timestamp))
    keyframes = posed[keyframe[posed]]
    if not len(keyframes):
        raise InputError(f"{folder}: none of its frames has a pose to go on from: track anew with --overwrite")
    times = times[: posed[-1] + 1]
    records = records.select(records.timestamp <= times[-1] + _SAME_TIME)
    keyframe_at = float(times[keyframes[-1]])
    first = int(np.abs(records.timestamp - keyframe_at).argmin())
    return StoppedRun(
        folder,
        [*entries.get("resumed_at", []), len(times)],
        times,
        keyframe_at,
        StartPose(records.pose[first], records.covariance[first]),
        records,
        pairs.select(pairs.later < len(records)),
    )


def _check_entries(folder: Path, entries: dict[str, Any], run: dict[str, Any]) -> None:
    """The run in the folder is of the kind that goes on, and had the same input and settings."""
    if entries.get("ended") == "complete":
        mend = f"; `sigmaslam report {folder}` writes its results" if (folder / PARTIAL_POSES).is_file() else ""
        raise InputError(f"{folder}: the run is complete, there is nothing to go on with{mend}")
    for name, option in (("map", "--map"), ("object", "--track-object"), ("location", "--location")):
        if entries.get(name) is not None:
            raise InputError(f"{folder}: a run with {option} cannot go on: track anew with --overwrite")
    for name in _SAME:
        had, has = entries.get(name), run.get(name)
        if had != has:
            values = f" ({had}, now {has})" if isinstance(has or had, str) else ""
            values += " or --start, --frames, by which rows are corrected" * (name == "calibration")
            raise InputError(f"{folder / RUN_NAME}: had another {name}{values}: give the same, or another --out")


def _read_poses(folder: Path) -> tuple[PoseRecords, relative_pose_file.FramePairs]:
    """From the growing files, or from the results where they are gone."""
    if (folder / PARTIAL_POSES).is_file() and (folder / relative_pose_file.PARTIAL_RELATIVE_POSES).is_file():
        records = read_pose_records(folder)
        return records, relative_pose_file.collect_frame_pairs(folder, records.timestamp)
    if not (folder / "trajectory.tum").is_file():
        raise InputError(f"{folder}: none of its frames has a pose to go on from: track anew with --overwrite")
    trajectory = read_tum(folder / "trajectory.tum")
    count = len(trajectory.timestamps)
    covariances = [read_covariances(folder / name, count) for name in ("covariance.npy", "covariance_matching.npy")]
    records = PoseRecords(trajectory.timestamps, trajectory.poses, *covariances)
    return records, relative_pose_file.read_frame_pairs(folder / relative_pose_file.RELATIVE_POSES_NAME, count)


def _is_among(times: np.ndarray, others: np.ndarray) -> np.ndarray:
    """(N,) bool, which of the time stamps (N,) are among the other ones (M,), both increasing; seconds."""
    if not len(others):
        return np.zeros(len(times), bool)
    return np.asarray(np.abs(others[nearest_rows(times, others)] - times) < _SAME_TIME)
