"""The results of a run, made from what it left on disk as it went; each is tried on its own."""

import logging
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.checks.finding import Finding, wrong
from sigmaslam.errors import OutputError, SigmaSlamError
from sigmaslam.estimation.frame_clock import missing_frames, stamp_noise
from sigmaslam.files import atomic_write_json, save_array, save_arrays
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_kitti, write_tum
from sigmaslam.run_record import frame_table, run_folder
from sigmaslam.run_record.frame_pictures import PICTURES_NAME
from sigmaslam.run_record.inertial_file import describe_gravity, read_inertial_records
from sigmaslam.run_record.pose_file import PARTIAL_POSES, POSES_NAME, PoseRecords, read_pose_records, write_pose_table
from sigmaslam.run_record.relative_pose_file import PARTIAL_RELATIVE_POSES, RELATIVE_POSES_NAME, collect_frame_pairs
from sigmaslam.run_record.verdict import calibration_verdict, expected_offset, explain_failure
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.estimate import CalibrationEstimate
from sigmaslam.slam.point_map import PointMap

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class TrackerResults:
    """What the tracker alone knows when a run ends; each is computed when it is written.

    Attributes:
        keyframes: arrays by name, with which a later run relocalises in the map.
        final: the frames as they are known in the end, with covariances; they are written beside those said at once.
            None where other sensors corrected the poses, whose covariances then have no part of matches alone.
        others: more files, by name, in the order in which they are written before the map.
        pictures: writes pictures of frames, also of a run that failed.
        judge_imu: findings about an inertial sensor from times (N,), poses and which of them images gave; None without.
    """

    point_map: Callable[[], PointMap]
    keyframes: Callable[[], dict[str, Any]]
    final: Callable[[], tuple[Trajectory, np.ndarray]] | None
    others: Mapping[str, Callable[[Path], None]]
    pictures: Callable[[Path], None]
    judge_imu: Callable[[np.ndarray, np.ndarray, np.ndarray], list[Finding]] | None = None


def write_results(
    folder: Path, run: dict[str, Any], calibration: CalibrationEstimate | None, tracker: TrackerResults | None
) -> tuple[dict[str, Any], list[str]]:
    """Writes trajectory and covariances, then relative poses, map, run.json and report.html.

    Poses and frames are read from the folder. They stay there in their raw form if something could not be written that
    can be made of them.

    Args:
        run: entries of run.json beside the summary.
        calibration: what the last frame said of it; None: what is on disk of that.
        tracker: None for a run that was killed: the map and the trajectory after the fact are lost then.
    Returns:
        The summary, and the names of the files that could not be written; the log says why.
    """
    files = _Files(folder)
    frames = frame_table.read_whole_frames(folder / frame_table.FRAMES_NAME)
    records = read_pose_records(folder)
    records = records.select(records.timestamp <= frames.columns["timestamp"].max(initial=-np.inf) + 1e-9)
    started, tracked = len(records) > 0, frames.count(frame_table.TRACKED)
    if not tracked:
        # A start that no second frame confirms is none.
        records = records.select(np.zeros(0, np.int64))
    calibration = calibration or _last_calibration(frames)
    _write_poses(files, records, frames, run.get("location") is None)
    of_folder = list(files.failed)
    points = 0
    if len(records) and tracker is not None:
        _write_final(files, tracker, len(records))
        for name, write in tracker.others.items():
            files.attempt(name, write)
        points = _write_map(files, tracker)
    elif (folder / run_folder.MAP_NAME).is_file():
        with np.load(folder / run_folder.MAP_NAME, allow_pickle=False) as point_map:
            points = len(point_map["points"])
    if tracker is not None:
        files.attempt(PICTURES_NAME, tracker.pictures)
    findings = [Finding(**each) for each in run.get("checks", ())]
    verdict = "Nothing is known of the calibration: no frame was tracked."
    if calibration is not None and (len(records) or wrong(findings)):
        verdict = calibration_verdict(calibration, tracked, points, expected_offset(run["calibration"]), findings)
    summary = {**_summarise(frames, records, calibration, points), "calibration_verdict": verdict}
    if tracker is None:
        # Of a first attempt, if there was one.
        known = ("calibration_verdict", "calibration_errors")
        summary |= {name: value for name, value in run.get("summary", {}).items() if name in known}
    if len(records):
        summary |= describe_gravity(read_inertial_records(folder), records)
        if tracker is not None and tracker.judge_imu is not None:
            by_images = ~frame_table.predicted_poses(frames, records.timestamp)
            judged = tracker.judge_imu(records.timestamp, records.pose, by_images)
            summary["imu"] = [asdict(each) for each in judged]
    summary["world"] = _describe_world(summary, run)
    summary["failure"] = explain_failure(summary, run.get("map") is not None, started, findings)
    files.attempt(run_folder.RUN_NAME, lambda path: atomic_write_json(path, {**run, "summary": summary}))
    if len(frames):
        from sigmaslam.report.report import write_report  # not needed before the run has ended

        files.attempt(run_folder.REPORT_NAME, lambda path: write_report(path.parent))
    of_folder += [name for name in files.failed if name in (run_folder.RUN_NAME, run_folder.REPORT_NAME)]
    if not of_folder:
        for name in (PARTIAL_POSES, PARTIAL_RELATIVE_POSES):
            (folder / name).unlink(missing_ok=True)
    return summary, files.failed


def output_error(folder: Path, failed: list[str]) -> OutputError:
    """What to say where these files could not be written."""
    mend = f"`sigmaslam report {folder}`" if (folder / PARTIAL_POSES).is_file() else "track again"
    return OutputError(f"{folder}: could not write {', '.join(failed)}; make room on the disk, then {mend}")


class _Files:
    """Files of a folder that are written one by one; one that has `failed` costs a message and not the others."""

    def __init__(self, folder: Path) -> None:
        self.failed: list[str] = []
        self._folder = folder

    def attempt(self, name: str, write: Callable[[Path], object]) -> None:
        """Writes one."""
        try:
            write(self._folder / name)
        except (OSError, SigmaSlamError) as error:
            _LOGGER.error("%s is not written: %s", name, getattr(error, "strerror", None) or error)
            self.failed.append(name)
        except Exception:
            _LOGGER.exception("%s is not written", name)
            self.failed.append(name)


def _last_calibration(frames: frame_table.FrameTable) -> CalibrationEstimate | None:
    """What frames.csv says of it; other errors than the disparity offset are not on disk."""
    offset, sigma = (frames.columns[name] for name in ("disparity_offset", "disparity_offset_sigma"))
    said = np.flatnonzero(np.isfinite(offset))
    if not len(said):
        return None
    return CalibrationEstimate(float(offset[said[-1]]), float(sigma[said[-1]]))


def _write_poses(files: _Files, records: PoseRecords, frames: frame_table.FrameTable, has_matching: bool) -> None:
    if not len(records):
        return
    trajectory = Trajectory(records.timestamp, records.pose)
    files.attempt("trajectory.tum", lambda path: write_tum(path, trajectory))
    files.attempt("covariance.npy", lambda path: save_array(path, records.covariance))
    files.attempt(POSES_NAME, lambda path: write_pose_table(path, records, frames))
    files.attempt("trajectory.kitti", lambda path: write_kitti(path, trajectory, path.with_name("times.txt")))
    if has_matching:
        files.attempt("covariance_matching.npy", lambda path: save_array(path, records.matching))
    files.attempt(
        RELATIVE_POSES_NAME,
        lambda path: save_arrays(path, **collect_frame_pairs(path.parent, records.timestamp).arrays()),
    )


def _write_final(files: _Files, tracker: TrackerResults, count: int) -> None:
    """The first `count` frames with a pose after the fact; one more is known if the run was stopped in it."""
    final = tracker.final
    if final is None:
        return

    def write(path: Path) -> None:
        trajectory, covariances = final()
        write_tum(path, trajectory.subset(np.arange(count)))
        files.attempt(run_folder.FINAL_COVARIANCE, lambda path: save_array(path, covariances[:count]))

    files.attempt(run_folder.FINAL_TRAJECTORY, write)


def _write_map(files: _Files, tracker: TrackerResults) -> int:
    """Writes the map; returns how many points it has."""
    made: list[PointMap] = []

    def write(path: Path) -> None:
        point_map = tracker.point_map()
        made.append(point_map)
        arrays = {name: getattr(point_map, name) for name in PointMap.__slots__}
        save_arrays(path, **arrays, **tracker.keyframes())

    files.attempt(run_folder.MAP_NAME, write)
    if not made:
        return 0
    files.attempt("map.ply", lambda path: run_folder.write_map_points(path, made[0]))
    return len(made[0].points)


def _summarise(
    frames: frame_table.FrameTable, records: PoseRecords, calibration: CalibrationEstimate | None, points: int
) -> dict[str, Any]:
    """Counts for run.json."""
    columns, status = frames.columns, np.array(frames.status, str)
    intervals = np.diff(columns["timestamp"])
    inliers = columns["inliers"][columns["inliers"] > 0]
    first = int(np.abs(columns["timestamp"] - records.timestamp[0]).argmin()) if len(records) else None
    # Of tracked frames, that fewer than half of the matches agree with the pose; of skipped ones that could be read,
    # that one of their images is that of the frame before.
    contradicted = np.isin(status, frame_table.TRACKED) & (2.0 * columns["inliers"] < columns["matches"])
    repeated = (status == "skipped") & np.isfinite(columns["belief"])
    # A bump skips the frame before the one that names it.
    repeated[:-1] &= np.array([Doubt.RIG not in doubts for doubts in frames.doubts[1:]], bool)
    return {
        "frames": len(frames),
        **{each: frames.status.count(each) for each in frame_table.STATUSES},
        "tracked": frames.count(frame_table.TRACKED),
        "doubts": _count_doubts(frames),
        "poses": len(records),
        "first_frame_with_pose": first,
        "median_inliers": float(np.median(inliers)) if len(inliers) else 0.0,
        "map_points": points,
        "contradicted": int(contradicted.sum()),
        "stamp_noise": stamp_noise(intervals),
        "missing": missing_frames(intervals),
        "longest_interval": float(intervals.max(initial=0.0)),
        "repeated": int(repeated.sum()),
        "calibration_errors": {} if calibration is None else {k: list(v) for k, v in calibration.errors.items()},
    }


def _count_doubts(frames: frame_table.FrameTable) -> dict[str, dict[str, float]]:
    """By reason: in how many frames, and the time of the first, seconds since the first frame."""
    counts: dict[str, dict[str, float]] = {}
    for seconds, doubts in zip(frames.seconds.tolist(), frames.doubts, strict=True):
        for reason in doubts:
            counts.setdefault(reason, {"frames": 0, "first": seconds})["frames"] += 1
    return counts


def _describe_world(summary: dict[str, Any], run: dict[str, Any]) -> str | None:
    """Which world the poses are in; None where there is none, or it is the followed body."""
    first = summary["first_frame_with_pose"]
    if first is None or "object" in run:
        return None
    if run.get("map") is not None:
        return f"that of the map, in which the camera was found in frame {first} (from 0 on)"
    return f"the left camera of frame {first} (from 0 on), where tracking started"
