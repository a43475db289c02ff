"""Files of a run: rows of frames are written at once, the other files when the run ends, however it ends."""

from __future__ import annotations

import csv
import hashlib
import json
import platform
import tempfile
from array import array
from collections import Counter
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path, atomic_write_text, check_new_folder
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.readers.trajectory_files import write_kitti, write_tum
from sigmaslam.runs.frame_table import COLUMNS
from sigmaslam.runs.relative_pose_file import RelativePoseWriter
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.mapping import KeyframeTracks
from sigmaslam.slam.point_map import PointMap

FINAL_TRAJECTORY, FINAL_COVARIANCE = "trajectory_final.tum", "covariance_final.npy"
STAGES = ("read", "rectify", "features", "match", "filter", "map")
_COLUMNS = (COLUMNS[0], "status", *COLUMNS[1:], *(f"ms_{stage}" for stage in STAGES))
_GRAPHS = (
    "features.onnx",
    "scorer.onnx",
    "verifier.onnx",
    "place_verifier.onnx",
    "pose_predict.onnx",
    "frame_predict.onnx",
    "frame_robust.onnx",
    "frame_gated.onnx",
    "window_eliminate.onnx",
    "window_gate.onnx",
)


class RunWriter:
    """Writes a run folder.

    Args:
        out: folder to make; it must not exist, or be empty.
        rectified: result of `StereoTracker.describe_rectified`, to write tracks.npz as well.
    Raises:
        InputError: the folder holds something, or cannot be made.
    """

    def __init__(self, out: Path, rectified: dict[str, Any] | None = None) -> None:
        check_new_folder(out)
        try:
            out.mkdir(parents=True, exist_ok=True)
            self._table = (out / "frames.csv").open("w", newline="", encoding="utf-8")
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror}): choose another --out") from error
        self._out = out
        self._rows = csv.writer(self._table)
        self._rows.writerow(_COLUMNS)
        # Time stamp, pose and covariance of each frame go to disk, so that memory does not grow with the run.
        self._poses = tempfile.TemporaryFile()  # noqa: SIM115
        self._relative_poses = RelativePoseWriter()
        self._statuses: Counter[str] = Counter()
        self._inliers = array("i")  # positive counts alone
        self._calibration: CalibrationEstimate | None = None
        self._skipped = 0
        self._rectified = rectified
        self._tracks: list[tuple[int, KeyframeTracks]] = []

    def add(
        self, estimate: Estimate, pose: np.ndarray, covariance: np.ndarray, matching: np.ndarray, read_ms: float
    ) -> None:
        """Takes the result of one frame; its row is on disk when this returns.

        Args:
            estimate: of the camera.
            pose, covariance: (4, 4), (6, 6) of what is tracked: the camera in the world, or a body in the camera.
            matching: (6, 6) the part of the covariance that comes from matches and motion.
            read_ms: time it took to read the images.
        """
        milliseconds = {"read": read_ms, **estimate.milliseconds}
        self._rows.writerow(
            [
                f"{estimate.timestamp:.9f}",
                estimate.status,
                estimate.matches,
                estimate.inliers,
                f"{estimate.nis:.3f}",
                estimate.dof,
                f"{estimate.belief:.6f}",
                f"{estimate.calibration.disparity_offset:.5f}",
                f"{estimate.calibration.disparity_offset_sigma:.5f}",
                *(f"{milliseconds[stage]:.2f}" for stage in STAGES),
            ]
        )
        self._table.flush()
        row = np.r_[estimate.timestamp, pose.ravel(), covariance.ravel(), matching.ravel()]
        self._poses.write(row.astype(np.float64).tobytes())
        self._relative_poses.add(self._statuses.total(), estimate.relative_poses)
        self._statuses[estimate.status] += 1
        if estimate.inliers:
            self._inliers.append(estimate.inliers)
        self._calibration = estimate.calibration
        if estimate.tracks is not None and self._rectified is not None:
            self._tracks.append((self._statuses.total() - 1, estimate.tracks))

    def add_skipped(self, timestamp: float) -> None:
        """Notes a frame that could not be read."""
        self._rows.writerow([f"{timestamp:.9f}", "skipped", *[""] * (len(_COLUMNS) - 2)])
        self._table.flush()
        self._skipped += 1

    def finish(
        self,
        point_map: PointMap,
        keyframes: dict[str, Any],
        run: dict[str, Any],
        final: tuple[Trajectory, np.ndarray] | None = None,
    ) -> dict[str, Any]:
        """Writes trajectory, covariance, relative poses, map, run.json and report.html.

        Args:
            point_map: the landmarks.
            keyframes: arrays by name, with which a later run relocalises in the map.
            run: entries of run.json beside versions, weights and the summary.
            final: the frames as they are known now, with covariances; they are written beside those said at once. None
                where other sensors corrected the poses, whose covariances then have no part of matches alone.
        Returns:
            The summary.
        """
        self._table.close()
        summary = self._summary(point_map)
        content = {**run, "versions": _versions(), "weights_sha256": _weight_hashes(), "summary": summary}
        atomic_write_text(self._out / "run.json", json.dumps(content, indent=2) + "\n")
        self._poses.seek(0)
        rows = np.frombuffer(self._poses.read()).reshape(-1, 1 + 16 + 36 + 36)
        self._poses.close()
        if not len(rows):
            return summary
        trajectory = Trajectory(rows[:, 0], rows[:, 1:17].reshape(-1, 4, 4))
        write_tum(self._out / "trajectory.tum", trajectory)
        write_kitti(self._out / "trajectory.kitti", trajectory, self._out / "times.txt")
        _save(self._out / "covariance.npy", rows[:, 17:53].reshape(-1, 6, 6))
        self._relative_poses.finish(self._out, trajectory.timestamps)
        if final is not None:
            # A frame whose pose was not written, as the run was stopped in it, is in neither trajectory.
            write_tum(self._out / FINAL_TRAJECTORY, final[0].subset(np.arange(len(rows))))
            _save(self._out / FINAL_COVARIANCE, final[1][: len(rows)])
            _save(self._out / "covariance_matching.npy", rows[:, 53:].reshape(-1, 6, 6))
        with atomic_path(self._out / "map.npz") as path:
            points = {name: getattr(point_map, name) for name in PointMap.__slots__}
            np.savez_compressed(path, **points, **keyframes)
        write_ply(self._out / "map.ply", point_map)
        self._write_tracks()
        from sigmaslam.runs.report import write_report  # draws: not needed before the run has ended

        write_report(self._out)
        return summary

    def _write_tracks(self) -> None:
        calibration = self._calibration
        if self._rectified is None or not self._tracks or calibration is None:
            return
        seen = KeyframeTracks.concatenate([tracks for _, tracks in self._tracks])
        with atomic_path(self._out / "tracks.npz") as path:
            np.savez_compressed(
                path,
                frame=np.concatenate([np.full(len(tracks), frame) for frame, tracks in self._tracks]),
                landmark=seen.landmark_id,
                measurement=seen.measurement,
                covariance=seen.covariance,
                disparity_offset=np.array([calibration.disparity_offset, calibration.disparity_offset_sigma]),
                **self._rectified,
            )

    def _summary(self, point_map: PointMap) -> dict[str, Any]:
        last = self._calibration
        return {
            "frames": self._statuses.total() + self._skipped,
            "skipped": self._skipped,
            **{status: self._statuses[status] for status in ("starting", "tracking", "relocalised", "lost")},
            "median_inliers": float(np.median(self._inliers)) if self._inliers else 0.0,
            "map_points": len(point_map.points),
            "calibration_verdict": calibration_verdict(last) if last else "No frame was read.",
            "calibration_errors": {name: list(each) for name, each in last.errors.items()} if last else {},
        }


def calibration_verdict(calibration: CalibrationEstimate) -> str:
    """The estimated disparity offset in words."""
    offset, sigma = calibration.disparity_offset, calibration.disparity_offset_sigma
    figure = f"{offset:+.2f} ± {sigma:.2f} px"
    if calibration.refused_offset:
        return (
            f"The images ask for a disparity offset of {calibration.refused_offset:+.1f} px, which is more than "
            "calibrations are off by: nothing was corrected. A lens, the baseline or the right camera is wrong: "
            "calibrate again."
        )
    if sigma > 0.2:
        return (
            f"It is too early to say whether the rectification is right (disparity offset {figure}): more frames, or "
            "things nearer and farther, would tell."
        )
    if abs(offset) > max(3.0 * sigma, 0.1):
        return (
            f"The rectification is off by {figure} of disparity. The poses are corrected for it; depth measured with "
            "this calibration elsewhere is not: calibrate again."
        )
    return f"The disparity offset is {figure}: nothing wrong with the rectification can be seen."


def _save(path: Path, array: np.ndarray) -> None:
    with atomic_path(path) as temporary:
        np.save(temporary, array)


def write_ply(path: Path, point_map: PointMap) -> None:
    """Points as a binary PLY with x, y, z and sigma, the root of the largest eigenvalue of the covariance, metres."""
    sigma = np.sqrt(np.maximum(np.linalg.eigvalsh(point_map.covariances)[:, -1], 0.0))
    vertices = np.column_stack([point_map.points, sigma]).astype("<f4")
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "sigma"))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{names}end_header\n"
    with atomic_path(path) as temporary:
        temporary.write_bytes(header.encode("ascii") + vertices.tobytes())


def describe_camera(camera: StereoCamera) -> dict[str, Any]:
    """The calibration for run.json."""
    return {
        "left": asdict(camera.left),
        "right": asdict(camera.right),
        "T_left_right": camera.T_left_right.tolist(),
        "baseline": camera.baseline,
        "sigmas": asdict(camera.sigmas),
    }


def _versions() -> dict[str, str]:
    names = ("sigmaslam", "numpy", "opencv-python-headless", "onnxruntime")
    return {"python": platform.python_version(), **{name: version(name) for name in names}}


def _weight_hashes() -> dict[str, str]:
    return {name: hashlib.sha256(shipped_weights(name).read_bytes()).hexdigest() for name in _GRAPHS}
