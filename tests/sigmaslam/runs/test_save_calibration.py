"""`track --save-calibration`: the second run has nothing to correct."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.readers import open_sequence
from sigmaslam.run_record.frame_table import read_frames
from sigmaslam.runs.request import OutputOptions
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.commands import assert_refused, run_here


@pytest.mark.long
def test_a_second_run_begins_with_what_the_first_one_learned(demo_sequence: Path, tmp_path: Path):
    learned = tmp_path / "learned.yaml"
    command = ("track", demo_sequence, "--frames", "20", "--threads", "1")
    assert run_here(*command, "--out", tmp_path / "first", "--save-calibration", learned).returncode == 0
    camera = StereoCamera.from_yaml(learned)
    assert camera.covariance is not None
    assert camera.covariance.names == ("offset",)
    assert run_here(*command, "--out", tmp_path / "second", "--calibration", learned).returncode == 0
    first, second = (read_frames(tmp_path / name / "frames.csv").columns for name in ("first", "second"))
    known = first["disparity_offset_sigma"][-1]
    assert known < 0.3
    assert second["disparity_offset_sigma"][0] == pytest.approx(known, rel=0.02)
    assert abs(second["disparity_offset"][-1]) < known


@pytest.mark.slow
def test_the_jump_of_a_loop_is_no_wrong_calibration(real_data: Path, tmp_path: Path):
    """It was corrected as a yaw of 0.27 degrees, four frames after the first loop: 0.18 m.

    The lens of both eyes is, before any loop; MH01, of the same rig, says 0.0024 ± 0.0005.
    """
    folder, learned = real_data / "euroc_v1_01_keyframes_a", tmp_path / "learned.yaml"
    run_here("track", folder, "--imu", "off", "--out", tmp_path / "run", "--save-calibration", learned)
    after, before = StereoCamera.from_yaml(learned), open_sequence(folder).camera
    assert after.covariance is not None
    assert after.covariance.names == ("lens", "offset")
    assert 0.001 < after.left.distortion[0] - before.left.distortion[0] < 0.004
    np.testing.assert_array_equal(after.T_left_right, before.T_left_right)
    assert evaluate_run(tmp_path / "run", folder / "groundtruth.csv", plot=False).ate.rmse < 0.06


def test_a_file_that_is_there_is_not_overwritten(demo_sequence: Path, tmp_path: Path):
    (tmp_path / "old.yaml").write_text("mine")
    result = run_here("track", demo_sequence, "--out", tmp_path / "run", "--save-calibration", tmp_path / "old.yaml")
    assert_refused(result, "old.yaml", "another name")
    assert (tmp_path / "old.yaml").read_text() == "mine"
    OutputOptions(tmp_path / "run", save_calibration=tmp_path / "run" / "new.yaml")  # a folder that the run makes
    for name in ("new.txt", "nowhere/new.yaml"):
        command = "track", demo_sequence, "--out", tmp_path / "run", "--save-calibration", tmp_path / name
        assert_refused(run_here(*command), name, "ends in .yaml, in a folder that is there")
