"""Robots in a world that is known: accuracy, consistency, and faults that the filter must find or stand."""

from dataclasses import replace

import numpy as np
import pytest

from sigmaslam.errors import InputError
from sigmaslam_localisation.recording import PlanarTruth
from sigmaslam_localisation.robots import LandmarkMap, localise_robots
from sigmaslam_localisation.scores import innovation_statistics, score, score_map
from tests.support.wheeled_world import World, drive, started_wrong

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(300)]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["range-bearing", "cartesian"])
def test_a_robot_with_faults_is_found_and_so_are_its_faults(kind):
    world = World(seconds=40.0, kind=kind, delay=0.2, drift=0.06, speed_scale=0.05, outliers=0.1, seed=1)
    first, second = localise_robots([drive(world)])
    estimate = second[0]
    found = score(estimate)
    assert found["position_rmse"] < 0.08
    assert found["heading_rmse"] < 0.06
    assert 0.1 < found["nees_mean"] < 9
    assert abs(estimate.delay - 0.2) <= 0.1
    for name, true in (("drift", 0.06), ("speed scale", 0.05)):
        value, deviation = estimate.constants[name]
        assert abs(value - true) < 3.5 * deviation
    assert 0.03 < innovation_statistics(estimate)["outliers"] < 0.25
    assert len(first[0].pose) == len(estimate.pose)


def test_poses_are_compared_with_the_truth_at_their_own_times():
    """Times that differ by rounding alone; the pose before would be 0.1 s old."""
    seconds = np.arange(1, 301) * 0.1 - 0.1
    poses = np.column_stack([seconds, 0.0 * seconds, 0.0 * seconds])
    estimate = localise_robots([drive(World(seconds=0.1))])[1][0]
    covariance, truth = np.tile(np.eye(3), (300, 1, 1)), PlanarTruth(seconds, poses, 1.0)
    driven = replace(estimate, seconds=seconds, pose=poses, covariance=covariance, truth=truth)
    assert score(driven)["position_rmse"] < 1e-8


@pytest.mark.long
def test_where_the_sensor_stands_is_found():
    """5 cm to the left, which turns of the robot show."""
    estimate = localise_robots([drive(World(seconds=60.0, left=0.05, seed=3))])[1][0]
    value, deviation = estimate.constants["sensor left"]
    assert deviation < 0.018
    assert abs(value - 0.05) < 3.0 * deviation
    assert score(estimate)["nees_median"] < 6.25


@pytest.mark.long
def test_sightings_that_come_late_do_not_shift_the_poses_in_time():
    """Taken for a robot that follows its controls late, the same recording gives the poses of a while before."""
    recording = drive(World(seconds=40.0, late=0.3, seed=6))
    right, wrong = (score(localise_robots([replace(recording, odometry=odometry)])[1][0]) for odometry in (True, False))
    assert right["heading_rmse"] < 0.6 * wrong["heading_rmse"]
    # The median of chi-square with three degrees of freedom, and twice that.
    assert right["nees_median"] < 2.37 < 0.5 * wrong["nees_median"]


@pytest.mark.long
def test_landmarks_of_an_unknown_map_are_found():
    """No place of a landmark is told: they are moved in the recording, and the estimate is the same.

    In a world whose origin is far away it is the same, too.
    """
    recording = drive(World(seconds=20.0, seed=8))
    estimate = localise_robots([recording], mapping=True)[1][0]
    moved = replace(recording, landmarks=recording.landmarks + 100.0)
    np.testing.assert_array_equal(localise_robots([moved], mapping=True)[1][0].pose, estimate.pose)
    assert recording.truth is not None
    shift = np.array([5e5, 5.6e6, 0.0])
    far = replace(recording, truth=replace(recording.truth, poses=recording.truth.poses + shift))
    np.testing.assert_allclose(localise_robots([far], mapping=True)[1][0].pose - shift, estimate.pose, atol=1e-6)
    found = score_map(estimate.map)
    assert found["landmarks"] == len(recording.landmarks)
    assert found["landmark_rmse_aligned"] < 0.15
    assert found["landmark_nees"] < 6
    assert score(estimate)["nees_mean"] < 9


def test_a_map_that_is_turned_and_shifted_has_no_error_once_aligned():
    true = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    found = score_map(LandmarkMap(np.arange(3), true @ turn.T + [0.5, -0.2], 0.04 * np.eye(6), true))
    assert found["landmark_rmse_aligned"] < 1e-12
    error = true @ turn.T + [0.5, -0.2] - true
    assert found["landmark_nees"] == pytest.approx(np.mean(np.sum(error**2, axis=1)) / 0.04)
    assert found["map_nees_per_dof"] == pytest.approx(found["landmark_nees"] / 2)


@pytest.mark.long
def test_filters_agree_on_a_gentle_problem():
    recording = drive(World(seconds=8.0, seed=2))
    poses = [localise_robots([recording], name)[1][0].pose for name in ("ukf", "ekf", "iterated")]
    for pose in poses[1:]:
        assert np.abs(pose - poses[0]).max() < 0.03


@pytest.mark.long
def test_a_belief_that_is_wrong_and_too_sure_does_not_lock_the_sightings_out():
    """The start is 0.7 m off, 70 of its sigmas: a gate at three sigma would refuse every sighting for ever."""
    recording = started_wrong(drive(World(seconds=30.0, seed=3)), 0.5)
    estimate = localise_robots([recording])[1][0]
    true = drive(World(seconds=30.0, seed=3)).truth.at(estimate.seconds)
    error = np.hypot(*(estimate.pose - true)[:, :2].T)
    assert error[0] > 0.6
    assert error[len(error) // 2 :].max() < 0.2


@pytest.mark.long
def test_robots_of_a_batch_are_what_they_are_alone():
    robots = [drive(World(seconds=5.0, seed=seed)) for seed in (4, 5)]
    together = localise_robots(robots)[1]
    for robot, estimate in zip(robots, together, strict=True):
        alone = localise_robots([robot])[1][0]
        np.testing.assert_allclose(estimate.pose, alone.pose, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance, alone.covariance, atol=1e-9)


def test_without_a_truth_a_start_is_asked_for():
    recording = replace(drive(World(seconds=5.0)), truth=None)
    with pytest.raises(InputError, match="--start X,Y,HEADING"):
        localise_robots([recording])
    estimate = localise_robots([recording], start=(2.0, 1.0, 0.0))[1][0]
    assert score(estimate) == {}
    np.testing.assert_allclose(estimate.pose[0], [2.0, 1.0, 0.0])
