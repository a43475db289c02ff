"""The folder of a run: what is known of each frame is written there as it comes."""

import hashlib
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_json, check_new_folder, csv_text, printable, save_arrays, write_ply
from sigmaslam.frontend.build import own_networks
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.inference.networks import WeightsFolder, network_path
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.run_record.appended_file import AppendedFile, is_in_use
from sigmaslam.run_record.frame_table import COLUMNS, DOUBTS_SEPARATOR, FRAMES_NAME, KEYFRAME_COLUMNS
from sigmaslam.run_record.inertial_file import InertialWriter
from sigmaslam.run_record.pose_file import PARTIAL_POSES, pack_pose
from sigmaslam.run_record.relative_pose_file import PARTIAL_RELATIVE_POSES, pack_relative_poses
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.mapping import KeyframeTracks
from sigmaslam.slam.point_map import PointMap

FINAL_TRAJECTORY, FINAL_COVARIANCE = "trajectory_final.tum", "covariance_final.npy"
RUN_NAME = "run.json"
MAP_NAME, REPORT_NAME, VIDEO_NAME, RERUN_NAME = "map.npz", "report.html", "video.mp4", "rerun.rrd"
"""Of what may stand in the folder beside the results."""
UNFINISHED = "not yet"
"""What run.json has under `ended` while a run goes on, and after it was killed."""
STAGES = ("read", "rectify", "features", "match", "filter", "map")
_COLUMNS = (COLUMNS[0], "status", "doubts", *COLUMNS[1:], *KEYFRAME_COLUMNS, *(f"ms_{stage}" for stage in STAGES))
_GRAPHS = (
    *("features.onnx", "scorer.onnx", "verifier.onnx", "place_verifier.onnx"),
    *("pose_predict.onnx", "inertial_predict.onnx", "frame_predict.onnx", "frame_robust.onnx", "frame_gated.onnx"),
    *("window_eliminate.onnx", "window_gate.onnx", "window_condition.onnx"),
)


class RunWriter:
    """Writes to a run folder what is known of each frame, as it comes; `write_results` makes the results of it.

    Args:
        out: folder to make; it must not exist, or be empty.
        run: entries of run.json, which is written at once, so that a run that is killed says what it was.
        rectified: result of `StereoRectifier.describe`, to keep what `write_tracks` writes.
        poses: number of poses in the folder, of a run that goes on in it; None: it is a new one.

    Attributes:
        run: the entries, with versions and weights.
        calibration: what the last frame said of it; None before the first.
    Raises:
        InputError: the folder holds something, or cannot be made.
    """

    def __init__(
        self, out: Path, run: dict[str, Any], rectified: dict[str, Any] | None = None, poses: int | None = None
    ) -> None:
        goes_on = poses is not None
        if not goes_on:
            check_new_folder(out)
        versions = describe_versions("sigmaslam", "numpy", "opencv-python-headless", "onnxruntime")
        hashes = {name: _sha256(shipped_weights(name)) for name in _GRAPHS}
        hashes.update((run.get("weights") or {}).get("sha256", {}))
        self.run = {**run, **_describe_start(), "versions": versions, "weights_sha256": hashes}
        self.calibration: CalibrationEstimate | None = None
        try:
            out.mkdir(parents=True, exist_ok=True)
            atomic_write_json(out / RUN_NAME, {**self.run, "ended": UNFINISHED})
            self._poses = AppendedFile(out / PARTIAL_POSES, goes_on)
            self._relative_poses = AppendedFile(out / PARTIAL_RELATIVE_POSES, goes_on)
            self._table = AppendedFile(out / FRAMES_NAME, goes_on)
            self._inertial = InertialWriter(out, goes_on) if "imu" in run else None
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror}): choose another --out") from error
        if not goes_on:
            self._add_row(_COLUMNS)
        self._count = poses or 0
        self._rectified = rectified
        self._tracks: list[tuple[int, KeyframeTracks]] = []

    def add(
        self, estimate: Estimate, pose: np.ndarray, covariance: np.ndarray, matching: np.ndarray, read_ms: float
    ) -> None:
        """Takes the result of one frame; it is on disk when this returns.

        Args:
            pose, covariance: (4, 4), (6, 6) of what is tracked: the camera in the world, or a body in the camera.
            matching: (6, 6) the part of the covariance that comes from matches and motion.
            read_ms: time it took to read the images.
        Raises:
            OutputError: the disk is full.
        """
        self.calibration = estimate.calibration
        if estimate.has_pose:
            self._poses.append(pack_pose(estimate.timestamp, pose, covariance, matching))
            if self._inertial is not None and estimate.inertial is not None:
                self._inertial.add(estimate.timestamp, estimate.inertial)
            self._relative_poses.append(pack_relative_poses(self._count, estimate.relative_poses))
            if estimate.tracks is not None and self._rectified is not None:
                self._tracks.append((self._count, estimate.tracks))
            self._count += 1
            of_pose = [estimate.matches, estimate.inliers, f"{estimate.nis:.3f}", estimate.dof]
        else:
            of_pose = [""] * 4
        milliseconds = {"read": read_ms, **estimate.milliseconds}
        self._add_row(
            [
                f"{estimate.timestamp:.9f}",
                estimate.status,
                DOUBTS_SEPARATOR.join(estimate.doubts),
                *of_pose,
                f"{estimate.belief:.6f}",
                f"{estimate.calibration.disparity_offset:.5f}",
                f"{estimate.calibration.disparity_offset_sigma:.5f}",
                int(estimate.tracks is not None),
                "" if estimate.loop is None else f"{estimate.loop:.9f}",
                f"{estimate.calibration.raised:.5f}",
                *(f"{milliseconds[stage]:.2f}" for stage in STAGES),
            ]
        )

    def add_skipped(self, timestamp: float) -> None:
        """Notes a frame that could not be read."""
        self._add_row([f"{timestamp:.9f}", "skipped", *[""] * (len(_COLUMNS) - 2)])

    def close(self) -> None:
        """The last frame has come."""
        for file in (self._poses, self._relative_poses, self._table, self._inertial):
            if file is not None:
                file.close()

    @property
    def has_tracks(self) -> bool:
        """Whether there is something for `write_tracks`."""
        return bool(self._tracks)

    def write_tracks(self, path: Path) -> None:
        """Writes what keyframes saw, for `sigmaslam map refine`; there is something only if `has_tracks` says so."""
        assert self._rectified is not None
        assert self.calibration is not None
        seen = KeyframeTracks.concatenate([tracks for _, tracks in self._tracks])
        save_arrays(
            path,
            frame=np.concatenate([np.full(len(tracks), frame) for frame, tracks in self._tracks]),
            landmark=seen.landmark_id,
            measurement=seen.measurement,
            covariance=seen.covariance,
            disparity_offset=np.array([self.calibration.disparity_offset, self.calibration.disparity_offset_sigma]),
            **self._rectified,
        )

    def _add_row(self, fields: Sequence[Any]) -> None:
        self._table.append(csv_text([fields]).encode("utf-8"))


def check_has_trajectory(run: Path) -> None:
    """A run has poses to read.

    Raises:
        InputError: it has none; the message says why.
    """
    if (run / "trajectory.tum").is_file():
        return
    if (run / PARTIAL_POSES).is_file() and is_in_use(run / PARTIAL_POSES):
        reason = "it still goes on; wait for its end, or stop it"
    elif (run / PARTIAL_POSES).is_file():
        reason = f"it was stopped before its results were written; `sigmaslam report {run}` writes them"
    elif (run / FRAMES_NAME).is_file():
        reason = "none of its frames has a pose, so there is nothing to compare; its report.html says why"
    else:
        reason = "give a folder written by `sigmaslam track`"
    raise InputError(f"{run}: holds no trajectory.tum: {reason}")


def write_map_points(path: Path, point_map: PointMap) -> None:
    """Points as a binary PLY with x, y, z, their grey value in the images, and sigma.

    Sigma is the root of the largest eigenvalue of the covariance, metres. The grey value stands for red, green and
    blue, which viewers know; a map of points whose grey values are not known has none.
    """
    columns = {name: ("float", point_map.points[:, axis]) for axis, name in enumerate("xyz")}
    if np.isfinite(point_map.intensity).all():
        columns |= dict.fromkeys(("red", "green", "blue"), ("uchar", point_map.intensity))
    columns["sigma"] = ("float", np.sqrt(np.maximum(np.linalg.eigvalsh(point_map.covariances)[:, -1], 0.0)))
    write_ply(path, columns)


def describe_camera(camera: StereoCamera) -> dict[str, Any]:
    """The calibration for run.json."""
    covariance = camera.covariance
    return {
        "left": asdict(camera.left),
        "right": asdict(camera.right),
        "T_left_right": camera.T_left_right.tolist(),
        "baseline": camera.baseline,
        "sigmas": asdict(camera.sigmas),
        "covariance": covariance and {"names": list(covariance.names), "matrix": covariance.matrix.tolist()},
    }


def camera_of(path: Path, entries: dict[str, Any]) -> StereoCamera:
    """The calibration that run.json has; its measured covariance is not needed."""
    try:
        left, right = (CameraModel(**entries[eye]) for eye in ("left", "right"))
        sigmas = CalibrationSigmas(**entries["sigmas"])
        return StereoCamera(left, right, np.array(entries["T_left_right"], float), sigmas)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: calibration cannot be read ({error}): run `sigmaslam track` again") from error


def describe_weights(frontend: str, backend: str, weights: WeightsFolder) -> dict[str, Any] | None:
    """Folder of the user's networks, and SHA-256 of those that the front-end takes from it; None without a folder.

    Raises:
        InputError: as of `own_networks`.
    """
    paths = [network_path(name, weights, backend) for name in own_networks(frontend, weights, backend)]
    if weights is None:
        return None
    return {"folder": printable(os.fspath(weights)), "sha256": {path.name: _sha256(path) for path in paths}}


def _describe_start() -> dict[str, Any]:
    """The command, when it was given, and to what kind of machine."""
    program = Path(sys.argv[0]).name.replace("__main__.py", "sigmaslam")
    return {
        "command": printable(shlex.join([program, *sys.argv[1:]])),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": {"system": platform.platform(), "processor": _processor(), "cores": os.cpu_count()},
    }


def _processor() -> str:
    """The model where Linux tells it, else the architecture."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text(errors="replace").splitlines() if cpus.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def describe_versions(*packages: str) -> dict[str, str]:
    """Those of Python and of packages, for run.json."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
