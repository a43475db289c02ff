"""Files of location sensors, and their fusion with a tracker that drifts as it says."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.fusion.location_filter import LocationFilter
from sigmaslam.fusion.readings import Locations, read_locations
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.se3 import matrix_to_quaternion, se3_exp, se3_inverse, se3_log
from sigmaslam.readers.trajectory_files import read_kitti, read_tum
from sigmaslam.slam.tracker import Estimate, StereoTracker
from sigmaslam_evaluation.run_evaluation import evaluate_run
from tests.support.estimates import Demo
from tests.support.estimates import track as track_demo
from tests.support.quantiles import WITHIN_3_SIGMA, squared_sigmas
from tests.support.simulated_location import FRAME, Drive, drifting_estimates, estimate_of, sense

MOUNT = se3_exp(np.array([0.1, 0.05, -0.1, 0.3, -0.2, 0.9]))
SIGMA = np.repeat([3e-3, 1e-3], 3)  # of the tracker's drift, a frame


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_every_form_of_covariance_is_read(tmp_path: Path):
    sphere = read_locations(write(tmp_path / "a.csv", "timestamp,x,y,z,sigma_position\n1.5,1,2,3,0.5\n2,1,2,4,0.1\n"))
    assert sphere.rotations is None
    np.testing.assert_allclose(sphere.timestamps, [1.5, 2])
    np.testing.assert_allclose(sphere.covariances[0], 0.25 * np.eye(3))
    axes = read_locations(write(tmp_path / "b.csv", "z,y,x,timestamp,sigma_x,sigma_y,sigma_z\n3,2,1,0,1,2,3\n"))
    np.testing.assert_allclose(axes.positions, [[1, 2, 3]])
    np.testing.assert_allclose(axes.covariances[0], np.diag([1, 4, 9]))
    names = "timestamp,x,y,z,cxx,cxy,cxz,cyy,cyz,czz,note"
    whole = read_locations(write(tmp_path / "c.csv", f"# {names}\n0,1,2,3,4,1,0.5,5,0.2,6,fine\n"))
    np.testing.assert_allclose(whole.covariances[0], [[4, 1, 0.5], [1, 5, 0.2], [0.5, 0.2, 6]])
    names = "timestamp,x,y,z,qx,qy,qz,qw,sigma_position,sigma_rotation"
    pose = read_locations(write(tmp_path / "d.csv", f"{names}\n0,1,2,3,0,0,1,0,0.1,0.2\n"))
    assert pose.rotations is not None
    np.testing.assert_allclose(pose.rotations[0], np.diag([-1, -1, 1]), atol=1e-12)
    np.testing.assert_allclose(np.diag(pose.covariances[0]), [0.01] * 3 + [0.04] * 3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no readings"),
        ("timestamp,x,y,z,sigma_position\n", "holds no readings"),
        ("timestamp,x,y,sigma_position\n1,2,3,4\n", "line 1: column z is missing"),
        ("timestamp,x,y,z\n1,2,3,4\n", "line 1: the covariance of the position must be given once"),
        ("timestamp,x,y,z,sigma_x,sigma_y\n1,2,3,4,5,6\n", "column sigma_z is missing"),
        ("timestamp,x,y,z,qx,qy,qz,qw,sigma_position\n1,2,3,4,0,0,0,1,1\n", "column sigma_rotation is missing"),
        ("timestamp,x,y,z,sigma_position\n1,2,three,4,5\n", "line 2: y is 'three', no number"),
        ("timestamp,x,y,z,sigma_position\n1,2,nan,4,5\n", "line 2: y is 'nan', no number"),
        ("timestamp,x,y,z,sigma_position\n1,2,3,4\n", "line 2: 4 values for 5 columns"),
        ("timestamp,x,y,z,sigma_position\n1,2,3,4,0\n", "line 2: sigma_position is 0"),
        ("timestamp,x,y,z,sigma_position\n1,2,3,4,1\n\n1,2,3,4,1\n", "line 4: timestamp 1.0 does not come after 1.0"),
        ("timestamp,x,y,z,cxx,cxy,cxz,cyy,cyz,czz\n1,2,3,4,1,2,0,1,0,1\n", "line 2: cxx, cxy, .* are no covariance"),
        (
            "timestamp,x,y,z,qx,qy,qz,qw,sigma_position,sigma_rotation\n1,2,3,4,0,0,0,0.5,1,1\n",
            "line 2: the quaternion qx, qy, qz, qw has length 0.5",
        ),
    ],
)
def test_a_wrong_file_is_refused_with_file_line_and_value(tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError, match=f"location.csv.*{words}"):
        read_locations(write(tmp_path / "location.csv", text))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "timestamp;x;y;z;sigma_position\n0;0,5;0;0;0,1\n",
            "line 1: the columns are separated by semicolons: separate",
        ),
        ("timestamp\tx\ty\tz\tsigma_position\n0\t0\t0\t0\t1\n", "line 1: the columns are separated by tabs"),
        ("timestamp,x,x,y,z,sigma_position\n0,0,0,0,0,1\n", "line 1: column x stands twice"),
        ("timestamp,x,y,z,sigma_position\n0,0,0,0,1\n100000000,0,0,0,1\n", "look like nanoseconds: write seconds"),
    ],
)
def test_other_separators_and_units_are_named(tmp_path: Path, text: str, words: str):
    with pytest.raises(InputError) as caught:
        read_locations(write(tmp_path / "readings.csv", text))
    for word in ("readings.csv", words):
        assert word in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        read_locations(tmp_path / "nowhere.csv")


def errors_of(truth: np.ndarray, estimates: list[Estimate]) -> np.ndarray:
    return se3_log(se3_inverse(truth) @ np.array([e.T_world_camera for e in estimates]))


def nees_of(truth: np.ndarray, estimates: list[Estimate]) -> float:
    covariances = np.array([e.covariance for e in estimates[1:]])
    return float(np.mean(squared_sigmas(errors_of(truth, estimates)[1:], covariances))) / 6


def rms(errors: np.ndarray, part: slice) -> float:
    return float(np.sqrt(np.mean(np.sum(errors[:, part] ** 2, axis=1))))


@pytest.mark.long
@pytest.mark.parametrize(
    ("turn", "on_object"), [(None, False), (0.01, True)], ids=["positions of the camera", "poses of the body"]
)
def test_drift_is_less_and_the_covariance_is_right(turn: float | None, on_object: bool):
    """10 Hz, times between the frames', a world and a mount that nobody knows; poses at 20 Hz."""
    nees, before, after = [], [], []
    for seed in (3, 4, 5):
        drive, frames = Drive(seed), 260
        estimates = drifting_estimates(drive, frames, SIGMA, seed)
        times = np.arange(0.013, frames * FRAME, 0.1)
        poses = drive.pose(times)
        readings = sense(se3_inverse(poses) if on_object else poses, times, seed, 0.02, turn, MOUNT)
        location = LocationFilter(readings, on_object)
        fused = [location.fuse(estimate) for estimate in estimates]
        truth = drive.pose(FRAME * np.arange(frames))
        assert location.summary.ready is not None
        assert location.summary.used == len(times)
        nees.append(nees_of(truth, fused))
        before.append(rms(errors_of(truth, estimates)[100:], slice(0, 3)))
        after.append(rms(errors_of(truth, fused)[100:], slice(0, 3)))
    assert np.mean(after) < 0.75 * np.mean(before)
    assert 0.5 < np.mean(nees) < 2.0


@pytest.mark.long
def test_a_wrong_scale_is_no_random_walk():
    """Of 1 %, which each pose has alike; as drift, of which the covariance grows no more, the NEES is 3.6."""
    nees = []
    for seed in range(8):
        drive, frames = Drive(seed), 260
        scale = 0.01 * np.random.default_rng(seed).standard_normal()
        estimates = []
        for each in drifting_estimates(drive, frames, SIGMA / 10.0, seed):
            pose, by_calibration = each.T_world_camera.copy(), np.zeros((6, 15))
            by_calibration[:3, 9] = 0.01 * pose[:3, :3].T @ pose[:3, 3]
            pose[:3, 3] *= 1.0 - scale
            covariance = each.covariance + by_calibration @ by_calibration.T
            estimates.append(replace(each, T_world_camera=pose, covariance=covariance, by_calibration=by_calibration))
        times = np.arange(0.013, frames * FRAME, 0.1)
        location = LocationFilter(sense(drive.pose(times), times, seed, 0.002, 0.001, MOUNT))
        fused = [location.fuse(estimate) for estimate in estimates]
        assert location.summary.ready is not None
        nees.append(nees_of(drive.pose(FRAME * np.arange(frames)), fused))
    assert 0.5 < np.mean(nees) < 2.0


@pytest.mark.long
def test_the_sensor_s_world_is_found_and_poses_are_given_in_it():
    drive = Drive(2)
    estimates = drifting_estimates(drive, 300, SIGMA, 2)
    times = np.arange(0.02, 14.5, 0.1)
    readings = sense(drive.pose(times), times, 7, 0.005, 0.005, MOUNT)
    location = LocationFilter(readings)
    for estimate in estimates:
        location.fuse(estimate)
    trajectory = location.trajectory()
    assert trajectory is not None
    # The world of `sense` is known only to itself: the mark's true poses give it.
    random = np.random.default_rng(7)
    A = se3_exp(np.concatenate([random.uniform(-50, 50, 3), random.uniform(-1.5, 1.5, 3)]))
    assert location.T_sensor_world is not None
    assert location.T_sensor_world_covariance is not None
    x = se3_log(se3_inverse(A) @ location.T_sensor_world)
    assert squared_sigmas(x, location.T_sensor_world_covariance) < WITHIN_3_SIGMA
    np.testing.assert_allclose(trajectory.positions, (A @ drive.pose(trajectory.timestamps))[:, :3, 3], atol=0.1)


@pytest.mark.long
def test_wrong_readings_are_weakened():
    drive = Drive(3)
    estimates = drifting_estimates(drive, 300, SIGMA, 3)
    times = np.arange(0.013, 15.0, 0.1)
    good = sense(drive.pose(times), times, 3, 0.02, 0.01, MOUNT)
    positions = good.positions.copy()
    positions[60::10] += 1.0
    location = LocationFilter(Locations(times, positions, good.rotations, good.covariances))
    fused = [location.fuse(estimate) for estimate in estimates]
    assert 5 <= location.summary.weakened <= 15
    truth = drive.pose(FRAME * np.arange(300))
    assert rms(errors_of(truth, fused), slice(0, 3)) < rms(errors_of(truth, estimates), slice(0, 3))


def test_nothing_is_fused_while_the_body_rests_and_poses_stay_as_they_are():
    poses = np.tile(np.eye(4), (30, 1, 1))
    readings = sense(poses, FRAME * np.arange(30) + 0.01, 0, 0.01)
    location = LocationFilter(readings)
    for k in range(30):
        estimate = estimate_of(FRAME * k, np.eye(4), 1e-6 * np.eye(6))
        assert location.fuse(estimate) is estimate
    assert location.summary.ready is None
    assert location.trajectory() is None


@pytest.mark.long
def test_frames_before_the_first_pose_come_back_as_they_are_and_their_readings_are_not_used():
    drive = Drive(3)
    estimates = drifting_estimates(drive, 60, SIGMA, 3)
    times = np.arange(-0.49, 3.0, 0.1)
    readings = sense(drive.pose(times), times, 3, 0.02, 0.01, MOUNT)
    nowhere = np.full((4, 4), np.nan), np.diag(np.full(6, np.inf))
    before = [estimate_of(FRAME * k, *nowhere, "starting") for k in range(-10, 0)]
    late, location = LocationFilter(readings), LocationFilter(readings)
    assert all(late.fuse(estimate) is estimate for estimate in before)
    for estimate in estimates:
        np.testing.assert_array_equal(late.fuse(estimate).T_world_camera, location.fuse(estimate).T_world_camera)
    assert (late.summary.used, late.summary.unused) == (location.summary.used, 5)


@pytest.mark.long
def test_after_a_loss_the_error_is_what_it_was_before():
    """The tracker predicts for two seconds and finds its way back: nothing of the prediction's error stays."""
    drive = Drive(3)
    estimates = drifting_estimates(drive, 300, SIGMA, 3)
    wrong = se3_exp(np.array([0.2, 0.2, 0.2, 0.05, 0.02, 0.02]))
    unsure = np.diag(np.repeat([0.2, 0.05], 3) ** 2)
    for k in range(200, 240):
        estimates[k] = estimate_of(FRAME * k, estimates[k].T_world_camera @ wrong, unsure, "lost")
    times = np.arange(0.013, 15.0, 0.1)
    location = LocationFilter(sense(drive.pose(times), times, 3, 0.02, 0.01, MOUNT))
    fused = [location.fuse(estimate) for estimate in estimates]
    truth = drive.pose(FRAME * np.arange(300))
    errors = errors_of(truth, fused)
    assert np.linalg.norm(errors[240:, :3], axis=1).max() < 0.15
    # Meanwhile the sensor alone says where it is.
    assert np.linalg.norm(errors[225:240, :3], axis=1).mean() < 0.1
    assert nees_of(truth[240:], fused[240:]) < 4


def test_readings_of_another_clock_are_refused_at_the_first_frame():
    location = LocationFilter(sense(np.tile(np.eye(4), (3, 1, 1)), np.array([1.0, 2.0, 3.0]), 0, 0.1))
    with pytest.raises(InputError, match=r"before the first frame at 100\.0.* same clock"):
        location.fuse(estimate_of(100.0, np.eye(4), np.zeros((6, 6))))


@pytest.mark.long
@pytest.mark.parametrize(("sigma", "most"), [(0.001, 1.1), (0.00025, 1.15)])
def test_on_a_rendered_sequence_single_frames_do_not_become_drift(
    demo_sequence: Path, demo: Demo, sigma: float, most: float
):
    """One keyframe, errors of 1.5 mm that are no random walk; 1.05 times as large with the duller sensor.

    With the sharper one 1.4 times as large, if they were.

    The sensor's unknown world takes up what drift there is. The tracker knows that the render's calibration is exact:
    one that may be wrong by its usual sigmas is corrected by the sensor, and places are as good as that (2.7 mm).
    """
    truth = read_kitti(demo_sequence / "poses.txt")
    estimates = track_demo(StereoTracker(replace(demo[0], sigmas=CalibrationSigmas.none())), demo[1])
    rows = np.arange(0, len(truth), 2)
    nees, after = [], []
    for seed in range(6):
        location = LocationFilter(sense(truth.poses[rows], truth.timestamps[rows], seed, sigma, 0.002, MOUNT))
        fused = [location.fuse(estimate) for estimate in estimates]
        nees.append(nees_of(truth.poses, fused))
        after.append(rms(errors_of(truth.poses, fused), slice(0, 3)))
    assert np.mean(after) < most * rms(errors_of(truth.poses, estimates), slice(0, 3))
    # 0.40 before covariances knew what neighbouring matches share, 0.29 since: too wide here, as rooms were too narrow.
    assert 0.25 < np.mean(nees) < 2.0


@pytest.mark.long
@pytest.mark.usefixtures("without_report")
def test_the_command_line_fuses_and_says_what_became_of_the_readings(demo_sequence: Path, tmp_path: Path):
    truth = read_kitti(demo_sequence / "poses.txt")
    readings = sense(truth.poses[::2], truth.timestamps[::2], 0, 0.001, 0.002, MOUNT)
    assert readings.rotations is not None
    path, run = tmp_path / "location.csv", tmp_path / "run"
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["timestamp", "x", "y", "z", "qx", "qy", "qz", "qw", "sigma_position", "sigma_rotation"])
        quaternions = matrix_to_quaternion(readings.rotations)
        for time, position, quaternion in zip(readings.timestamps, readings.positions, quaternions, strict=True):
            rows.writerow([time, *position, *quaternion, 0.001, 0.002])
    result = CliRunner().invoke(
        app, ["track", str(demo_sequence), "--out", str(run), "--location", str(path), "--frontend", "klt"]
    )
    assert result.exit_code == 0, result.output
    assert "Location sensor: 19 readings used" in result.output
    # The first is of the first frame, before there is a motion.
    assert len(read_tum(run / "trajectory_location.tum")) == len(truth)
    assert not (run / "trajectory_final.tum").exists()  # it would lack the readings
    assert evaluate_run(run, demo_sequence / "poses.txt", plot=False).ate_origin.rmse < 0.02
