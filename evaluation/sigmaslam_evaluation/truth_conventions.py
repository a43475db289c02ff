"""Conventions of truth files: frame, unit, clock. Applies those that are said, finds those that fit."""

from dataclasses import astuple, dataclass
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.geometry.se3 import matrix_to_quaternion, quaternion_to_matrix, rotation_exp, rotation_log, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam_evaluation.metrics.trajectory_errors import absolute_trajectory_error, associate, synchronise

# Another convention is the right one where it leaves less than this share of the error.
COLLAPSE = 0.1
# Of conventions whose errors differ by less than this factor, the one with the fewest changes is taken.
_ALIKE = 2.0
# The axes of a camera (x right, y down, z ahead) in a body with x ahead, y left and z up.
R_BODY_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
# Seconds between stamps of one moment, and between poses to interpolate: of 10 Hz with jitter, over which a line misses
# less than the nearest pose does, unless the speed changes by as much as itself.
_SAME, _WIDEST = 1e-6, 0.15
# Seconds that a clock may be off; the right offset leaves less than this share of the misfit: noise of 100 poses 0.27.
_OFFSETS, _CLEARLY, _FEWEST_POSES = 0.01 * np.arange(-50, 51), 0.15, 50
# Names that truths have in recordings' folders.
_TRUTHS = (
    "groundtruth.tum",
    "groundtruth.txt",
    "poses.txt",
    "mav0/state_groundtruth_estimate0/data.csv",
    "mav0/mocap0/data.csv",
    "groundtruth.csv",
)


def find_truth(path: Path) -> Path:
    """The true poses of a recording's folder; `path` itself if it is none.

    Raises:
        InputError: the folder has no file of a usual name.
    """
    found = [path / name for name in _TRUTHS if (path / name).is_file()] if path.is_dir() else [path]
    if not found:
        raise InputError(f"{path}: a folder without {', '.join(_TRUTHS)}; give the file of the true poses")
    return found[0]


@dataclass(frozen=True, slots=True)
class TruthConvention:
    """How a truth file is to be read; the defaults are the project's own.

    Attributes:
        frame: whose poses they are: of the camera (z ahead), or of a body (x ahead, z up) in the camera's place.
        inverse: they take points of the world into that frame.
        quaternion: order of TUM's last four columns.
        unit: of positions.
    """

    frame: Literal["camera", "body"] = "camera"
    inverse: bool = False
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    unit: Literal["m", "cm", "mm"] = "m"

    def apply(self, truth: Trajectory) -> Trajectory:
        """T_world_camera in metres, of a file that was read with the defaults."""
        poses = truth.poses.copy()
        poses[:, :3, 3] *= UNITS[self.unit]
        if self.quaternion == "wxyz":
            poses[:, :3, :3] = quaternion_to_matrix(np.roll(matrix_to_quaternion(poses[:, :3, :3]), -1, axis=-1))
        poses = se3_inverse(poses) if self.inverse else poses
        if self.frame == "body":
            poses[:, :3, :3] = poses[:, :3, :3] @ R_BODY_CAMERA
        return Trajectory(truth.timestamps, poses)

    def describe(self) -> str:
        """In words and as options, as `poses of a body ...: --truth-frame body`."""
        words = [
            (self.frame == "body", "poses of a body with x ahead", "--truth-frame body"),
            (self.inverse, f"T_{self.frame}_world", "--truth-inverse"),
            (self.quaternion == "wxyz", "quaternions with w first", "--truth-quaternion wxyz"),
            (self.unit != "m", f"{'centi' if self.unit == 'cm' else 'milli'}metres", f"--truth-unit {self.unit}"),
        ]
        chosen = [(name, option) for wanted, name, option in words if wanted]
        if not chosen:
            return "poses of the camera, in the usual form: give no option on how to read it"
        return f"{', '.join(name for name, _ in chosen)}: {' '.join(option for _, option in chosen)}"


def find_convention(
    estimate: Trajectory, truth: Trajectory, given: TruthConvention, has_quaternions: bool
) -> TruthConvention | None:
    """The convention that makes the error collapse.

    Errors are of poses relative to the first, so every convention but the right one turns or bends the path. The
    position error must be below a tenth of the given one's, the rotation error no larger, a unit right to a factor 2.

    Args:
        estimate: N poses.
        truth: as it was read from the file, with the default convention.
        given: how it is read.
        has_quaternions: the file has quaternions whose order can be wrong.
    Returns:
        None where no other makes the error collapse.
    """
    estimate, truth = synchronise(estimate, truth)
    now = absolute_trajectory_error(estimate, given.apply(truth), "origin")
    usual, found = astuple(TruthConvention()), []
    for choice in product(("camera", "body"), (False, True), ("xyzw", "wxyz")[: 1 + has_quaternions], UNITS):
        candidate = TruthConvention(*choice)  # type: ignore[arg-type]
        error = absolute_trajectory_error(estimate, read := candidate.apply(truth), "origin")
        fits = candidate.unit == given.unit or 0.5 * estimate.path_length < read.path_length < 2 * estimate.path_length
        if fits and error.rmse < COLLAPSE * now.rmse and error.rotation_rmse_deg <= now.rotation_rmse_deg:
            changes = sum(value != default for value, default in zip(choice, usual, strict=True))
            found.append((changes, error.rmse, candidate))
    least = min((rmse for _, rmse, _ in found), default=0.0)
    alike = [each for each in found if each[1] <= _ALIKE * least]
    return min(alike, key=lambda each: each[:2])[2] if alike else None


def describe_mirror(estimate: Trajectory, truth: Trajectory) -> str | None:
    """In words, the axis along which positions of the truth have the wrong sign; None where no mirror fits it.

    Rotations may be mirrored alike, or be right. What counts is as of `find_convention`.

    Args:
        estimate: N poses.
        truth: T_world_camera in metres.
    """
    now = absolute_trajectory_error(estimate, truth, "origin")
    for axis, name in enumerate("xyz"):
        mirror = 1.0 - 2.0 * np.eye(3)[axis]
        for both in (True, False):
            poses = truth.poses.copy()
            poses[:, :3, 3] *= mirror
            poses[:, :3, :3] *= mirror[:, None] * mirror if both else 1.0
            error = absolute_trajectory_error(estimate, Trajectory(truth.timestamps, poses), "origin")
            if error.rmse < COLLAPSE * now.rmse and error.rotation_rmse_deg <= now.rotation_rmse_deg:
                also = ", also of its rotations" if both else ""
                return f"a mirror image: change the sign of {name} in the file{also}"
    return None


def describe_lack_of_rotation(estimate: Trajectory, truth: Trajectory) -> str | None:
    """In words, that only the estimate turns; None where both do, or the estimate by less than 5 degrees."""
    turns = (np.degrees(rotation_log(each.rotations[0].T @ each.rotations)) for each in synchronise(estimate, truth))
    turned, true = (np.linalg.norm(each, axis=1).max() for each in turns)
    words = f"never turns, the run by {turned:.0f} deg: of positions alone only ATE in the best alignment counts"
    return words if turned > 5.0 and true < 1e-3 else None


def describe_clock_offset(estimate: Trajectory, truth: Trajectory) -> str | None:
    """In words, by how much the truth's stamps look late or early; None where no offset fits clearly better.

    Lengths and turns of steps are compared, which need no common frame. With both sigmas unknown the likeliest offset
    has the least product of their mean square errors. The mean of two places has the truth's noise alike everywhere.
    """
    first, last = truth.timestamps[[0, -1]] - _OFFSETS[[0, -1]]
    estimate = estimate.subset((estimate.timestamps >= first) & (estimate.timestamps <= last))
    if len(estimate) < _FEWEST_POSES:
        return None
    sizes, quarter, misfits = _step_sizes(estimate.poses), np.median(np.diff(truth.timestamps)) / 4, []
    for times in estimate.timestamps + _OFFSETS[:, None]:
        errors = _step_sizes((_poses_at(truth, times - quarter) + _poses_at(truth, times + quarter)) / 2) - sizes
        misfits.append(np.prod((errors**2).mean(axis=1) + 1e-12))  # of a file's digits
    best = int(np.argmin(misfits))
    if best in (0, len(misfits) - 1) or misfits[best] > _CLEARLY * misfits[len(misfits) // 2]:
        return None
    offset = 1e3 * _OFFSETS[best]
    return f"has stamps that look about {abs(offset):.0f} ms {'later' if offset > 0.0 else 'earlier'} than the run's"


def interpolate_truth(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, str | None]:
    """The truth with poses moved to the stamps of the estimate's that they pair with, and a word.

    A pose moves on the line between its neighbours, 0.15 s apart at most, and turns about one axis (slerp); covariances
    hold on, as a mean's are no larger. Ends of a truth that is interpolated are cut to poses with two neighbours.
    """
    rows, paired = associate(estimate, truth)
    times, stamps, poses = estimate.timestamps[rows], truth.timestamps.copy(), truth.poses.copy()
    distance, after = np.abs(times - stamps[paired]), np.searchsorted(stamps, times)
    width = np.diff(stamps, prepend=-np.inf, append=np.inf)[after]
    moved, alone = (distance > _SAME) & (width < _WIDEST), (distance > _SAME) & np.isinf(width)
    if not moved.any() or len(paired) - alone.sum() < 2:
        return truth, None
    first, second = truth.rotations[after[moved] - 1], truth.rotations[after[moved]]
    turns = ((times - stamps[after - 1]) / width)[moved, None] * rotation_log(np.swapaxes(first, 1, 2) @ second)
    stamps[paired[moved]], poses[paired[moved]] = times[moved], _poses_at(truth, times[moved])
    poses[paired[moved], :3, :3] = first @ rotation_exp(turns)
    kept = slice(paired[1] if alone[0] else 0, paired[-2] + 1 if alone[-1] else None)
    median = f"{1e3 * np.median(distance[moved]):.2g} ms from its nearest in the median"
    return Trajectory(stamps[kept], poses[kept]), f"is interpolated at {moved.sum()} poses, {median}"


def times_in_seconds(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, str]:
    """The truth in seconds, and "time", with the unit its times have where it is one of `TIME_UNITS`.

    More poses must pair with that than with seconds, and more than half of all.
    """
    scaled = {unit: Trajectory(truth.timestamps * size, truth.poses) for unit, size in TIME_UNITS.items()}
    counts = {unit: _count_pairs(estimate, each) for unit, each in scaled.items()}
    best = max(counts, key=lambda unit: counts[unit])
    if counts[best] <= max(_count_pairs(estimate, truth), min(len(estimate), len(truth)) // 2):
        return truth, "time"
    return scaled[best], f"time, that of the truth in {best}"


def _poses_at(truth: Trajectory, times: np.ndarray) -> np.ndarray:
    """(N, 4, 4) on the lines between the poses before and after, their rotations too."""
    after = np.clip(np.searchsorted(truth.timestamps, times), 1, len(truth) - 1)
    share = (times - truth.timestamps[after - 1]) / (truth.timestamps[after] - truth.timestamps[after - 1])
    return truth.poses[after - 1] + share[:, None, None] * (truth.poses[after] - truth.poses[after - 1])


def _step_sizes(poses: np.ndarray) -> np.ndarray:
    """(2, N-1) how far steps between poses (N, 4, 4) go, metres, and turn, as chords of rotations."""
    steps = np.diff(poses[:, :3], axis=0)
    return np.stack([np.linalg.norm(steps[:, :, 3], axis=1), np.linalg.norm(steps[:, :, :3], axis=(1, 2))])


def _count_pairs(estimate: Trajectory, truth: Trajectory) -> int:
    try:
        return len(associate(estimate, truth)[0])
    except InputError:
        return 0
