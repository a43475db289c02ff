"""`track --save-calibration`: the second run has nothing to correct."""

from __future__ import annotations

from pathlib import Path

import pytest

from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.run_record.frame_table import read_frames
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


def test_a_file_that_is_there_is_not_overwritten(demo_sequence: Path, tmp_path: Path):
    (tmp_path / "old.yaml").write_text("mine")
    result = run_here("track", demo_sequence, "--out", tmp_path / "run", "--save-calibration", tmp_path / "old.yaml")
    assert_refused(result, "old.yaml", "another name")
    assert (tmp_path / "old.yaml").read_text() == "mine"
