"""Folders that our readers and other people's tools read: KITTI odometry and EuRoC's ASL format."""

import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from sigmaslam.calibration_files.foreign_calibrations import write_foreign_calibration
from sigmaslam.files import atomic_path, atomic_write_text, csv_text
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers.trajectory_files import write_kitti
from sigmaslam_synthetic.inertial import SimulatedInertial
from sigmaslam_synthetic.simulation import Simulation

_FIRST_STAMP = 1_600_000_000_000_000_000  # nanoseconds; EuRoC's stamps count from 1970


def image_paths(out: Path, simulation: Simulation, frame: int) -> tuple[Path, Path]:
    """Where the left and the right image of a frame go."""
    if simulation.layout == "kitti":
        return out / "image_0" / f"{frame:06d}.png", out / "image_1" / f"{frame:06d}.png"
    name = f"{_stamp(simulation, frame)}.png"
    return out / "mav0" / "cam0" / "data" / name, out / "mav0" / "cam1" / "data" / name


def write_layout(out: Path, simulation: Simulation) -> None:
    """Folders, calibration, times and the true poses of all frames."""
    for path in image_paths(out, simulation, 0):
        path.parent.mkdir(parents=True, exist_ok=True)
    poses = simulation.path.poses(simulation.times)
    if simulation.layout == "kitti":
        _write_kitti(out, simulation, poses)
    else:
        _write_euroc(out / "mav0", simulation, poses)


def write_inertial(out: Path, simulation: Simulation, inertial: SimulatedInertial) -> None:
    """The sensor's table with its YAML, and its truth, where `find_imu` looks.

    KITTI knows no such sensor: its table is in seconds, with a YAML of its own name.
    """
    is_kitti = simulation.layout == "kitti"
    folder = (out if is_kitti else out / "mav0") / "imu0"
    folder.mkdir(exist_ok=True)
    samples = inertial.samples
    stamps = [f"{t:.9f}" if is_kitti else _FIRST_STAMP + round(1e9 * t) for t in samples.timestamp]
    rows = np.concatenate([samples.gyro, samples.accel], axis=1)
    names = [f"{name}_{axis} [{unit}]" for name, unit in (("w", "rad s^-1"), ("a", "m s^-2")) for axis in "xyz"]
    text = [[stamp, *(f"{value:.9f}" for value in row)] for stamp, row in zip(stamps, rows, strict=True)]
    header = [f"#timestamp [{'s' if is_kitti else 'ns'}]", *names]
    atomic_write_text(folder / "data.csv", csv_text([header, *text]))
    atomic_write_text(folder / ("data.yaml" if is_kitti else "sensor.yaml"), _inertial_yaml(inertial))
    start = 0.0 if is_kitti else _FIRST_STAMP / 1e9
    save_arrays(folder / "truth.npz", {**asdict(inertial.truth), "timestamp": start + inertial.truth.timestamp})


def _inertial_yaml(inertial: SimulatedInertial) -> str:
    sensor = inertial.sensor
    content = {
        "sensor_type": "imu",
        "comment": "rendered",
        "T_BS": {"cols": 4, "rows": 4, "data": sensor.T_left_imu.ravel().tolist()},
        "T_cam_imu": sensor.T_left_imu.tolist(),
        "timeshift_cam_imu": sensor.time_shift,
        "rate_hz": round(1.0 / float(np.median(np.diff(inertial.samples.timestamp))), 6),
        "gyroscope_noise_density": sensor.gyro_density,
        "gyroscope_random_walk": sensor.gyro_walk,
        "accelerometer_noise_density": sensor.accel_density,
        "accelerometer_random_walk": sensor.accel_walk,
    }
    return yaml.safe_dump(content, sort_keys=False)


def _write_kitti(out: Path, simulation: Simulation, poses: np.ndarray) -> None:
    write_foreign_calibration(out / "calib.txt", simulation.rig.calibrated, "kitti")
    atomic_write_text(out / "times.txt", "".join(f"{t:.6e}\n" for t in simulation.times))
    relative = np.linalg.inv(poses[0]) @ poses
    relative[0] = np.eye(4)
    write_kitti(out / "poses.txt", Trajectory(simulation.times, relative))
    if simulation.scene.moving.any() and np.ptp(poses, axis=0).max() == 0.0:
        # The camera is at rest, and what moves is to be followed: the first of what moves, T_camera_object.
        body = simulation.scene.bodies[int(np.flatnonzero(simulation.scene.moving)[0])]
        moved = np.stack([np.linalg.inv(poses[0]) @ body.pose(time) for time in simulation.times])
        write_kitti(out / "poses_object.txt", Trajectory(simulation.times, moved))


def _write_euroc(root: Path, simulation: Simulation, poses: np.ndarray) -> None:
    """The body of the ASL format is the left camera."""
    stamps = [_stamp(simulation, k) for k in range(simulation.frames)]
    write_foreign_calibration(root, simulation.rig.calibrated, "euroc")
    rows = [[stamp, f"{stamp}.png"] for stamp in stamps]
    for name in ("cam0", "cam1"):
        atomic_write_text(root / name / "data.csv", csv_text([["#timestamp [ns]", "filename"], *rows]))
    truth = root / "state_groundtruth_estimate0"
    truth.mkdir(exist_ok=True)
    orientation = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    header = ["#timestamp", *(f"p_RS_R_{axis} [m]" for axis in "xyz"), *(f"q_RS_{part} []" for part in "wxyz")]
    rows = [
        [stamp, *(f"{value:.12f}" for value in (*T[:3, 3], *q))]
        for stamp, T, q in zip(stamps, poses, orientation, strict=True)
    ]
    atomic_write_text(truth / "data.csv", csv_text([header, *rows]))


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """A .npz like numpy's compressed ones, at the fastest level: numpy's own takes as long as the rendering."""
    with (
        atomic_path(path) as temporary,
        zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        for name, array in arrays.items():
            info = zipfile.ZipInfo(f"{name}.npy")  # with a fixed date: the same arrays are the same bytes
            info.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array, order="C"), allow_pickle=False)


def _stamp(simulation: Simulation, frame: int) -> int:
    return _FIRST_STAMP + round(1e9 * frame / simulation.fps)
