"""A run with an inertial sensor says where up is, and shows it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.readers.trajectory_files import read_tum
from sigmaslam.run_record.inertial_file import INERTIAL_NAME, read_inertial_records
from tests.support.commands import run_here


@pytest.mark.slow
def test_roll_pitch_and_stretches_in_the_dark_of_a_real_recording(real_data: Path, tmp_path: Path):
    """Ten frames are black; the truth is some 0.3 degrees off itself."""
    source, folder, run = real_data / "euroc_mh01_f000_099", tmp_path / "recording", tmp_path / "run"
    for path in source.rglob("*"):
        if path.is_file():
            target = folder / path.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.symlink_to(path)
    rng = np.random.default_rng(7)
    for eye in ("cam0", "cam1"):
        for path in sorted((folder / "mav0" / eye / "data").glob("*.png"))[50:60]:
            path.unlink()
            cv2.imwrite(str(path), np.clip(rng.normal(3, 1.5, (480, 752)), 0, 255).astype(np.uint8))
    result = run_here("track", folder, "--out", run)
    assert result.returncode == 0, result.stderr
    assert "T_gravity in run.json" in result.stdout
    assert "Inertial sensor: " in result.stdout
    records = read_inertial_records(run)
    truth = read_tum(source / "groundtruth.tum")
    rows = np.searchsorted(truth.timestamps, records.timestamp - 1e-4)
    up = truth.poses[rows, 2, :3]
    true = np.column_stack([np.arctan2(-up[:, 0], -up[:, 1]), np.arcsin(up[:, 2])])
    z = (records.level[:, :2] - true) / np.hypot(records.level[:, 2:], np.radians(0.3))
    assert np.all(np.abs(z) < 3.0)
    assert np.all(records.tilt_sigma < np.radians(3.0))
    entries = json.loads((run / "run.json").read_text())["summary"]
    T, first = np.array(entries["gravity"]["T_gravity"]), read_tum(run / "trajectory.tum").timestamps[0]
    start = truth.poses[np.searchsorted(truth.timestamps, first - 1e-4)]
    assert np.arccos(T[2, :3] @ start[2, :3]) < 3.0 * entries["gravity"]["sigma"]
    report = (run / "report.html").read_text()
    for words in ("<h2>Inertial sensor</h2>", "10 frames from 2.50 s", "Roll and pitch", "Gyro bias", INERTIAL_NAME):
        assert words in report
