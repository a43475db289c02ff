"""Refining a run folder into another one."""

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bundle_adjustment.adjustment import Adjustment, RefineConfig, adjust
from sigmaslam.bundle_adjustment.gtsam_bridge import load_gtsam
from sigmaslam.bundle_adjustment.track_file import TRACKS_NAME, Tracks, read_tracks
from sigmaslam.errors import InputError
from sigmaslam.estimation.calibration_errors import ERRORS, measured_errors
from sigmaslam.files import atomic_write_json, check_new_folder, make_folder, save_array, save_arrays
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.se3 import se3_exp, se3_inverse, se3_log
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import read_covariances, read_tum, write_kitti, write_tum
from sigmaslam.report.report import write_report
from sigmaslam.run_record.frame_table import FRAMES_NAME
from sigmaslam.run_record.recorded_run import REFINE_NAME, REFINED_TRAJECTORY, read_final_trajectory, read_table
from sigmaslam.run_record.run_folder import RUN_NAME, check_has_trajectory, describe_versions, write_map_points
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.point_map import PointMap

_LOGGER = logging.getLogger(__name__)
_LOST = 4.0  # and more: variances of a lost frame over those of its keyframes
_COUNTS = ("observations", "outliers", "far_landmarks", "bridges", "iterations", "solves", "converged", "dof")


def refine_run(run: Path, out: Path, tell: Callable[[str], None] = lambda note: None) -> dict[str, Any]:
    """Bundle adjustment of the tracks of a run; writes trajectory, covariance, map and refine.json.

    Args:
        run: folder of `sigmaslam track --tracks`; the adjustment begins at its `trajectory_final.tum` if there is one.
        out: folder, new or empty.
        tell: receives messages on the progress.
    Returns:
        The content of refine.json.
    Raises:
        InputError: gtsam is not installed, a file of the run is missing or wrong, or `out` holds something.
    """
    load_gtsam()
    config = RefineConfig()
    began = time.perf_counter()
    check_has_trajectory(run)
    check_new_folder(out)
    _, trajectory = read_final_trajectory(run)
    tracks, errors = _without_errors(run, read_tracks(run / TRACKS_NAME, len(trajectory)))
    covariances = read_covariances(run / "covariance.npy", len(trajectory))
    make_folder(out)
    read = time.perf_counter()

    adjustment = adjust(tracks, trajectory.poses, covariances, config, tell)
    adjusted = time.perf_counter()
    summary = {
        "run": str(run),
        "configuration": asdict(config),
        "frames": len(trajectory),
        "keyframes": len(adjustment.frames),
        "landmarks": len(adjustment.points),
        **{name: getattr(adjustment, name) for name in _COUNTS},
        "cost_per_dof_before": adjustment.cost_before,
        "cost_per_dof_after": adjustment.cost_after,
        "disparity_offset_before": float(tracks.disparity_offset[0]),
        "disparity_offset_before_sigma": float(tracks.disparity_offset[1]),
        "calibration_errors": errors,
        "disparity_offset": adjustment.disparity_offset,
        "disparity_offset_sigma": adjustment.disparity_offset_sigma,
        "seconds_read": read - began,
        "seconds_adjust": adjusted - read,
        "versions": describe_versions("sigmaslam", "numpy", "gtsam"),
    }
    _write(out, trajectory, covariances, adjustment)
    atomic_write_json(out / REFINE_NAME, summary)
    _add_to_report(run, out, summary)
    return summary


def _without_errors(run: Path, tracks: Tracks) -> tuple[Tracks, dict[str, list[float]]]:
    """The tracks without the pair's errors that the run found, and these: but the offset, and of a rig that changed."""
    summary = read_table(run / RUN_NAME, "track").get("summary") or {}
    errors = {} if Doubt.RIG in summary.get("doubts", {}) else summary.get("calibration_errors") or {}
    mean = np.array([errors.get(name, [0.0])[0] for name in ERRORS])
    fx, fy, cx, cy, baseline = tracks.intrinsics.tolist()
    by_error = measured_errors(RectifiedStereo(fx, fy, cx, cy, baseline, 0, 0), tracks.measurement)
    return replace(tracks, measurement=tracks.measurement - by_error @ mean), errors


def spread_corrections(trajectory: Trajectory, frames: np.ndarray, poses: np.ndarray) -> Trajectory:
    """All frames, each corrected like the keyframes before and after it, interpolated in time on SE(3).

    Args:
        trajectory: N frames as tracked.
        frames: (K,) rows of the keyframes, increasing.
        poses: (K, 4, 4) their refined poses.
    """
    corrections = poses @ se3_inverse(trajectory.poses[frames])
    before = keyframe_before(frames, len(trajectory))
    after = np.minimum(before + 1, len(frames) - 1)
    since = trajectory.timestamps - trajectory.timestamps[frames[before]]
    interval = trajectory.timestamps[frames[after]] - trajectory.timestamps[frames[before]]
    # Frames before the first keyframe or after the last have only one neighbour.
    share = np.where(interval > 0, since / np.where(interval > 0, interval, 1.0), 0.0).clip(0.0, 1.0)
    change = se3_log(se3_inverse(corrections[before]) @ corrections[after])
    refined = corrections[before] @ se3_exp(share[:, None] * change) @ trajectory.poses
    refined[frames] = poses
    return Trajectory(trajectory.timestamps, refined)


def keyframe_before(frames: np.ndarray, count: int) -> np.ndarray:
    """Index (0 to K - 1) of the last keyframe up to each of `count` frames; the first one if there is none."""
    return np.maximum(np.searchsorted(frames, np.arange(count), side="right") - 1, 0)


def spread_covariances(frames: np.ndarray, refined: np.ndarray, tracked: np.ndarray) -> np.ndarray:
    """Covariances (N, 6, 6) of all frames: of the keyframe after, as the first one's is zero, or of the last one.

    Frames that are much less certain than the keyframes around them, as while lost, keep what was `tracked` (N, 6, 6).
    """
    size, before = np.trace(tracked, axis1=1, axis2=2), keyframe_before(frames, len(tracked))
    after = np.searchsorted(frames, np.arange(len(tracked))).clip(max=len(frames) - 1)
    is_lost = size > _LOST * np.maximum(size[frames[before]], size[frames[after]])
    return np.where(is_lost[:, None, None], tracked, refined[after])


def _write(out: Path, trajectory: Trajectory, covariances: np.ndarray, adjustment: Adjustment) -> None:
    refined = spread_corrections(trajectory, adjustment.frames, adjustment.poses)
    write_tum(out / "trajectory.tum", refined)
    write_kitti(out / "trajectory.kitti", refined, out / "times.txt")
    save_array(out / "covariance.npy", spread_covariances(adjustment.frames, adjustment.covariances, covariances))
    count = len(adjustment.points)
    # The adjustment does not keep the keyframe and the pixel that first saw a point.
    unknown = np.full((count, 4), np.nan)
    seen_first = unknown[:, 0], unknown[:, 1:3], unknown[:, 3]
    point_map = PointMap(adjustment.points, adjustment.point_covariances, adjustment.point_views, *seen_first)
    arrays = {name: getattr(point_map, name) for name in ("points", "covariances", "observations")}
    save_arrays(out / "map.npz", **arrays)
    write_map_points(out / "map.ply", point_map)


def _add_to_report(run: Path, out: Path, summary: dict[str, Any]) -> None:
    """Leaves what was refined in the folder of the run, too, and writes its report anew."""
    try:
        atomic_write_json(run / REFINE_NAME, summary)
        write_tum(run / REFINED_TRAJECTORY, read_tum(out / "trajectory.tum"))
        if (run / FRAMES_NAME).is_file():
            write_report(run)
    except (OSError, InputError) as error:
        _LOGGER.warning("the result is not in the report of the run: %s", getattr(error, "strerror", None) or error)
