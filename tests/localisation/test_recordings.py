"""Recordings as others write them: conventions by known residuals, and what is said of files that are wrong."""

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sigmaslam.errors import InputError
from sigmaslam_localisation.csv_folder import read_csv_folder
from sigmaslam_localisation.formats import detect_format, read_recordings
from sigmaslam_localisation.mrclam import read_mrclam
from sigmaslam_localisation.starry import read_starry
from sigmaslam_localisation.stereo_points import StereoBody
from sigmaslam_localisation.tubes import read_tubes
from sigmaslam_localisation.wheeled_robot import CONSTANTS, WheeledRobot
from tests.support.wheeled_world import World, drive, write_csv_folder


def residuals(recording):
    """Of what was seen at the true poses: (S, 2)."""
    poses = recording.truth.at(recording.seconds)
    usable = np.isfinite(poses).all(axis=1)
    state = torch.nn.functional.pad(torch.from_numpy(poses[usable]), (0, len(CONSTANTS)))
    model = WheeledRobot.of(recording).measurement()
    seen = model.function(state, torch.from_numpy(recording.landmarks[recording.landmark[usable]]))
    difference = torch.from_numpy(recording.sightings[usable]) - seen
    return difference.numpy() if model.residual is None else model.residual(seen + difference, seen).numpy()


def test_the_laser_of_the_tubes_sees_what_the_truth_says(real_data):
    """Known figures of the data set: 0.033 m and 0.0255 rad."""
    found = residuals(read_tubes(real_data / "lost_in_the_woods" / "dataset2_steps00000-08405.mat"))
    np.testing.assert_allclose(found.std(axis=0), [0.033, 0.0255], atol=0.0015)


@pytest.mark.long
def test_the_cameras_of_mrclam_see_what_the_truth_says(real_data):
    """Known figures: range 0.12 to 0.21 m, bearing in the middle 0.006 to 0.011 rad, an offset of robot 4."""
    folder = real_data / "mrclam" / "MRCLAM_Dataset6"
    for robot in range(1, 6):
        found = residuals(read_mrclam(folder, robot))
        assert 0.11 < found[:, 0].std() < 0.22
        offset = np.median(found[:, 1])
        assert 0.005 < 1.4826 * np.median(np.abs(found[:, 1] - offset)) < 0.0115
        assert (offset < -0.01) == (robot == 4)


def test_the_stereo_camera_sees_what_the_truth_says(real_data):
    """The file's y_var, over all 1900 steps; of those that are here the rows are 1.3 pixels worse."""
    recording = read_starry(real_data / "starry_night" / "dataset3.mat")
    state, steps = torch.nn.functional.pad(torch.from_numpy(recording.truth[1:, None]), (0, 10)), recording.steps([0.0])
    seen = StereoBody(recording.rig).measurement().function(state, torch.from_numpy(steps.position[:, 0]))
    difference = steps.value[:, 0] - seen.numpy()
    deviation = np.nanstd(difference, axis=(0, 1))
    np.testing.assert_allclose(deviation, [6.16, 11.4, 6.48, 11.5], atol=1.5)


@pytest.mark.parametrize("kind", ["range-bearing", "cartesian"])
def test_a_csv_folder_comes_back(tmp_path, kind):
    written = drive(World(seconds=3.0, kind=kind))
    folder = write_csv_folder(tmp_path / "robot", written)
    assert detect_format(folder) == "csv"
    found = read_recordings(folder, "csv", None)[0]
    for name in ("control_seconds", "controls", "seconds", "landmark", "sightings", "landmarks"):
        np.testing.assert_allclose(getattr(found, name), getattr(written, name), rtol=1e-8, atol=1e-9)
    assert found.kind == kind


def test_rows_of_the_truth_may_come_in_any_order(tmp_path):
    folder = write_csv_folder(tmp_path / "robot", drive(World(seconds=3.0)))
    before = read_recordings(folder, "csv", None)[0].truth
    head, *rows = (folder / "truth.csv").read_text().splitlines()
    (folder / "truth.csv").write_text("\n".join([head, *rows[len(rows) // 2 :], *rows[: len(rows) // 2]]))
    after = read_recordings(folder, "csv", None)[0].truth
    np.testing.assert_array_equal(after.seconds, before.seconds)
    np.testing.assert_array_equal(after.poses, before.poses)


def test_without_noise_a_recording_has_no_residuals(tmp_path):
    quiet = drive(World(seconds=3.0))
    for kind in ("range-bearing", "cartesian"):
        recording = replace(quiet, kind=kind)
        state = torch.nn.functional.pad(torch.from_numpy(recording.truth.at(recording.seconds)), (0, len(CONSTANTS)))
        landmark = torch.from_numpy(recording.landmarks[recording.landmark])
        exact = WheeledRobot.of(recording).measurement().function(state, landmark).numpy()
        assert np.abs(residuals(replace(recording, sightings=exact))).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("landmarks.csv", "id,x,y\n1,0,0\n", "landmark,x,y"),
        ("landmarks.csv", "\ufefflandmark,x,y\n1,0,0\n1,5,5\n", "a landmark stands twice"),
        ("sightings.csv", "time,landmark,range,bearing\n0.1,1,-1,0\n", "a range is not positive"),
        ("sightings.csv", "time,landmark,range,bearing\n0.1,99,1,0\n", "landmark 99 is not in landmarks.csv"),
        ("controls.csv", "time,speed,turn_rate\n0,one,0\n", "line 2"),
        ("controls.csv", "time,speed,turn_rate\n0,1,0\n1,nan,0\n", "line 3 .* not finite"),
        (
            "sightings.csv",
            "time,landmark,range,bearing\n0.1,1,1,57.3\n",
            "a bearing is 57.3, beyond a turn: give rad",
        ),
        ("sightings.csv", "time,landmark,range,bearing\n1.7e9,1,1,0\n", "1.7e.09 s off the controls: give one clock"),
        ("controls.csv", "time,speed,turn_rate\n0,0,0\n3000000,0,0\n", "s off the controls: give one clock"),
        ("sightings.csv", "time,landmark,a,b\n", "ahead,left"),
        ("controls.csv", "time,speed,turn_rate\n", "has no rows"),
    ],
)
def test_a_wrong_csv_file_is_named(tmp_path, name, text, words):
    folder = write_csv_folder(tmp_path, drive(World(seconds=3.0)))
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_csv_folder(folder)
    assert name in str(caught.value) or "one clock" in words


def write_mrclam(folder: Path) -> Path:
    """Two landmarks, one other robot, and a barcode that was misread."""
    files = {
        "Barcodes.dat": "# subject barcode\n1 5\n2 14\n6 63\n7 25\n",
        "Landmark_Groundtruth.dat": "6 1.0 2.0 0 0\n7 3.0 4.0 0 0\n",
        "Robot1_Odometry.dat": "0.0 0.1 0.0\n1.0 0.1 0.2\n1.0 0.1 0.3\n",
        "Robot1_Measurement.dat": "0.5 25 1.5 0.1\n0.5 14 9.0 0.0\n0.6 90 9.0 0.0\n0.7 63 2.5 -0.1\n",
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    with gzip.open(folder / "Robot1_Groundtruth.dat.gz", "wt") as file:
        file.write("0.0 0 0 3.1\n0.1 0 0 -3.1\n")
    return folder


def test_of_mrclam_other_robots_and_misread_barcodes_are_left_out(tmp_path):
    recording = read_recordings(write_mrclam(tmp_path), "mrclam", 1)[0]
    assert recording.landmark.tolist() == [1, 0]
    assert recording.sightings[:, 0].tolist() == [1.5, 2.5]
    assert recording.controls[:, 1].tolist() == [0.0, 0.3]
    assert abs(np.diff(recording.truth.poses[:, 2])[0]) < 0.1


def test_a_robot_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(InputError, match="has no robot 2: choose --robot 1"):
        read_recordings(write_mrclam(tmp_path), "mrclam", 2)
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match=r"none: has no Robot1_Measurement\.dat"):
        read_recordings(tmp_path / "none", "mrclam", None)


def test_what_is_no_recording_is_refused(tmp_path):
    with pytest.raises(InputError, match="is no recording that is known"):
        detect_format(tmp_path)
    (tmp_path / "wrong.mat").write_bytes(b"nothing")
    with pytest.raises(InputError, match="is no MATLAB file"):
        detect_format(tmp_path / "wrong.mat")
