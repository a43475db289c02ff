"""Wrong calibrations, of a highway also driven backwards and seen in a mirror: is every pose as sure as it says?"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from sigmaslam.slam.tracker import StereoTracker
from sigmaslam_benchmarks.live.judge import DrivenPose, References, pose_errors
from sigmaslam_benchmarks.tracking.other_ways import WAYS, describe, open_drive, turn
from sigmaslam_evaluation.metrics.truth_covariance import truth_covariance


def test_a_drive_turned_twice_is_the_drive(demo_sequence: Path):
    drive = open_drive(demo_sequence)
    for way in WAYS:
        there = turn(drive, way)
        camera, frames, truth = turn(there, way)
        assert all(np.array_equal(one.left, other.left) for one, other in zip(frames, drive[1], strict=True))
        np.testing.assert_allclose(truth, drive[2], atol=1e-12)
        np.testing.assert_allclose(camera.T_left_right, drive[0].T_left_right, atol=1e-12)
        assert (camera.left, camera.right) == (drive[0].left, drive[0].right)
        # True poses fit the turned drive: they have no error, and a scale on top is its length's.
        far = [DrivenPose(k, "tracking", pose.copy(), np.eye(6)) for k, pose in enumerate(there[2])]
        assert describe(far, there, (0.0, 0.0)) == [str(len(frames)), "0", "+0.00", "0", "0.00"]
        for pose in far:
            pose.T_world_camera[:3, 3] *= 1.01
        assert describe(far, there, (0.0, 0.0))[2] == "+1.00"


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("way", WAYS)
def test_no_pose_of_a_highway_is_surer_than_right(real_data: Path, way: str):
    """Focal lengths, lenses and turns of this calibration are off by several of their sigmas.

    With the sigmas as they are up to 33 of 50 poses lay beyond their 99.9 % bounds.
    """
    camera, frames, truth = turn(open_drive(real_data / "kitti_odometry_01_f000_050"), way)
    tracker = StereoTracker(camera, threads=1)
    found = [tracker.step(each.left, each.right, each.timestamp) for each in frames]
    poses = [DrivenPose(k, each.status, each.T_world_camera, each.covariance) for k, each in enumerate(found)]
    errors = pose_errors(poses, References(truth, truth_covariance(0.1, 0.05)))
    assert all(each.has_pose for each in found)
    assert found[-1].calibration.worse > 1.5
    assert not errors.beyond.any()
    assert 0.1 < np.nanmean(errors.pose) / 6.0 < 2.0


@pytest.mark.long
@pytest.mark.parametrize("degrees", [-0.3, 0.3])
def test_a_turned_camera_is_found_by_the_first_frames(demo_sequence: Path, degrees: float):
    """By the second keyframe alone, which is the 21st frame of those to whom nothing is wrong, 16 to 21 poses are."""
    camera, frames, truth = open_drive(demo_sequence)
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(np.radians((0.0, degrees, 0.0)))[0]
    tracker = StereoTracker(replace(camera, T_left_right=camera.T_left_right @ turn), threads=1)
    found = [tracker.step(each.left, each.right, each.timestamp) for each in frames[:16]]
    # Disparities are off by it at the middle of the image.
    (offset, sigma), error = found[-1].calibration.errors["yaw"], -camera.left.fx * np.radians(degrees)
    assert abs(offset - error) < 3.0 * sigma < 2.0
    poses = [DrivenPose(k, each.status, each.T_world_camera, each.covariance) for k, each in enumerate(found)]
    errors = pose_errors(poses, References(truth, truth_covariance(0.0, 0.0)))
    assert all(each.status == "tracking" for each in found[1:])
    assert errors.beyond.sum() <= 1  # before there was anything to see
