"""`sigmaslam calibration`, and tracking with what it wrote."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers.trajectory_files import read_tum
from tests.support import calibration_forms as forms
from tests.support.commands import assert_refused, run_here

FRAMES = 8


def test_show_prints_baseline_models_and_fields_of_view(tmp_path: Path):
    rig = forms.raw_rig("radtan")
    result = run_here("calibrate", "show", forms.write_kalibr(rig, tmp_path))
    assert result.returncode == 0, result.stderr
    assert f"{1e3 * rig.baseline:.3f} mm" in result.stdout
    assert "672x376" in result.stdout
    assert "radtan (5)" in result.stdout
    assert "raw" in result.stdout
    result = run_here("calibrate", "show", forms.write_kitti(forms.rectified_rig(), tmp_path), "--size", "672x376")
    # 2 atan(w / 2f) of the known rig, to the pixel that the centre is off.
    assert f"{2 * np.degrees(np.arctan(336 / 358.6)):.0f}." in result.stdout
    assert "images    rectified" in result.stdout


@pytest.mark.parametrize("form", ["own", "Kalibr", "OpenCV", "ROS"])
def test_show_warns_of_lengths_in_millimetres_in_any_form(tmp_path: Path, form: str):
    rig = forms.raw_rig("radtan")
    T = rig.T_left_right.copy()
    T[:3, 3] *= 1e3
    result = run_here("calibrate", "show", forms.RAW_FORMS[form](replace(rig, T_left_right=T), tmp_path))
    assert result.returncode == 0, result.stderr
    assert "baseline 119.9 m is outside 0.003 to 3 m: is it in millimetres (0.12 m)" in " ".join(result.stderr.split())


@pytest.mark.parametrize("form", ["Kalibr", "OpenCV in two files", "ROS", "EuRoC", "ZED"])
def test_convert_writes_the_same_rig(tmp_path: Path, form: str):
    rig = forms.raw_rig("radtan")
    path, out = forms.RAW_FORMS[form](rig, tmp_path), tmp_path / "out.yaml"
    result = run_here("calibrate", "convert", path, out, "--size", "672x376")
    assert result.returncode == 0, result.stderr
    forms.assert_same_rig(StereoCamera.from_yaml(out), rig)


def test_bad_requests_are_refused(tmp_path: Path):
    path = forms.write_kitti(forms.rectified_rig(), tmp_path)
    assert_refused(run_here("calibrate", "show", path), "calib.txt", "give --size")
    assert_refused(run_here("calibrate", "show", path, "--size", "big"), "--size is 'big'", "752x480")
    out = tmp_path / "out.txt"
    assert_refused(run_here("calibrate", "convert", path, out, "--size", "672x376"), "out.txt", ".yaml")
    assert not out.exists()
    assert_refused(run_here("calibrate", "show", tmp_path / "none.yaml"), "none.yaml", "cannot read")


@pytest.mark.long
def test_tracking_with_a_converted_calibration_gives_the_same_trajectory(
    tmp_path: Path, demo_sequence: Path, without_report: None, monkeypatch
):
    folder = tmp_path / "sequence"
    for name in ("image_0", "image_1"):
        (folder / name).mkdir(parents=True)
        for image in sorted((demo_sequence / name).iterdir())[:FRAMES]:
            shutil.copy(image, folder / name)
    shutil.copy(demo_sequence / "calib.txt", folder)
    lines = (demo_sequence / "times.txt").read_text().splitlines(keepends=True)
    (folder / "times.txt").write_text("".join(lines[:FRAMES]))
    own = tmp_path / "own.yaml"
    result = run_here("calibrate", "convert", folder / "calib.txt", own, "--size", "320x240")
    assert result.returncode == 0, result.stderr
    rig = StereoCamera.from_yaml(own)
    monkeypatch.setattr(forms, "SIZE", (rig.left.width, rig.left.height))
    ros = forms.write_ros(rig, tmp_path)
    kalibr = forms.write_kalibr(rig, tmp_path)
    trajectories = []
    for k, calibration in enumerate((None, own, kalibr, ros)):
        given = () if calibration is None else ("--calibration", calibration)
        result = run_here("track", folder, "--out", tmp_path / f"run{k}", "--frontend", "klt", *given)
        assert result.returncode == 0, result.stderr
        trajectories.append(read_tum(tmp_path / f"run{k}" / "trajectory.tum"))
    first = trajectories[0]
    assert first.path_length > 0.05
    for trajectory in trajectories[1:]:
        np.testing.assert_array_equal(trajectory.timestamps, first.timestamps)
        np.testing.assert_allclose(trajectory.poses, first.poses, atol=1e-7)
