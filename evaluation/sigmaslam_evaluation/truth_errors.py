"""How good a truth is: its kind, the errors of this kind, and poses that nobody measured."""

import math
from pathlib import Path
from typing import Literal

import numpy as np

from sigmaslam.geometry.se3 import rotation_log, se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import trajectory_format
from sigmaslam_evaluation.metrics.trajectory_errors import synchronise
from sigmaslam_evaluation.metrics.truth_covariance import TruthErrors, truth_covariance

TruthKind = Literal["gps", "mocap", "exact"]
TRUTH_SIGMAS = {"gps": (0.2, 0.1), "mocap": (0.002, 0.2), "exact": (0.0, 0.0)}
"""Of each coordinate, metres, and about each axis, degrees: what KITTI's OXTS says of itself without RTK, and the data
sheet of its heading; what EuRoC's authors say of Vicon and laser tracker with an IMU."""
# Sigma of a height over that of another coordinate: at 95 % GPS is within 13 m in height and 8 m in the plane (Standard
# Positioning Service Performance Standard, 2020), which is 6.6 m and 3.3 m a coordinate.
_GPS_HEIGHT = 2.0
# What KITTI's OXTS says of the velocity by which INS carries a position on, m/s.
_GPS_DRIFT = 0.03
KIND_WORDS = {"gps": "GPS/INS", "mocap": "motion capture or a laser tracker", "exact": "exact"}
# No motion capture looks further, metres.
_LARGEST_HALL = 40.0
# A vehicle's turn a frame changes by hundredths of a degree (KITTI). One that is constant to this over so many steps,
# and so long, was not measured there, degrees, seconds.
_CONSTANT, _CONSTANT_STEPS, _CONSTANT_TIME = 2e-3, 5, 0.4
# A step that turns less may be constant by the file's digits, or because nothing turns: a stage, a stop.
_LEAST_TURN = 25 * _CONSTANT


def truth_errors(
    path: Path, truth: Trajectory, kind: TruthKind | None, given: tuple[float | None, float | None]
) -> tuple[TruthErrors | None, str | None]:
    """Errors of a truth, None where it is exact; and what is said where its kind is guessed.

    Heights of GPS are along the camera's y in KITTI's format, else along the world's z.

    Args:
        path, truth: of `guess_truth_kind`.
        kind: of the truth; None: guessed.
        given: sigmas of each coordinate, metres, and about each axis, degrees, in place of the kind's.
    """
    known, reason = (kind or "exact", "") if kind or None not in given else guess_truth_kind(path, truth)
    usual = TRUTH_SIGMAS[known]
    position, rotation = (own if said is None else said for own, said in zip(usual, given, strict=True))
    covariance, unrelated_after = truth_covariance(position, rotation), 0.0
    if known == "gps" and given[0] is None:
        vertical = truth.poses[:, 1 if trajectory_format(path) == "kitti" else 2, :3]  # in the body
        covariance = np.tile(covariance, (len(truth), 1, 1))
        covariance[:, :3, :3] += (_GPS_HEIGHT**2 - 1.0) * position**2 * vertical[:, :, None] * vertical[:, None, :]
        unrelated_after = math.sqrt(2.0) * position / _GPS_DRIFT
    errors = TruthErrors(covariance, unrelated_after) if max(position, rotation) > 0.0 else None
    if not reason:
        return errors, None
    words = f"sigma {position:g} m and {rotation:g} deg" if errors else "without errors"
    return errors, (
        f"is taken for {KIND_WORDS[known]}, {words}, as {reason}: --truth-kind, or --truth-sigma-position and "
        "--truth-sigma-rotation, say it better"
    )


def guess_truth_kind(path: Path, truth: Trajectory) -> tuple[TruthKind, str]:
    """What measured a truth, and why this is thought.

    Args:
        path: of the file; renders have a `scene.json` beside it.
        truth: what it holds, metres.
    """
    if (path.parent / "scene.json").is_file():
        return "exact", "a render's scene.json lies beside it"
    form, extent = trajectory_format(path), float(np.ptp(truth.positions, axis=0).max())
    if form == "kitti":
        return "gps", "its format is KITTI's"
    if form == "euroc":
        return "mocap", "its format is EuRoC's"
    return ("mocap" if extent < _LARGEST_HALL else "gps"), f"its poses extend over {extent:.3g} m"


def leave_out_interpolated(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, str | None]:
    """The truth without poses that are interpolated, at the frames of the estimate, between two others; and a word.

    They turn alike to the digit from frame to frame. The first and the last pose of such a stretch may be measured and
    stay, but at an end of the file. All stay where fewer than two would: such a motion is made, not filled in.
    """
    paired = synchronise(estimate, truth)[1]
    kept, at_frames = np.ones(len(truth), bool), np.zeros(len(paired), bool)
    for begin, end in _constant_turns(paired):
        kept &= (truth.timestamps <= begin) | (truth.timestamps >= end)
        at_frames |= (paired.timestamps > begin) & (paired.timestamps < end)
    count = int(at_frames.sum())
    if count == 0 or len(paired) - count < 2:
        return truth, None
    first, last = paired.timestamps[at_frames][[0, -1]]
    return truth.subset(np.flatnonzero(kept)), (
        f"has {count} poses from {first:.3f} to {last:.3f} s that are left out: they turn alike to {_CONSTANT} deg a "
        "frame, so they are interpolated, not measured (--truth-kind exact keeps them)"
    )


def _constant_turns(truth: Trajectory) -> list[tuple[float, float]]:
    """Open intervals of time within which steps turn alike; infinite where they begin or end with the file."""
    times, duration = truth.timestamps, np.diff(truth.timestamps)[:, None]
    turns = np.degrees(rotation_log((se3_inverse(truth.poses[:-1]) @ truth.poses[1:])[:, :3, :3]))
    rates = turns / duration * np.median(duration) if len(turns) else turns
    # In time, or from frame to frame where the file's own stamps were rounded.
    change = [np.linalg.norm(np.diff(each, axis=0), axis=1) for each in (turns, rates)]
    alike = (np.minimum(*change) < _CONSTANT) & (np.linalg.norm(turns[:-1], axis=1) > _LEAST_TURN)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], alike.astype(int), [0]]))).reshape(-1, 2)
    return [
        (-np.inf if first == 0 else times[first], np.inf if last == len(alike) else times[last + 1])
        for first, last in edges
        if last - first >= _CONSTANT_STEPS - 1 and times[last + 1] - times[first] >= _CONSTANT_TIME
    ]
