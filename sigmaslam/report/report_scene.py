"""The 3D view of a report: what stands where."""

from typing import Any

import numpy as np

from sigmaslam.geometry.se3 import transform_points
from sigmaslam.live.frame_drawing import extent, format_length
from sigmaslam.run_record.frame_table import STATUSES
from sigmaslam.run_record.recorded_run import RecordedRun
from sigmaslam.table import even_rows

MAX_POSES, MAX_POINTS, MAX_ELLIPSOIDS, MAX_KEYFRAMES = 20_000, 40_000, 40, 400
"""With more of them an even selection is shown."""
MAGNIFICATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
"""Ellipsoids may be drawn so many times as large."""
# At first such that the median one of 3 sigma is this share of the view, or as they are.
_VISIBLE = 0.02


def build_scene(run: RecordedRun, most: int = MAX_POSES, start: float | None = None) -> dict[str, Any] | None:
    """Path, ellipsoids, map points, keyframes and loops; None where no frame has a pose.

    Of a run that follows a body the path is the body's, and its points are where it was last.

    Args:
        most: poses of its path.
        start: time stamp of 0 s; by default that of the first frame.
    """
    if not len(run.trajectory):
        return None
    positions = run.trajectory.positions
    shown = even_rows(len(positions), most)
    # A short loss stays visible in a selection.
    lost = np.flatnonzero(np.array(run.pose_status) == "lost")
    shown = np.union1d(shown, lost[even_rows(len(lost), most)])
    seconds = run.trajectory.timestamps - (run.frames.columns["timestamp"][0] if start is None else start)
    status = np.array([STATUSES.index(each) for each in run.pose_status], np.uint8)
    # Corners of what the view shows.
    low, high = extent(positions, _placed_points(run), 0.5 * (positions.min(axis=0) + positions.max(axis=0)), 10.0)
    size = max(float(np.linalg.norm(high - low)), 1e-3)
    keyframes, loops = _keyframes(run)
    ellipsoids, chosen = _ellipsoids(run)
    scene = {
        "centre": (0.5 * (low + high)).tolist(),
        "extent": (high - low).tolist(),
        "size": size,
        "path": positions[shown],
        "path_seconds": seconds[shown],
        "path_status": status[shown],
        "labels": _labels(run, seconds, shown),
        "ellipsoids": ellipsoids,
        "ellipsoid_status": status[chosen],
        "magnification": _magnification(run, size),
        "magnifications": MAGNIFICATIONS,
        "keyframes": keyframes,
        "loops": loops,
        **_points(run),
    }
    if run.dense is not None:
        scene |= {"dense": run.dense.points, "dense_colours": run.dense.colours}
    others = {
        name: line.positions for name, line in (("final", run.final), ("refined", run.refined)) if line is not None
    }
    if run.evaluated is not None:
        others["truth"] = run.evaluated.truth
    return scene | {name: line[even_rows(len(line), most)] for name, line in others.items()}


def _placed_points(run: RecordedRun) -> np.ndarray:
    if run.map is None:
        return np.zeros((0, 3))
    return transform_points(run.trajectory.poses[-1], run.map.points) if "object" in run.entries else run.map.points


def _points(run: RecordedRun) -> dict[str, Any]:
    """Map points, their sigmas, and their grey values where they are known."""
    if run.map is None:
        return {"points": np.zeros((0, 3)), "point_sigma": np.zeros(0), "point_grey": None}
    shown = even_rows(len(run.map.points), MAX_POINTS)
    grey = run.map.colours[shown, 0]
    known = np.isfinite(grey).all()
    return {
        "points": _placed_points(run)[shown],
        "point_sigma": run.map.sigma[shown],
        "point_grey": grey.astype(np.uint8) if known else None,
    }


def _keyframes(run: RecordedRun) -> tuple[np.ndarray, np.ndarray]:
    """Poses (K, 4, 4) of keyframes, and segments (L, 2, 3) from where a loop was closed to where it began."""
    of_poses = {name: run.frames.columns[name][run.pose_row] for name in ("keyframe", "loop")}
    rows = np.flatnonzero(of_poses["keyframe"] == 1)
    closing = np.flatnonzero(np.isfinite(of_poses["loop"]))
    # The keyframe may be one of an earlier run, whose map was given.
    last = len(run.trajectory) - 1
    began = np.searchsorted(run.trajectory.timestamps, of_poses["loop"][closing] - 1e-6).clip(0, last)
    same = np.abs(run.trajectory.timestamps[began] - of_poses["loop"][closing]) < 1e-3
    positions = run.trajectory.positions
    loops = np.stack([positions[closing[same]], positions[began[same]]], axis=1)
    return run.trajectory.poses[rows[even_rows(len(rows), MAX_KEYFRAMES)]], loops


def _ellipsoids(run: RecordedRun) -> tuple[np.ndarray, np.ndarray]:
    """Transforms (E, 4, 4) of the unit sphere into 1-sigma ellipsoids of positions, and the poses (E,) they are of."""
    known = np.flatnonzero(np.isfinite(run.covariances).all(axis=(1, 2)))
    rows = known[even_rows(len(known), MAX_ELLIPSOIDS)]
    variances, axes = np.linalg.eigh(run.covariances[rows, :3, :3])
    transforms = run.trajectory.poses[rows].copy()
    half_axes = axes * np.sqrt(np.maximum(variances, 0.0))[:, None, :]
    transforms[:, :3, :3] = run.trajectory.rotations[rows] @ half_axes
    return transforms, rows


def _magnification(run: RecordedRun, size: float) -> int:
    """One of `MAGNIFICATIONS` by which ellipsoids can be seen."""
    sigma = run.sigmas[0]
    sigma = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(sigma):
        return 1
    wanted = _VISIBLE * size / (3.0 * float(np.median(sigma)))
    return int(MAGNIFICATIONS[np.abs(np.log(np.array(MAGNIFICATIONS) / wanted)).argmin()])


def _labels(run: RecordedRun, seconds: np.ndarray, shown: np.ndarray) -> list[str]:
    """What is said of each pose where the mouse is on it."""
    position, rotation = run.sigmas
    drift, turn = run.sigmas_over_a_second
    status = run.pose_status
    return [
        f"{seconds[k]:.2f} s, {status[k]}\nsigma {format_length(position[k])}, {np.degrees(rotation[k]):.3g} deg"
        + (f"; over a second {format_length(drift[k])}, {np.degrees(turn[k]):.3g} deg" if np.isfinite(drift[k]) else "")
        for k in shown
    ]
