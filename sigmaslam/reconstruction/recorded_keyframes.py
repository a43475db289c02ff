"""Keyframes of a run folder: where they were, how well that is known, and their images from the run's input.

Where keyframes are far apart in time, as in slow motion, frames between them help to see what they saw.
"""

import tempfile
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import read_json
from sigmaslam.calibration_files.calibration_writer import write_calibration
from sigmaslam.errors import CalibrationError, InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_adjoint, se3_inverse
from sigmaslam.readers import StereoFrame, StereoSequence, open_sequence
from sigmaslam.readers.open import FORMATS
from sigmaslam.readers.selection import Selection
from sigmaslam.readers.trajectory_files import read_covariances
from sigmaslam.run_record.frame_table import FRAMES_NAME, FrameTable, read_frames
from sigmaslam.run_record.recorded_run import read_final_trajectory
from sigmaslam.run_record.relative_pose_file import RELATIVE_POSES_NAME, FramePairs, read_frame_pairs
from sigmaslam.run_record.run_folder import FINAL_COVARIANCE, RUN_NAME, camera_of, check_has_trajectory

MOST_FRAMES = 5
"""From one view to the next, at the most."""
# Time stamps of run and input agree to this, seconds; frames.csv and trajectory.tum round them.
_SAME_TIME = 1e-4


@dataclass(frozen=True, slots=True)
class RecordedKeyframes:
    """The keyframes of a run and frames between them: K views in time.

    Attributes:
        source, format: of the run's input.
        is_keyframe: (K,) bool.
        timestamps: (K,) seconds.
        poses: (K, 4, 4) T_world_camera of the left camera, after the fact where the run has that.
        covariances: (K, 6, 6) of the poses in their own frames, translation (metres) before rotation (radians).
        disparity_offset, disparity_offset_sigma: (K,) measured minus true disparity as last estimated, pixels; of views
            before a bump of the rig before that.
        raised: (K,) rows by which right images are raised after a bump.
        frames: (K,) rows of the views in trajectory.tum.
        pairs: relative poses of the run.
        pair_times: (M, 2) time stamps of their earlier and later frames, seconds.
        mask: that the run was given.
    """

    source: Path
    format: str
    camera: StereoCamera
    is_keyframe: np.ndarray
    timestamps: np.ndarray
    poses: np.ndarray
    covariances: np.ndarray
    disparity_offset: np.ndarray
    disparity_offset_sigma: np.ndarray
    raised: np.ndarray
    frames: np.ndarray
    pairs: FramePairs
    pair_times: np.ndarray
    mask: Path | None = None

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def count(self) -> int:
        """How many of the views are keyframes."""
        return int(self.is_keyframe.sum())

    def step(self, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
        """T_last_first (4, 4) of two views and its covariance (6, 6), perturbed from the left in the last.

        The covariance is that of the pair in relative_poses.npz with the same later frame and the next larger
        distance in time, or of the largest one, grown with the square of time; that of a longer way is on the safe
        side.
        """
        earlier, later = min(first, last), max(first, last)
        step = se3_inverse(self.poses[last]) @ self.poses[first]
        covariance = self._relative_covariance(earlier, later)
        # Of T_earlier_later in the later one's frame; the inverse is perturbed from the left there.
        if last != later:
            adjoint = se3_adjoint(se3_inverse(self.poses[earlier]) @ self.poses[later])
            covariance = adjoint @ covariance @ adjoint.T
        return step, covariance

    def _relative_covariance(self, earlier: int, later: int) -> np.ndarray:
        rows = np.flatnonzero(self.pairs.later == self.frames[later])
        duration = self.timestamps[later] - self.timestamps[earlier]
        if not len(rows):
            # Nothing relates the frame to earlier ones: both poses are as uncertain as they are in the world.
            adjoint = se3_adjoint(se3_inverse(self.poses[later]) @ self.poses[earlier])
            return np.asarray(self.covariances[later] + adjoint @ self.covariances[earlier] @ adjoint.T)
        spans = self.pair_times[rows, 1] - self.pair_times[rows, 0]
        longer = np.flatnonzero(spans >= duration - _SAME_TIME)
        chosen = longer[spans[longer].argmin()] if len(longer) else spans.argmax()
        growth = max(duration / max(spans[chosen], _SAME_TIME), 1.0) ** 2
        return np.asarray(growth * self.pairs.covariance[rows[chosen]])

    def images(self, sequence: StereoSequence) -> Iterator[tuple[int, StereoFrame]]:
        """Number and images of each view, in order.

        Raises:
            InputError: the sequence lacks one of them.
        """
        wanted = 0
        with closing(sequence.at(self.timestamps - _SAME_TIME).frames()) as frames:
            for frame in frames:
                if frame.timestamp > self.timestamps[wanted] + _SAME_TIME:
                    break
                if frame.timestamp > self.timestamps[wanted] - _SAME_TIME:
                    yield wanted, frame
                    wanted += 1
                    if wanted == len(self):
                        return
        raise InputError(
            f"{sequence.source}: has no frame at {self.timestamps[wanted]:.6f} s, which the run has: give "
            "the input of this run by --input"
        )


def read_recorded_keyframes(run: Path, every: int = 1) -> RecordedKeyframes:
    """Keyframes of a run of `sigmaslam track`; of so many one.

    Raises:
        InputError: the folder is no such run, follows an object, or a file is missing or wrong.
    """
    check_has_trajectory(run)
    entries = _read_entries(run / RUN_NAME)
    if "object" in entries:
        raise InputError(f"{run}: follows an object before a camera at rest: give a run of a moving camera")
    if entries.get("format") == "camera":
        raise InputError(f"{run}: was tracked live and its images are not kept: track a recording")
    has_final = (run / FINAL_COVARIANCE).is_file()
    said, final = read_final_trajectory(run)
    trajectory = final if has_final else said
    covariances = read_covariances(run / (FINAL_COVARIANCE if has_final else "covariance.npy"), len(said))
    frames = read_frames(run / FRAMES_NAME)
    times = frames.columns["timestamp"][frames.columns["keyframe"] == 1]
    rows = np.searchsorted(said.timestamps, times - _SAME_TIME).clip(0, len(said) - 1)
    rows = np.unique(rows[np.abs(said.timestamps[rows] - times) < _SAME_TIME])
    keyframe_rows = rows = rows[::every]
    rows = _with_frames_between(rows, len(said))
    if len(rows) < 2:
        raise InputError(f"{run}: has {len(rows)} frame with a pose, two are needed: track a longer sequence")
    pairs = read_frame_pairs(run / RELATIVE_POSES_NAME, len(said))
    offset, sigma, raised = _calibrations(frames, said.timestamps[rows])
    return RecordedKeyframes(
        Path(str(entries["input"])),
        str(entries["format"]),
        camera_of(run / RUN_NAME, entries["calibration"]),
        np.isin(rows, keyframe_rows),
        said.timestamps[rows],
        trajectory.poses[rows],
        covariances[rows],
        *(offset, sigma, raised, rows),
        pairs,
        said.timestamps[np.stack([pairs.earlier, pairs.later], axis=1)],
        Path(entries["mask"]) if entries.get("mask") else None,
    )


def _calibrations(frames: FrameTable, times: np.ndarray) -> np.ndarray:
    """(3, K) disparity offset, its sigma and rows raised at such times (K,): those last said while the rig was so."""
    columns = [frames.columns[name] for name in ("disparity_offset", "disparity_offset_sigma", "raised", "timestamp")]
    said = np.stack(columns)[:, np.isfinite(columns[0]) & np.isfinite(columns[1])]
    if not said.shape[1]:
        return np.zeros((3, len(times)))
    raised = said[2] = np.nan_to_num(said[2])
    last = {rows: k for k, rows in enumerate(raised.tolist())}
    at = raised[np.searchsorted(said[3], times - _SAME_TIME).clip(0, len(raised) - 1)]
    return np.asarray(said[:3, [last[rows] for rows in at.tolist()]])


def open_input(keyframes: RecordedKeyframes, moved_to: Path | None = None) -> StereoSequence:
    """The run's input, with images of the size of the run's calibration.

    Args:
        moved_to: where the input is now, if not where the run found it.
    Raises:
        InputError: it is not there, or is another one.
    """
    source = moved_to or keyframes.source
    if not source.exists():
        raise InputError(f"{source}: the input of the run is not there: give the place where it is by --input")
    format = keyframes.format if keyframes.format in FORMATS else "auto"
    with tempfile.TemporaryDirectory() as scratch:
        calibration = Path(scratch) / "calibration.yaml"
        write_calibration(calibration, keyframes.camera)
        try:
            stored = open_sequence(source, format, calibration)
        except CalibrationError:
            # The run made the images smaller.
            stored = open_sequence(source, format)
    sequence = stored.select(Selection(), keyframes.camera.left.width / stored.camera.left.width)
    sizes = [(camera.left.width, camera.left.height) for camera in (sequence.camera, keyframes.camera)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"{source}: has images of {stored.camera.left.width}x{stored.camera.left.height} pixels, the run had "
            f"{sizes[1][0]}x{sizes[1][1]}: give the input of this run by --input"
        )
    if keyframes.mask is not None:
        sequence.use_masks(keyframes.mask)
    return sequence


def _with_frames_between(keyframes: np.ndarray, count: int) -> np.ndarray:
    """Increasing rows of keyframes (K,), and of frames, of `count`, that divide what lies between evenly."""
    ends = np.unique(np.r_[keyframes, count - 1])
    parts = [
        np.linspace(first, last, -(-(last - first) // MOST_FRAMES) + 1).round().astype(np.int64)
        for first, last in pairwise(ends)
    ]
    return np.unique(np.concatenate([ends, *parts]))


def _read_entries(path: Path) -> dict[str, Any]:
    mend = "give a folder written by `sigmaslam track`"
    entries = read_json(path, "the run", mend)
    missing = [name for name in ("input", "format", "calibration") if name not in entries]
    if missing:
        raise InputError(f"{path}: says nothing of {', '.join(missing)}; {mend}")
    return dict(entries)
